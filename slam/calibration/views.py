"""Views of the scene for self-calibration, and what two of them have in common."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slam.calibration.model import RigModel
from slam.calibration.motion import Pair, fit_motion, linearised, move
from slam.chi_square import chi_square_limit
from slam.data import StereoFeatures
from slam.geometry.arrays import median
from slam.geometry.pnp import find_consensus
from slam.geometry.se3 import Array, inverse

_RATIO = 0.8  # largest ratio of the best to the second best descriptor distance
_AGREES = 2.5  # largest reprojection error of a match that agrees with the motion [px]
_EACH = _AGREES / np.sqrt(2)  # the same of each coordinate in each of the two views, all equally exact


#: Rows of features in one view and in another, in pairs.
Rows = tuple[NDArray[np.intp], NDArray[np.intp]]
NO_MATCHES: Rows = (np.zeros(0, np.intp), np.zeros(0, np.intp))


@dataclass(frozen=True, eq=False)
class View:
    """The stereo features of one frame, as measured."""

    points: Array  # ``(x, y, d)`` (N, 3), rectified pixel from the principal point and disparity [px]
    vertical: Array  # right row less left row (N,) [px]
    descriptors: NDArray[np.float32]  # (N, D)
    laplacian: NDArray[np.int8]  # (N,)
    T_world_left: Array  # pose of the rectified left camera (4, 4) as the system has it

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def by_sign(self) -> dict[int, tuple[NDArray[np.intp], NDArray[np.float32]]]:
        """Rows and descriptors of the features with each sign of the Laplacian."""
        rows = {int(sign): np.flatnonzero(self.laplacian == sign) for sign in np.unique(self.laplacian)}
        return {sign: (of_sign, self.descriptors[of_sign]) for sign, of_sign in rows.items()}

    @classmethod
    def of(cls, model: RigModel, features: StereoFeatures, T_world_left: Array, most: int) -> View:
        """Of the strongest features as measured, in rectified pixels, `most` at the most, at a pose (4, 4)."""
        rows = np.flatnonzero(features.has_stereo)
        if len(rows) > most:
            rows = np.sort(rows[np.argsort(-features.response[rows], kind="stable")[:most]])
        left, right = features.uv_left[rows], features.uv_right[rows]
        points = model.points(np.column_stack([left, right[:, 0]]))
        return cls(points, right[:, 1] - left[:, 1], features.descriptors[rows], features.laplacian[rows], T_world_left)


def match(first: View, second: View) -> Rows:
    """Rows of features matched in two views: mutual nearest neighbours that pass the ratio test."""
    if min(len(first), len(second)) < 2 or not first.descriptors.shape[1]:
        return NO_MATCHES
    found = []
    for sign, (rows, looks) in first.by_sign.items():
        if sign in second.by_sign:
            others, other_looks = second.by_sign[sign]
            i, j = _nearest(looks, other_looks)
            found.append((rows[i], others[j]))
    a, b = (np.concatenate([pair[k] for pair in found] or [np.zeros(0, np.intp)]) for k in (0, 1))
    order = np.argsort(a)
    return a[order], b[order]


def _nearest(first: NDArray[np.float32], second: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """`match` of unit descriptors (N, D) and (M, D), with the same sign of the Laplacian."""
    likeness = first @ second.T
    every, best = np.arange(len(first)), likeness.argmax(axis=1)
    nearest, most = likeness[every, best], likeness.max(axis=0)
    likeness[every, best] = -1.0
    clear = 1 - nearest < _RATIO**2 * (1 - likeness.max(axis=1))  # of unit vectors, |a - b|² = 2 (1 - a·b)
    rows = np.flatnonzero((nearest == most[best]) & clear)
    first = np.empty(len(second), np.intp)
    first[best[rows[::-1]]] = rows[::-1]
    rows = rows[first[best[rows]] == rows]  # of equally near ones, the first
    return rows, best[rows]


def pair_of(
    model: RigModel, first: View, second: View, parameters: Array, noise: Array, seed: int, matched: Rows
) -> Pair:
    """Matches of two views that agree on one motion, and that motion.

    The motion of the system's poses is tried first; others are tried only if most matches disagree with it.

    The rig is corrected by `parameters` (n,). Of the `noise`, a point's covariance (3, 3) [px²], only the form matters.
    `seed` is of the random choice in the geometric check; `matched` are features that look alike.
    """
    one, two = first.points[matched[0]], second.points[matched[1]]
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
