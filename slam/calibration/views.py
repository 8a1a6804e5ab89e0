"""Views of the scene for self-calibration, and what two of them have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.calibration.model import RigModel
from slam.calibration.motion import Pair, fit_motion, linearised, move
from slam.chi_square import chi_square_limit
from slam.data import StereoFeatures
from slam.geometry.arrays import median
from slam.geometry.pnp import find_consensus
from slam.geometry.se3 import Array, inverse
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import Matches, match_everywhere

_AGREES = 2.5  # largest reprojection error of a match that agrees with the motion [px]
_EACH = _AGREES / np.sqrt(2)  # the same of each coordinate in each of the two views, all equally exact


@dataclass(frozen=True, eq=False)
class View:
    """The stereo features of one frame, as measured."""

    features: StereoFeatures  # (N), rectified pixels
    points: Array  # ``(x, y, d)`` (N, 3), pixel from the principal point and disparity [px]
    T_world_left: Array  # pose of the rectified left camera (4, 4) as the system has it

    def __len__(self) -> int:
        return len(self.points)

    @property
    def vertical(self) -> Array:
        """Right row less left row (N,) [px]."""
        return self.features.uv_right[:, 1] - self.features.uv_left[:, 1]

    @classmethod
    def of(cls, model: RigModel, features: StereoFeatures, T_world_left: Array, most: int) -> View:
        """Of the strongest features as measured, in rectified pixels, `most` at the most, at a pose (4, 4)."""
        rows = np.flatnonzero(features.has_stereo)
        if len(rows) > most:
            rows = np.sort(rows[np.argsort(-features.response[rows], kind="stable")[:most]])
        kept = features.select(rows)
        return cls(kept, model.points(np.column_stack([kept.uv_left, kept.uv_right[:, 0]])), T_world_left)


def match(first: View, second: View) -> Matches:
    """Features that look alike in two views."""
    looks = first.features.descriptors, first.features.laplacian
    return match_everywhere(*looks, second.features, AssociationConfig())


def pair_of(
    model: RigModel, first: View, second: View, parameters: Array, noise: Array, seed: int, matched: Matches
) -> Pair:
    """Matches of two views that agree on one motion, and that motion.

    The motion of the system's poses is tried first; others are tried only if most matches disagree with it.

    The rig is corrected by `parameters` (n,). Of the `noise`, a point's covariance (3, 3) [px²], only the form matters.
    `seed` is of the random choice in the geometric check; `matched` are features that look alike.
    """
    one, two = first.points[matched.landmarks], second.points[matched.features]
    ideal = [p + model.shift(p, parameters) for p in (one, two)]
    T: Array = inverse(second.T_world_left) @ first.T_world_left
    # 1.0: least disparity of a point that helps to find the motion [px]
    near = (ideal[0][:, 2] > 1.0) & (ideal[1][:, 2] > 1.0)
    rig = model.rig.rectified.rig
    if near.sum() >= 3:
        before, after = (model.rows(p[near]) for p in ideal)
        local = rig.triangulate(before[:, :2], before[:, [2, 1]])
        # 100: poses tried in the geometric check of a pair of views
        found = find_consensus(rig, local, after, inverse(T), _AGREES, 100, seed)
        T = np.asarray(inverse(found.T_world_left))
    R, t = T[:3, :3], T[:3, 3] / rig.baseline
    moved, J, _ = move(ideal[0], R, t, model.focal)
    with np.errstate(invalid="ignore"):
        agree = (np.abs(moved - ideal[1]) <= _EACH * np.sqrt(1 + np.square(J).sum(axis=2))).all(axis=1)
    for _ in range(2):  # 2: times that motion and inliers are recomputed
        fitted = fit_motion(ideal[0][agree], ideal[1][agree], R, t, model.focal, noise) if agree.sum() >= 3 else None
        if fitted is None:
            break
        R, t = fitted.R, fitted.t
        distance = linearised(ideal[0], ideal[1], ideal[0], R, t, model.focal, noise).squared
        # 16.3: χ²(3) at 99.9 %, largest squared distance of a match that agrees
        agree = distance <= 16.3 * median(distance[agree]) / chi_square_limit(3, 0.5)
    return Pair(one[agree], two[agree], R, t)
