"""The camera's pose from landmarks of known position: robust consensus and least squares on reprojection errors.

It tells which matches agree with one rigid motion before any estimator sees them, and gives a smoother its first guess.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.arrays import BoolArray, median
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse

#: fixed: Stereo points that fix a pose.
MINIMAL_POINTS = 3

CLEAR_MAJORITY = 0.7  #: share of the matches that agree with the guess at which no other pose is tried
STEPS = 10  #: numerics: of Gauss-Newton at most, from the last pose; it converges quadratically
_BATCH = 50  # cost: hypotheses tried at once
_ENOUGH = 100  # cost: matches that fix a pose far better than is needed to tell which others agree
_CONVERGED = 1e-4  # numerics: step [rad], [m] after which the pose has converged, to far less than that


@dataclass(frozen=True, eq=False)
class PoseConsensus:
    """A pose and the matches that agree with it."""

    T_world_left: Array  # pose (4, 4)
    inliers: BoolArray  # which matches agree (M,)


def measurement_rows(uv_left: Array, uv_right: Array) -> Array:
    """Stereo measurements (M, 3) = (uL, vL, uR); uR is NaN where there is no right pixel."""
    return np.concatenate([uv_left, uv_right[:, :1]], axis=1)


def find_consensus(
    rig: StereoRig, points: Array, measured: Array, guess: Array, threshold: float, hypotheses: int, seed: int
) -> PoseConsensus:
    """The pose with which most matches agree (RANSAC on minimal sets of three, then least squares on all that agree).

    The guess is tried first, refined on what agrees with it, then on what disagrees with it least, and is enough where
    a clear majority agrees. Other hypotheses are rigid fits of three triangulated points, refined on their reprojection
    errors; where most matches have no right pixel, poses from three left pixels (P3P).

    Args:
        rig: the rectified pair.
        points: landmark positions (M, 3) in world coordinates [m].
        measured: (M, 3) = (uL, vL, uR), uR NaN for monocular rows.
        guess: expected pose T_world_left (4, 4).
        threshold: largest reprojection error of an inlier, on each of uL, vL, uR [px].
        hypotheses: how many minimal sets are tried.
        seed: of the random choice.
    """
    clear = CLEAR_MAJORITY * len(points)
    first = _polish(rig, points, measured, guess, threshold)
    if first.inliers.sum() >= clear:
        return first
    nearer = _polish(rig, points, measured, _approach(rig, points, measured, guess), threshold)
    if nearer.inliers.sum() >= max(clear, float(first.inliers.sum())):
        return nearer
    if len(points) < MINIMAL_POINTS:
        return first
    hypothesis = _best_hypothesis(rig, points, measured, threshold, hypotheses, seed)
    if hypothesis is None:
        return first
    best = _polish(rig, points, measured, hypothesis, threshold)
    return best if best.inliers.sum() > first.inliers.sum() else first


def _best_hypothesis(
    rig: StereoRig, points: Array, measured: Array, threshold: float, hypotheses: int, seed: int
) -> Array | None:
    """The pose (4, 4) from three matches with which most matches agree; None where there is none.

    Stops before all hypotheses are tried where a better one is improbable (one in a hundred).
    """
    rng = np.random.default_rng(seed)
    best, most, tried = None, 0, 0
    stereo = np.flatnonzero(np.isfinite(measured).all(axis=1))
    in_stereo = len(stereo) >= max(MINIMAL_POINTS, 0.5 * len(points))
    among = stereo if in_stereo else np.flatnonzero(np.isfinite(measured[:, :2]).all(axis=1))
    if len(among) < MINIMAL_POINTS:
        return None
    minimal_poses = _minimal_poses if in_stereo else _left_poses
    while tried < hypotheses:
        count = min(_BATCH, hypotheses - tried)
        triples = among[rng.random((count, len(among))).argsort(axis=1)[:, :MINIMAL_POINTS]]
        poses = minimal_poses(rig, points, measured, triples)
        tried += _BATCH
        if not len(poses):
            continue
        support = _agreement(rig, points, measured, poses, threshold).sum(axis=1)
        if support.max() > most:
            best, most = poses[int(np.argmax(support))], int(support.max())
        if (1 - (most / len(points)) ** MINIMAL_POINTS) ** tried < 0.01:
            break
    return best


def _polish(rig: StereoRig, points: Array, measured: Array, T: Array, threshold: float) -> PoseConsensus:
    """Least squares on the matches that agree with a pose, repeated while their number grows."""
    inliers = _agreement(rig, points, measured, T[None], threshold)[0]
    for _ in range(5):  # 5: of least squares on what agrees, at most
        if inliers.sum() < MINIMAL_POINTS:
            break
        better = _refined(rig, points, measured, _some(inliers)[None], T[None], STEPS)[0]
        again = _agreement(rig, points, measured, better[None], threshold)[0]
        if again.sum() < inliers.sum():
            break
        T, grown = better, again.sum() > inliers.sum()
        inliers = again
        if not grown:
            break
    return PoseConsensus(T, inliers)


def _approach(rig: StereoRig, points: Array, measured: Array, T: Array) -> Array:
    """A pose (4, 4) nearer to the better half of the matches, where the guess is too far off for any."""
    for _ in range(3):  # 3: steps towards the better half of the matches, from a guess that is far off
        error = _errors(rig, points, measured, T[None])[0]
        good = np.isfinite(error)
        if good.sum() < MINIMAL_POINTS:
            break
        rows = _some(good & (error <= median(error[good])))
        T = _refined(rig, points, measured, rows[None], T[None], 2)[0]
    return T


def _some(mask: BoolArray) -> NDArray[np.intp]:
    """Rows of a mask; evenly chosen ones where they are more than a pose needs."""
    rows = np.flatnonzero(mask)
    if len(rows) <= _ENOUGH:
        return rows
    return rows[np.linspace(0, len(rows) - 1, _ENOUGH).astype(int)]


def _refined(rig: StereoRig, points: Array, measured: Array, rows: NDArray[np.intp], T: Array, steps: int) -> Array:
    """Least-squares poses (H, 4, 4) from poses T, each by the matches `rows` (H, K)."""
    from slam.geometry.kernels import gauss_newton

    T, one, none, camera = T.copy(), np.eye(3)[None], np.zeros((6, 6)), rig.rectified_parameters
    gauss_newton(camera, points, measured, one, rows, none, none[0], T, np.inf, steps, _CONVERGED)
    return T


def _minimal_poses(rig: StereoRig, points: Array, measured: Array, triples: NDArray[np.intp]) -> Array:
    """Poses (H, 4, 4) from triples (K, 3) of stereo matches."""
    uv_right = np.stack([measured[:, 2], measured[:, 1]], axis=1)
    local = rig.triangulate(measured[:, :2], uv_right)
    good = np.isfinite(local[triples]).all(axis=(1, 2))
    triples = triples[good]
    if not len(triples):
        return np.zeros((0, 4, 4))
    # 3: Gauss-Newton steps on each minimal set
    poses = _refined(rig, points, measured, triples, rigid_fit(local[triples], points[triples]), 3)
    return poses[np.isfinite(poses).all(axis=(1, 2))]


def _left_poses(rig: StereoRig, points: Array, measured: Array, triples: NDArray[np.intp]) -> Array:
    """Poses (H, 4, 4) from the left pixels of triples (K, 3) of matches: up to four of each (P3P)."""
    import cv2

    bearings = rig.left.normalise(measured[:, :2])
    poses = []
    for three in triples:
        _, turns, shifts = cv2.solveP3P(points[three], bearings[three], np.eye(3), None, cv2.SOLVEPNP_P3P)
        for turn, shift in zip(turns, shifts):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
            poses.append(inverse(T))
    poses_left = np.array(poses).reshape(-1, 4, 4)
    return poses_left[np.isfinite(poses_left).all(axis=(1, 2))]


def rigid_fit(source: Array, target: Array) -> Array:
    """Least-squares rigid motions (H, 4, 4) taking points (H, K, 3) to points (H, K, 3) (Kabsch, Umeyama 1991)."""
    mean_s, mean_t = source.mean(axis=1), target.mean(axis=1)
    covariance = np.swapaxes(target - mean_t[:, None], 1, 2) @ (source - mean_s[:, None])
    U, _, Vt = np.linalg.svd(covariance)
    sign = np.ones((len(source), 3))
    sign[:, 2] = np.linalg.det(U @ Vt)
    R = (U * sign[:, None, :]) @ Vt
    T = np.tile(np.eye(4), (len(source), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = mean_t - (R @ mean_s[..., None])[..., 0]
    return T


def _agreement(rig: StereoRig, points: Array, measured: Array, T: Array, threshold: float) -> BoolArray:
    """Which matches (H, M) reproject within `threshold` [px] under each pose."""
    with np.errstate(invalid="ignore"):
        return np.asarray(_errors(rig, points, measured, T) < threshold)


def _errors(rig: StereoRig, points: Array, measured: Array, T: Array) -> Array:
    """Largest error of uL, vL, uR (H, M) [px] of each match under each pose; NaN behind the camera."""
    from slam.geometry.kernels import errors

    return np.asarray(errors(rig.rectified_parameters, points, measured, T))
