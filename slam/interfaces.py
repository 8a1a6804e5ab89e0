"""The protocols of front ends and back ends. Each method is documented once, here."""

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
    RecentPoses,
    StereoFeatures,
    StereoFrame,
    UpdateReport,
)
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory


@runtime_checkable
class Frontend(Protocol):
    """Turns a pair of images into features. Created as ``Frontend(rig, **options)``."""

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """Features of one stereo frame, in pixels of the rig's own images or, if marked so, of its rectified pair.

        An image without features, or a missing right image, is no error: the result has fewer rows, or none.

        Raises:
            SequenceError: the images are not of the rig's size or of an unusable type.
        """


@runtime_checkable
class AligningFrontend(Protocol):
    """Additional methods of a front end that can align features with image patches of earlier frames.

    Its features hold the images in which they were found. All pixels are those of the rectified pair.
    """

    def patches(self, images: ImagePair, uv_left: Array, size: Array) -> Patches:
        """Patches of the left image around pixels (N, 2), for features of some size (N,) [px]."""

    def align(
        self, images: ImagePair, patches: Patches, warps: Array, uv_left: Array, uv_right: Array
    ) -> tuple[Array, Array]:
        """Find patches (N) in a later pair of images: left and right pixels (N, 2), NaN if not found.

        `warps` (N, 2, 2) map pixel offsets in the later image to offsets in the patch; the search starts at `uv_left`
        and `uv_right` (N, 2) [px]. May be called while `Frontend.extract` processes another frame.
        """


@runtime_checkable
class Backend(Protocol):
    """Estimates the camera's path and the landmarks' positions. Created as ``Backend(rig, **options)``.

    The rig is rectified, such as ``rig.rectified.rig``, and measurements are in its pixels. The order of calls in a
    step is predict, at most one update, then add and remove as needed. The world frame is the left camera's frame at
    the first `predict` unless the options give an initial pose.

    `estimate`, `positions` and `trajectory` may be asked at any time after the first `predict`. They are pure: asking
    never changes a later answer. A call that raises an exception changes nothing either.
    """

    def predict(self, stamp: float) -> Prediction:
        """Advance the belief to `stamp` [s] by the motion model; no measurement yet.

        Returns the predicted pose and the landmarks in the angle of view. The first call sets the start. After a gap of
        any length the prediction is finite, and its covariances are positive definite.

        Raises:
            MeasurementError: `stamp` is not finite or not later than the last one.
        """

    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """Correct the belief with landmarks seen at the predicted time. Zero rows are legal: the report is EMPTY.

        `guess` is the pose T_world_left (4, 4) on which the observations agree, if the caller knows it. It is no
        measurement, only the first linearisation point, for steps in which the prediction is far off.

        A row that no point in front of the camera explains, such as one of negative disparity, is rejected as wrong. A
        step that cannot be solved returns a status with a reason, and raises no exception.

        Raises:
            MeasurementError: before the first `predict`; an id is not in the map; or the time of the last `predict` has
                had its update, or landmarks were added or measurements revised at it: these rest on the pose as it was.
        """

    def add(self, observations: Observations) -> None:
        """Add new landmarks at their first sight; depth comes from the stereo pair (paper A, Eqs. 8 and 10).

        Raises:
            MeasurementError: before the first `predict`; an id is in the map already, or a row has no right pixel or no
                positive depth.
        """

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """Take landmarks out of the map.

        Raises:
            MeasurementError: an id is not in the map.
        """

    def estimate(self, landmarks: bool = True) -> Estimate:
        """The belief after the last call: pose, landmarks, covariances.

        With ``landmarks=False`` the landmark rows stay empty: the pose and its covariance alone, cheap in every frame.
        A smoother may solve further for the whole estimate and for `trajectory`; the pose alone is then the online one,
        which differs by little of its standard deviation.
        """

    def positions(self, ids: IdArray) -> Array:
        """Current positions (M, 3) [m] of landmarks in world coordinates, in the order of `ids`; no covariance.

        Raises:
            MeasurementError: an id is not in the map.
        """

    def trajectory(self) -> Trajectory:
        """The left camera's pose at every stamp predicted so far; a smoother's is revised, a filter's is not."""


@runtime_checkable
class RestingBackend(Protocol):
    """Additional method of a back end that can be told that the camera stands (a zero-velocity update)."""

    def predict_at_rest(self, stamp: float) -> Prediction:
        """As `Backend.predict`, but the camera has not moved since the last stamp, and its velocity is zero."""


@runtime_checkable
class RecentBackend(Protocol):
    """Additional method of a back end that knows how the errors of the camera's last poses hang together.

    Moving bodies need it, a velocity is the difference of two poses, and so does the judgement of covariances. Of a
    back end without it the joint covariance is derived from the poses' own ones, approximately
    (`slam.third_party.derived_recent`).
    """

    def recent(self, n: int) -> RecentPoses:
        """The camera's last poses, at most n, as the back end believes them, with their joint covariance.

        The last is that of `Backend.estimate`. They may be fewer than n: those of which the joint covariance is known.
        Asking changes nothing.

        Raises:
            MeasurementError: before the first `predict`, or n is less than one.
        """


@runtime_checkable
class ConsideringBackend(Protocol):
    """Additional methods of a back end that follows how the rig's remaining error moves its estimate.

    An error of the rig acts on all frames alike, and does not average out as pixel noise does. The back end considers,
    but does not estimate it (Schmidt, 1966): with δ (m,) such errors, ``T_true = T exp(J δ)``, ``y_true = y + L δ``.
    `Backend.estimate` and all gains are those of an exact rig, but for rounding; a system adds the part of δ by its
    present covariance. Without these methods it adds nothing: covariances are of pixel noise alone, too small if the
    calibration is not exact.
    """

    def consider(self, field: Callable[[Array], Array], pose: Array | None = None) -> None:
        """Follow errors δ of the rig from now on; called before the first `Backend.predict`.

        Args:
            field: derivatives (N, 3, m) of the true rectified rows (uL, vL, uR) by δ at corrected rows (N, 3) [px];
                rows of a missing uR do not count. The last of the errors is known to be 1: a displacement.
            pose: J (6, m) of the first pose; None for zero.

        Raises:
            MeasurementError: after the first `Backend.predict`, or with landmarks in the map.
        """

    def sensitivities(self, ids: IdArray) -> tuple[Array, Array]:
        """J (6, m) of the newest pose, perturbed on the right, and L (N, 3, m) of landmarks, in world coordinates.

        Raises:
            MeasurementError: before the first `Backend.predict`; an id is not in the map.
        """


@runtime_checkable
class RevisingBackend(Protocol):
    """Additional methods of a back end that can correct past measurements.

    Attributes:
        revises_path: whether a revision would now change the whole path; if False, only its part near the camera.
    """

    revises_path: bool

    def revise(self, correct: Callable[[Array], Array]) -> None:
        """Correct all measurements so far: `correct` maps rectified rows (uL, vL, uR) (N, 3) [px] to corrected ones.

        Called before `Backend.predict` when the estimate of the rig's error has changed. A missing uR is NaN and stays
        NaN. A back end without this method keeps its estimate from the earlier measurements. Where the path is not
        revised, landmarks that move by Δy have the last column of their sensitivities (`ConsideringBackend`) less Δy.

        Raises:
            MeasurementError: a corrected measurement is not finite.
        """


@runtime_checkable
class MapBackend(Protocol):
    """Additional methods of a back end that can start in a prior map.

    A back end whose memory grows faster than the map limits the map's size by an attribute ``most_landmarks``.
    """

    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """Add landmarks with known positions (N, 3) [m] and covariances (N, 3, 3) [m²], independent of the pose.

        May be called at any time, even before the first `predict`. The landmarks are in the world frame, in which the
        models' `initial_pose` and its sigmas describe the camera's pose. Landmarks are taken to be uncorrelated.

        Raises:
            MeasurementError: an id is in the map already, or a covariance is not symmetric and positive definite.
        """

    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """Add landmarks at `local` (N, 3) [m] in the newest camera's coordinates, with covariances (N, 3, 3) [m²].

        As `Backend.add`, but for landmarks whose position relative to the camera was not measured by a stereo pair;
        `covariances` is the uncertainty of that position. They become correlated with the camera's present pose.

        Raises:
            MeasurementError: before the first `predict`; an id is in the map already, a landmark is not in front of
                the camera, or a covariance is not symmetric and positive definite.
        """
