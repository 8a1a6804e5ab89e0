"""What the system asks of a front end and of a back end. Each method is documented once, here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from slam.data import (
    Estimate,
    IdArray,
    ImagePair,
    Observations,
    Patches,
    Prediction,
    StereoFeatures,
    StereoFrame,
    UpdateReport,
)
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.object_data import ObjectEstimate, ObjectObservations


@runtime_checkable
class Frontend(Protocol):
    """Turns a pair of images into features. Created as ``Frontend(rig, **options)``."""

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """Features of one stereo frame, in pixels of the rig's own images.

        An image without features, or a missing right image, is no error: fewer (or no) rows come back.

        Raises:
            SequenceError: the images are not of the rig's size or of an unusable type.
        """
        ...


@runtime_checkable
class AligningFrontend(Protocol):
    """What a front end offers besides, where it can align a feature to the image of an earlier one.

    Its features carry the images that they are from. All pixels are those of the rectified pair.
    """

    def patches(self, images: ImagePair, uv_left: Array, size: Array) -> Patches:
        """The left image around pixels (N, 2) of features of some size (N,) [px]."""
        ...

    def align(
        self, images: ImagePair, patches: Patches, warps: Array, uv_left: Array, uv_right: Array
    ) -> tuple[Array, Array]:
        """Where patches (N) are in a later pair of images: left and right pixels (N, 2), NaN where they are not.

        `warps` (N, 2, 2) take pixel offsets in the later image to offsets in the patch; the search starts at `uv_left`
        and `uv_right` (N, 2) [px]. Called beside `Frontend.extract` of another frame.
        """
        ...


@runtime_checkable
class Backend(Protocol):
    """Estimates the camera's path and the landmarks' positions. Created as ``Backend(rig, **options)``.

    The order of calls in a step is predict, update, then add and remove as needed; `estimate` and `trajectory` may be
    asked at any time after the first `predict`. The world frame is the left camera's frame at the first `predict`
    unless the options give an initial pose.
    """

    def predict(self, stamp: float) -> Prediction:
        """Advance the belief to `stamp` [s] by the motion model; no measurement yet.

        Returns the predicted pose and the landmarks in the angle of view. The first call sets the start.

        Raises:
            MeasurementError: `stamp` is not finite or not later than the last one.
        """
        ...

    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """Correct the belief with landmarks seen at the predicted time. Zero rows are legal.

        `guess` is the pose T_world_left (4, 4) on which the observations agree, where the caller knows it. It is no
        measurement: it only says where to linearise first, for steps in which the prediction is far off.

        A step that cannot be solved is a status with a reason, never an exception.

        Raises:
            MeasurementError: an id is not in the map.
        """
        ...

    def add(self, observations: Observations) -> None:
        """Add new landmarks at their first sight; depth comes from the stereo pair (paper A, Eqs. 8 and 10).

        Raises:
            MeasurementError: an id is in the map already, or a row has no right pixel or no positive depth.
        """
        ...

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """Take landmarks out of the map.

        Raises:
            MeasurementError: an id is not in the map.
        """
        ...

    def estimate(self, landmarks: bool = True) -> Estimate:
        """The belief after the last call: pose, landmarks, covariances.

        With ``landmarks=False`` the landmark rows stay empty: the pose and its covariance alone, cheap in every frame.
        """
        ...

    def positions(self, ids: IdArray) -> Array:
        """Current positions (M, 3) [m] of landmarks in world coordinates, in the order of `ids`; no covariance.

        Raises:
            MeasurementError: an id is not in the map.
        """
        ...

    def trajectory(self) -> Trajectory:
        """The left camera's pose at every stamp predicted so far; a smoother's is revised, a filter's is not."""
        ...


@runtime_checkable
class ObjectBackend(Protocol):
    """What a back end offers besides, where it estimates moving objects; those that do not are given none.

    Called in every step after `Backend.update`, at the same stamp.
    """

    def update_objects(self, observations: Sequence[ObjectObservations]) -> list[ObjectEstimate]:
        """Advance all bodies to the current stamp, correct those that are observed, and start those with a new id.

        The prior is a constant velocity with an impulse between frames, as for the camera; it goes on through frames
        in which a body is not observed. New points of a known body join it.

        Returns:
            estimates of all bodies, observed or not, by ascending id.

        Raises:
            MeasurementError: a new body has fewer than three points with a right pixel.
        """
        ...

    def remove_objects(self, ids: IdArray | Sequence[int]) -> None:
        """Forget bodies.

        Raises:
            MeasurementError: an id is unknown.
        """
        ...


@runtime_checkable
class RevisingBackend(Protocol):
    """What a back end offers besides, where it can correct past measurements anew.

    Attributes:
        revises_path: whether the whole path would follow now; else only what is near the camera does.
    """

    revises_path: bool

    def revise(self, mend: Callable[[Array], Array]) -> None:
        """Mend all measurements so far: `mend` takes rectified rows (uL, vL, uR) (N, 3) [px] to better ones.

        Called before `Backend.predict`, when more has become known of the rig's error; uR is NaN where there is none,
        and stays so. A back end without this goes on with what it made of the measurements as they were.

        Raises:
            MeasurementError: a mended measurement is not finite.
        """
        ...


@runtime_checkable
class MapBackend(Protocol):
    """What a back end offers besides, where it can start in a map that is known beforehand.

    One whose memory grows faster than the map says in an attribute ``most_landmarks`` how large a map it takes.
    """

    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """Add landmarks with known positions (N, 3) [m] and covariances (N, 3, 3) [m²], independent of the pose.

        At any time, before the first `predict` as well. The landmarks are in the world frame; how well the camera's
        place in it is known is what the models' `initial_pose` and its sigmas say. Correlations between the landmarks
        are taken to be none.

        Raises:
            MeasurementError: an id is in the map already, or a covariance is not symmetric and positive definite.
        """
        ...

    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """Add landmarks at `local` (N, 3) [m] in the newest camera's coordinates, with covariances (N, 3, 3) [m²].

        As `Backend.add`, but for landmarks whose place before the camera comes from elsewhere than a stereo pair: the
        covariances say how well it is known. The landmarks are correlated with the camera's pose at that time.

        Raises:
            MeasurementError: before the first `predict`; an id is in the map already, or a covariance is not symmetric
                and positive definite.
        """
        ...
