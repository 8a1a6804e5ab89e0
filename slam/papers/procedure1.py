"""The papers' detector of a moving object (paper B, section 3, Procedure 1 and steps a to e).

The object's features are known beforehand: a database of descriptors and 3D points of the initial scene. Three features
give a body frame in the initial and in the current scene, and these give the object's motion. The papers name no
covariance; here the stereo noise of the three points is carried through to first order. NOTES of the misprints: step e
says "the image correspondence A′, B′, C′", meant are their 3D positions, ``A′ = F_j + R (A − M_j)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.bodies.config import ObjectsConfig
from slam.bodies.detector import ObjectDetector
from slam.data import Estimate, RecentPoses, StereoFeatures
from slam.errors import ConfigurationError
from slam.files import Kind, read_bytes, require_arrays, unpack, whole_file
from slam.geometry.arrays import isin
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, log, pose, transform
from slam.models import EstimatorModels
from slam.object_data import MotionLabels, MovingObject, ObjectEstimate
from slam.tracks.follow import match_everywhere
from slam.tracks.table import Tracks

_ALIKE = 0.45, 0.8  # largest descriptor distance, and its largest ratio to the second best
_LARGEST = 2**28  # bytes of a database's file
_FARTHEST = 1e8  # guard: of its numbers
_ARRAYS = {
    "points": Kind(np.float64, "m3", -_FARTHEST, _FARTHEST), "origin": Kind(np.float64, "3", -_FARTHEST, _FARTHEST),
    "descriptors": Kind(np.float32, "md", -_FARTHEST, _FARTHEST), "laplacian": Kind(np.int8, "m", -1, 1),
}  # fmt: skip
_STEP = 1e-5  # numerics: of the finite differences [m]
_CANDIDATES = 12  # cost: features with the largest determinants among which a triple is looked for
_LEAST_SIDE, _LEAST_SINE = 0.08, 0.3  # between two points of a triple [m], and of its angles


@dataclass(frozen=True, eq=False)
class ObjectDatabase:
    """What is known of an object beforehand: its features in the initial scene."""

    points: Array  # 3D positions (M, 3) in world coordinates [m], M_j of step c
    descriptors: NDArray[np.float32]  # (M, D) float32
    laplacian: NDArray[np.int8]  # signs (M,) int8
    origin: Array  # A (3,), the origin of the object's coordinates in the initial scene [m]

    @classmethod
    def of(
        cls, features: StereoFeatures, rows: NDArray, rig: StereoRig, T_world_left: Array, origin: Array | None = None
    ) -> ObjectDatabase:
        """From the features of the initial scene that lie on the object; those without a stereo match are left out.

        `origin` defaults to the point with the largest determinant.
        """
        rows = np.arange(len(features))[rows]
        rows = rows[features.has_stereo[rows]]
        rows = rows[np.argsort(-features.response[rows], kind="stable")]
        points = transform(T_world_left, rig.triangulate(features.uv_left[rows], features.uv_right[rows]))
        good = np.isfinite(points).all(axis=1)
        rows, points = rows[good], points[good]
        if len(rows) < 3:
            raise ConfigurationError(f"object database: {len(rows)} features with a stereo match, 3 are needed")
        A = points[0] if origin is None else np.asarray(origin, float)
        return cls(points, features.descriptors[rows], features.laplacian[rows], A)

    def save(self, path: Path) -> None:
        """Write an .npz file, whole or not at all; raises ConfigurationError where it cannot be written."""
        with whole_file(path, ConfigurationError) as file:
            np.savez(
                file, points=self.points, descriptors=self.descriptors, laplacian=self.laplacian, origin=self.origin
            )  # fmt: skip

    @classmethod
    def load(cls, path: Path) -> ObjectDatabase:
        """Read what `save` wrote; ConfigurationError where there is no such file, or it is none of a database."""
        source = f"object database {path}"
        found = unpack(read_bytes(path, _LARGEST, ConfigurationError), source, _ARRAYS, ConfigurationError)
        require_arrays(found, _ARRAYS, source, ConfigurationError)
        return cls(**{name: found[name] for name in _ARRAYS})


def body_frame(A: Array, B: Array, C: Array) -> Array:
    """Rotation (3, 3) of the body frame of three points: columns x, y, z in world axes (paper B, Procedure 1).

    x is along AB, y along AB × AC, z along AB × (AB × AC).
    """
    x = B - A
    y = np.cross(x, C - A)
    z = np.cross(x, y)
    return np.column_stack([v / np.linalg.norm(v) for v in (x, y, z)])


def makes_frame(points: Array) -> bool:
    """Whether points A, B, C (3, 3) [m] make a frame: all have a depth, lie far enough apart and not in a line."""
    if not np.isfinite(points).all():
        return False
    sides = points[[1, 2, 2]] - points[[0, 0, 1]]
    lengths = np.linalg.norm(sides, axis=1)
    if lengths.min() < _LEAST_SIDE:
        return False
    area = np.linalg.norm(np.cross(sides[0], sides[1]))
    return bool(area / np.sort(lengths)[1:].prod() >= _LEAST_SINE)


def placed(current: Array, initial: Array, origin: Array) -> Array:
    """Pose (4, 4) [m] of the object by three points (3, 3) in the current and initial scene (steps b to e).

    Its rotation is ``R_2^1``, and it lies ``AA′`` from the `origin`.
    """
    R = body_frame(*current) @ body_frame(*initial).T
    return pose(R, current[0] + R @ (origin - initial[0]))


def detect(
    features: StereoFeatures, matches: tuple[NDArray[np.intp], NDArray[np.intp]], points: Array,
    database: ObjectDatabase,
) -> NDArray[np.intp]:  # fmt: skip
    """Three matches by which to measure the object's motion (steps a and c), or none.

    `matches` are rows of the database and of the features (K,), `points` (K, 3) the features' in world coordinates [m].
    The three with the largest determinant (of the Hessian, the detector's response) are taken; where they make no
    frame, see `makes_frame`, the next ones. What is returned are places among the matches (3,).
    """
    known, rows = matches
    order = np.argsort(-features.response[rows], kind="stable")[:_CANDIDATES]
    for triple in sorted(combinations(range(len(order)), 3), key=lambda three: three[::-1]):  # by their weakest feature
        three = order[list(triple)]
        if makes_frame(points[three]) and makes_frame(database.points[known[three]]):
            return three
    return np.zeros(0, np.intp)


def motion_covariance(current: Array, initial: Array, origin: Array, noise: Array) -> Array:
    """Covariance (6, 6), [rotation, translation] in body axes, by the noise (3, 3, 3) [m²] of the current points."""
    T = placed(current, initial, origin)
    J: Array = np.empty((6, 9))
    for column in range(9):
        moved = current.copy()
        moved[column // 3, column % 3] += _STEP
        J[:, column] = log(inverse(T) @ placed(moved, initial, origin)) / _STEP
    P: Array = np.zeros((6, 6))
    for i in range(3):
        P += J[:, 3 * i : 3 * i + 3] @ noise[i] @ J[:, 3 * i : 3 * i + 3].T
    return P


class Procedure1Detector(ObjectDetector):
    """The papers' detector in the system's place for one; the object is number 1.

    Its body frame lies in the database's origin, along the world's axes in the initial scene.
    """

    def __init__(self, rig: StereoRig, config: ObjectsConfig, models: EstimatorModels) -> None:
        self._rig, self._sigma = rig, models.pixel_sigma
        self._database = ObjectDatabase.load(Path(config.database))
        self._last: tuple[float, Array] | None = None  # stamp [s] and pose

    def restart(self) -> None:
        """The database goes on; the last pose does not."""
        self._last = None

    def step(
        self, recent: RecentPoses | None, tracks: Tracks, features: StereoFeatures, estimate: Estimate, *_: object
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Recognise the object's features and find its motion; no other feature is classified.

        The object is reported where it was measured in this frame.
        """
        d = self._database
        if d.descriptors.shape[1] != features.descriptors.shape[1]:
            raise ConfigurationError(
                f"objects: the database has descriptors of {d.descriptors.shape[1]} dimensions, the front end's have "
                f"{features.descriptors.shape[1]}"
            )
        free = np.flatnonzero(features.has_stereo)
        found = match_everywhere(d.descriptors, d.laplacian, features.select(free), *_ALIKE)
        known, rows = found.tracks, free[found.features]
        local = self._rig.triangulate(features.uv_left[rows], features.uv_right[rows])
        points = transform(estimate.T_world_left, local)
        three = detect(features, (known, rows), points, d)
        moved = np.sort(tracks.ids[(tracks.ids >= 0) & isin(tracks.row, rows)])
        labels = MotionLabels(np.sort(rows), np.zeros(0, np.intp), moved)
        if not len(three):
            return labels, ()
        R, current, initial = estimate.T_world_left[:3, :3], points[three], d.points[known[three]]
        noise = R @ self._rig.triangulation_covariance(local[three], self._sigma) @ R.T
        T, P = placed(current, initial, d.origin), motion_covariance(current, initial, d.origin, noise)
        return labels, (self._reported(labels.moving, features.stamp, T, P),)

    def _reported(self, rows: NDArray[np.intp], stamp: float, T: Array, P: Array) -> MovingObject:
        """The object at its pose T (4, 4), with its covariance P (6, 6)."""
        last, before = self._last or (stamp, T)
        step, dt = T @ inverse(before), stamp - last
        velocity = np.zeros(6) if dt <= 0 else np.concatenate([log(step)[:3], T[:3, 3] - before[:3, 3]]) / dt
        self._last = stamp, T
        none, origin = np.zeros(0, np.int64), self._database.origin
        estimate = ObjectEstimate(1, stamp, T, P, velocity, np.full((6, 6), np.nan), True, none, none)
        local = self._database.points - origin
        extent = np.stack([local.min(axis=0), local.max(axis=0)])
        since_found = T @ inverse(pose(np.eye(3), origin))
        return MovingObject(1, rows, estimate, step, since_found, extent, True, measured_at=stamp)
