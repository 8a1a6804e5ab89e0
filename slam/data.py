"""The data that flows through the system: frozen dataclasses of arrays, one row per feature or landmark.

Frames are in the names: ``T_world_left`` takes left-camera coordinates to world coordinates. Pixels are (x right,
y down), the centre of the first pixel is (0, 0), in the rig's own images. Lengths are metres, angles radians, times
seconds. Pose covariances are (6, 6), order [rotation, translation], of a perturbation ``T exp(ξ)``: in camera axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam.checks import FARTHEST_PIXEL
from slam.errors import MeasurementError
from slam.geometry.arrays import Array, Table, changed
from slam.geometry.arrays import BoolArray as BoolArray
from slam.geometry.arrays import IdArray as IdArray
from slam.geometry.arrays import IndexArray as IndexArray
from slam.naming import count, of_shapes, point
from slam.object_data import MovingObject


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """One pair of images, taken at the same time.

    Attributes:
        index: number of the frame in its sequence.
        stamp: time [s].
        left, right: images (H, W) or (H, W, 3|4), uint8 or uint16; `right` is None where it is missing.
        left_mask, right_mask: (H, W) bool, False where features are not used; None for the whole image.
    """

    index: int
    stamp: float
    left: np.ndarray
    right: np.ndarray | None
    left_mask: BoolArray | None = None
    right_mask: BoolArray | None = None

    def __repr__(self) -> str:
        height, width = self.left.shape[:2]
        right = "" if self.right is not None else ", no right image"
        return f"StereoFrame({self.index}, {self.stamp:.3f} s, {width}x{height} {self.left.dtype}{right})"


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Rectified grey images (H, W) of one stereo frame; `right` is None where it is missing."""

    left: NDArray[np.float32]
    right: NDArray[np.float32] | None


@dataclass(frozen=True, eq=False)
class Patches:
    """Image patches around pixels, one row each; made and used by a front end."""

    images: NDArray[np.float32]  # (N, S, S), NaN beyond the image
    centres: Array  # coordinates of the pixels within the patches (N, 2)
    size: Array  # of the features at the pixels (N,) [px]


_COLUMNS = ("uv_left", "uv_right", "scale", "angle", "response", "laplacian", "descriptors")  # of `StereoFeatures`


@dataclass(frozen=True, eq=False)
class StereoFeatures:
    """Features of one stereo frame, a row each.

    Attributes:
        stamp: time [s].
        uv_left, uv_right: pixels (N, 2); the right ones NaN where there is no stereo match.
        scale: size of the feature (N,) [px].
        angle: orientation (N,) [rad], 0 where upright.
        response: strength (N,).
        laplacian: sign of the Laplacian (N,) int8, +1 for a dark blob on bright ground.
        descriptors: unit vectors (N, D) float32.
        threshold: the detector's D_threshold in force (paper A, III.A); NaN where there is none.
        images: in which the features were found, kept for alignment; None if not kept.
        rectified: whether pixels are those of the rectified pair, not of the rig's own images.
    """

    stamp: float
    uv_left: Array
    uv_right: Array
    scale: Array
    angle: Array
    response: Array
    laplacian: NDArray[np.int8]
    descriptors: NDArray[np.float32]
    threshold: float = float("nan")
    images: ImagePair | None = field(default=None, repr=False, compare=False)
    rectified: bool = False

    def __len__(self) -> int:
        return len(self.uv_left)

    def __repr__(self) -> str:
        pairs = f"{int(self.has_stereo.sum())} with a right pixel, {self.descriptors.shape[1]}-D"
        return f"StereoFeatures({count(len(self), 'feature')}, {pairs}, {self.stamp:.3f} s)"

    @cached_property
    def has_stereo(self) -> BoolArray:
        """Which features have a right pixel (N,)."""
        return np.isfinite(self.uv_right[:, 0]) & np.isfinite(self.uv_right[:, 1])

    @cached_property
    def by_column(self) -> IndexArray:
        """Rows of the features from left to right in the left image (N,)."""
        return self.uv_left[:, 0].argsort(kind="stable")

    def select(self, rows: NDArray) -> StereoFeatures:
        """The features of these rows (a mask or indices)."""
        return changed(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    @classmethod
    def empty(cls, stamp: float, dimensions: int = 64, threshold: float = float("nan")) -> StereoFeatures:
        """No features."""
        uv, z, descriptors = np.zeros((0, 2)), np.zeros(0), np.zeros((0, dimensions), np.float32)
        return cls(stamp, uv, uv, z, z, z, z.astype(np.int8), descriptors, threshold)


@dataclass(frozen=True, eq=False)
class Observations(Table):
    """Landmarks seen in one frame, a row each.

    Attributes:
        ids: landmark ids (M,), unique.
        uv_left, uv_right: pixels (M, 2); the right ones NaN where there is no stereo match.

    Raises:
        MeasurementError: shapes differ, an id occurs twice, or a pixel is not finite or too far off to be in any image.
    """

    ids: IdArray
    uv_left: Array
    uv_right: Array

    def __post_init__(self) -> None:
        if not all(isinstance(a, np.ndarray) and a.ndim for a in (self.ids, self.uv_left, self.uv_right)):
            raise MeasurementError("observations: ids and pixels must be arrays with a row for each landmark")
        n, shapes = len(self.ids), (self.uv_left.shape, self.uv_right.shape)
        if shapes != ((n, 2), (n, 2)):
            raise MeasurementError(f"observations: {n} ids, but uv_left is {shapes[0]} and uv_right {shapes[1]}")
        if not (self.ids[1:] > self.ids[:-1]).all() and len(np.unique(self.ids)) != n:  # they mostly ascend
            raise MeasurementError("observations: a landmark id stands twice")
        if (np.abs(self.uv_left) <= FARTHEST_PIXEL).all() and not (np.abs(self.uv_right) > FARTHEST_PIXEL).any():
            return  # NaN compares false
        if not np.isfinite(self.uv_left).all():
            raise MeasurementError("observations: a left pixel is not finite")
        if np.isinf(self.uv_right).any():
            raise MeasurementError("observations: a right pixel is infinite; NaN says that there is none")
        raise MeasurementError(f"observations: a pixel lies more than {FARTHEST_PIXEL:g} px off: in no image")

    __repr__ = of_shapes

    @property
    def has_stereo(self) -> BoolArray:
        """Which observations have a right pixel (M,)."""
        return np.asarray(np.isfinite(self.uv_right).all(axis=1))

    @classmethod
    def empty(cls) -> Observations:
        """No observations."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a back end expects to see, before the measurement.

    Attributes:
        stamp: time [s].
        T_world_left, covariance: predicted pose (4, 4), and its covariance (6, 6).
        ids: landmarks in the angle of view (M,) (paper A, IV and Fig. 3).
        uv_left, uv_right: their predicted pixels (M, 2); the right ones may lie outside the image.
        innovation: covariances of the left pixels' innovations (M, 2, 2) [px²], measurement noise included.
    """

    stamp: float
    T_world_left: Array
    covariance: Array
    ids: IdArray
    uv_left: Array
    uv_right: Array
    innovation: Array

    __repr__ = of_shapes


class UpdateStatus(StrEnum):
    """How an update ended: OK where measurements were used.

    EMPTY: nothing was measured, or nothing passed the gate. FAILED: the estimator could not solve, and the report gives
    the reason. After both the estimate is the prediction.
    """

    OK = "ok"
    EMPTY = "empty"
    FAILED = "failed"


@dataclass(frozen=True, eq=False)
class UpdateReport:
    """What an update did with its observations.

    Attributes:
        status: how it ended.
        reason: one line where the status is not OK, or a solver was built anew or did not converge; else empty.
        used, rejected: ids of the landmarks whose observations were used (K,), and that failed the gate (R,).
        nis, dof: normalised innovation squared νᵀ S⁻¹ ν of all used observations together (NaN if none), and its
            degrees of freedom.
    """

    status: UpdateStatus
    reason: str
    used: IdArray
    rejected: IdArray
    nis: float
    dof: int

    def __repr__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        taken = f"{len(self.used)} used, {len(self.rejected)} rejected"
        return f"UpdateReport({self.status.value}{why}, {taken}, NIS {self.nis:.1f} of {self.dof})"

    @classmethod
    def nothing(cls, status: UpdateStatus, reason: str, rejected: IdArray | None = None) -> UpdateReport:
        """A report of an update that used no observation."""
        none = np.zeros(0, np.int64)
        return cls(status, reason, none, none if rejected is None else rejected, float("nan"), 0)


@dataclass(frozen=True, eq=False)
class RecentPoses:
    """The camera's last poses together, the newest last.

    Attributes:
        stamps: their times (K,) [s].
        poses: T_world_left (K, 4, 4).
        covariance: joint (6 K, 6 K), of perturbations on the right, each in the order of a pose's covariance.
    """

    stamps: Array
    poses: Array
    covariance: Array

    __repr__ = of_shapes

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The back end's estimate of pose and landmarks at one time.

    Attributes:
        stamp: time [s].
        T_world_left: pose (4, 4).
        covariance: its covariance (6, 6): rotation [rad], then translation [m], in the left camera's axes.
        ids: landmark ids (N,), ascending.
        positions, covariances: of the landmarks in the world (N, 3) [m], and their marginal ones (N, 3, 3) [m²].
    """

    stamp: float
    T_world_left: Array
    covariance: Array
    ids: IdArray
    positions: Array
    covariances: Array

    def __repr__(self) -> str:
        R, t = self.T_world_left[:3, :3], self.T_world_left[:3, 3]
        where = f"camera at {point(t)} ± {point(np.sqrt(np.diag(R @ self.covariance[3:, 3:] @ R.T).clip(min=0)))} m"
        return f"Estimate({self.stamp:.3f} s, {where}, {count(len(self.ids), 'landmark')})"


@dataclass(frozen=True, eq=False)
class CommonError:
    """Error of poses due to the rig's error: ``jacobian @ root @ c``, with the same c for all poses.

    If the correction has changed since a pose was estimated, the pose still contains the difference. It is one column
    of `root`: its effect on the pose is only known from a model of the estimator, so it counts as an error, too.
    """

    jacobian: Array = field(default_factory=lambda: np.zeros((6, 0)))  # of the pose by the m shared errors (6, m)
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of these by c (m, n), which has unit variance

    @property
    def covariance(self) -> Array:
        """What it adds to the pose's covariance (6, 6)."""
        S = self.jacobian @ self.root
        return np.asarray(S @ S.T)


class Revision(Protocol):
    """A change of the rig's correction during a run, for measurements that have the earlier correction."""

    def rows(self, z: Array) -> Array:
        """Rectified rows (uL, vL, uR) (N, 3) [px], corrected again."""


class Correction(Revision, Protocol):
    """A correction of measurements by the present estimate of the rig's error."""

    def undone(self, z: Array) -> Array:
        """Measured rows (N, 3) of corrected ones: the inverse of `rows`."""


class FrameStatus(StrEnum):
    """How a frame ended.

    STARTED: the map begins, with the first frame that shows enough. TRACKED: the pose was measured against the map.
    Else it is the motion model's. PREDICTED: too few matches. LOST: too few for several frames. FAILED: no solution.
    """

    STARTED = "started"
    TRACKED = "tracked"
    LOST = "lost"
    PREDICTED = "predicted"
    FAILED = "failed"

    @property
    def measured(self) -> bool:
        """Whether the pose was measured; accuracy is evaluated on such frames only."""
        return self in (FrameStatus.STARTED, FrameStatus.TRACKED)


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What one step of the system did.

    Attributes:
        index: number of the step.
        status, reason: how it ended, and one line that says why, if it was not tracked; else empty.
        estimate: pose after the step, without landmarks; `StereoSlam.estimate` includes them.
        report: the back end's report.
        features: of the frame, without those outside of the rectified image and of what is fastened to a vehicle: rows
            count what is left. Landmarks' are aligned with earlier images, bodies' as found: `objects` are of aligned
            ones.
        predicted: number of landmarks in the angle of view.
        matched, matched_features: ids of landmarks found, after the geometric check, and rows of their features (K,).
        added, added_features: ids of landmarks that joined the map, and rows of their features (A,).
        erased: ids of landmarks that left the map.
        map_size: number of landmarks in the map.
        milliseconds: wall time per stage.
        moving_features: rows of features classified as moving (V,); they never become landmarks.
        objects: the moving bodies, by ascending id.
        located: False as long as the camera has not been found in the prior map; the pose is meaningless then.
        revision: change of the correction of all earlier pixels before this step (`RevisingBackend`); None without one.
        T_map_odom: pose (4, 4) in the map of the back end's own world, in which poses never jump; unity before a loop.
        loop, refused_loop: if the frame closed a loop, or one that contradicts the path, index of the earlier frame of
            the same place, or −1 if that is in the prior map; else None.
        keyframe: whether the frame has become a keyframe.
        returned: ids of landmarks of an old place that joined the map as another back end took over there.
        common: the part of the pose's error that all frames share; empty after a loop, which mixes it with noise.
        recent: the last poses with their joint covariance; None where it is not told, after a loop, and in a new map.
    """

    index: int
    status: FrameStatus
    reason: str
    estimate: Estimate
    report: UpdateReport
    features: StereoFeatures
    predicted: int
    matched: IdArray
    matched_features: NDArray[np.intp]
    added: IdArray
    added_features: NDArray[np.intp]
    erased: IdArray
    map_size: int
    milliseconds: Mapping[str, float] = field(default_factory=dict)
    moving_features: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    objects: tuple[MovingObject, ...] = ()
    located: bool = True
    revision: Revision | None = None
    T_map_odom: Array = field(default_factory=lambda: np.eye(4))
    loop: int | None = None
    refused_loop: int | None = None
    keyframe: bool = False
    returned: IdArray = field(default_factory=lambda: np.zeros(0, np.int64))
    common: CommonError = field(default_factory=CommonError)
    recent: RecentPoses | None = None

    def __repr__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        expected = f" of {self.predicted}" if len(self.matched) <= self.predicted else ""  # none before a map is found
        landmarks = f"{len(self.matched)}{expected} landmarks matched"
        change = f"{len(self.added)} added, {len(self.erased)} erased, {self.map_size} in the map"
        objects = f", {count(len(self.objects), 'moving object')}" if self.objects else ""
        return f"FrameResult({self.index}, {self.status.value}{why}, {landmarks}, {change}{objects})"
