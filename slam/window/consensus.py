"""The camera's pose from landmarks of known position, where many matches are wrong: consensus, then least squares.

It tells which matches agree with one rigid motion before any estimator sees them, and gives a smoother its first guess.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.chi_square import chi_square_limit
from slam.geometry import kernels
from slam.geometry.arrays import BoolArray, IndexArray, changed, median
from slam.geometry.rig import MINIMAL_POINTS, StereoRig
from slam.geometry.se3 import Array, inverse, pose
from slam.window.gating import MIN_CONSENSUS
from slam.window.problem import Rows, Window
from slam.window.solver import STEPS, solve
from slam.window.stereo import RectifiedMeasurement, RectifiedStereo

CLEAR_MAJORITY = 0.7  #: share of the matches that agree with the guess at which no other pose is tried
_BATCH = 10  # cost: hypotheses tried at once
_ENOUGH = 100  # cost: matches that fix a pose far better than is needed to tell which others agree
_HYPOTHESES = 200  # cost: poses tried in the search for one on which the landmarks agree
_CAMERA = np.eye(3)  # fixed: of bearings, not pixels


@dataclass(frozen=True, eq=False)
class PoseConsensus:
    """A pose and the matches that agree with it."""

    T_world_left: Array  # pose (4, 4)
    inliers: BoolArray  # which matches agree (M,)


def find_consensus(
    rig: StereoRig, points: Array, measured: Array, guess: Array, threshold: float, hypotheses: int, seed: int
) -> PoseConsensus:
    """The pose with which most matches agree (RANSAC on minimal sets of three, then least squares on all that agree).

    The guess of T_world_left (4, 4) is tried first, refined on what agrees with it, then on what disagrees with it
    least, and is enough where a clear majority agrees; where none does, the second may be a pose between those of the
    world and of something that moves. The other `hypotheses` are poses from the left pixels of three matches (P3P).
    Landmarks are at `points` (M, 3) in the world [m], `measured` (M, 3) = (uL, vL, uR) [px], uR NaN for monocular rows;
    an inlier is off by `threshold` at most in each. Raises CalibrationError where the rig is not rectified.
    """
    stereo = RectifiedStereo.of(rig)
    matches = _Matches(
        stereo, np.ascontiguousarray(points, float), measured - [0.0, 0.0, stereo.doffs], threshold
    )  # fmt: skip
    clear = CLEAR_MAJORITY * len(points)
    first = matches.polished(guess)
    if first.inliers.sum() >= clear:
        return first
    nearer = matches.polished(matches.approached(guess))
    if nearer.inliers.sum() >= max(clear, float(first.inliers.sum())):
        return nearer
    hypothesis = matches.best_hypothesis(hypotheses, seed)
    if hypothesis is None:
        return first
    best = matches.polished(hypothesis)
    return best if best.inliers.sum() > first.inliers.sum() else first


def landmarks_pose(measure: RectifiedMeasurement, points: Array, z: Array, T: Array, seed: int) -> Array | None:
    """The pose (4, 4) on which most landmarks (M, 3) in the world [m] agree, by T; None if fewer than five agree.

    Measurements z (M, 3) are those of `RectifiedStereo.measure`.
    """
    sigma, probability = measure.models.pixel_sigma, measure.models.gate_probability
    threshold = sigma * float(np.sqrt(2.0 * chi_square_limit(3, probability)))  # landmarks as uncertain as new ones
    measured = z + np.array([0.0, 0.0, measure.stereo.doffs])
    found = find_consensus(measure.rig, points, measured, T, threshold, _HYPOTHESES, seed)
    return found.T_world_left if found.inliers.sum() >= max(MIN_CONSENSUS, (len(z) + 1) // 2) else None


@dataclass(frozen=True, eq=False)
class _Matches:
    """Points and what was measured of them."""

    stereo: RectifiedStereo
    points: Array  # (M, 3) in world coordinates [m]
    z: Array  # (M, 3), see `RectifiedStereo.measure`
    threshold: float  # largest error of an inlier [px]

    @cached_property
    def window(self) -> Window:
        """One pose, and all matches."""
        n = len(self.points)
        rows = Rows.of(0, np.arange(n), self.z, 1.0)
        return Window(self.stereo, np.eye(4)[None], self.points, rows, known=np.ones(n, bool))

    def errors(self, poses: Array) -> Array:
        """Largest error of uL, vL, uR (H, M) [px] of each match under each pose; NaN behind the camera."""
        return np.asarray(kernels.errors(self.stereo.intrinsics, self.points, self.z, poses))

    def agreeing(self, poses: Array) -> BoolArray:
        """Which matches (H, M) agree with each pose."""
        return np.asarray(self.errors(poses) < self.threshold)

    def fitted(self, mask: BoolArray, T: Array, steps: int = STEPS) -> Array:
        """Least-squares pose (4, 4), from T, by some of the matches; T where they do not determine it."""
        rows = np.flatnonzero(mask)
        if len(rows) > _ENOUGH:
            rows = rows[np.linspace(0, len(rows) - 1, _ENOUGH).astype(int)]
        w, root = self.window, np.zeros((len(mask), 3, 3))
        root[rows] = np.eye(3)
        try:
            return solve(w.at(T[None], w.points, changed(w.rows, root=root)), steps=steps).window.poses[0]
        except np.linalg.LinAlgError:
            return T

    def polished(self, T: Array) -> PoseConsensus:
        """Least squares on the matches that agree with a pose, repeated while their number grows."""
        inliers = self.agreeing(T[None])[0]
        for _ in range(5):  # 5: of least squares on what agrees, at most
            if inliers.sum() < MINIMAL_POINTS:
                break
            better = self.fitted(inliers, T)
            again = self.agreeing(better[None])[0]
            if again.sum() < inliers.sum():
                break
            T, grown = better, again.sum() > inliers.sum()
            inliers = again
            if not grown:
                break
        return PoseConsensus(T, inliers)

    def approached(self, T: Array) -> Array:
        """A pose (4, 4) nearer to the better half of the matches, where the guess is too far off for any."""
        for _ in range(3):  # 3: steps towards the better half of the matches, from a guess that is far off
            error = self.errors(T[None])[0]
            good = np.isfinite(error)
            if good.sum() < MINIMAL_POINTS:
                break
            T = self.fitted(good & (error <= median(error[good])), T, 2)
        return T

    def best_hypothesis(self, hypotheses: int, seed: int) -> Array | None:
        """The pose (4, 4) from three matches with which most matches agree; None where there is none.

        Stops before all hypotheses are tried where a better one is improbable (one in a hundred).
        """
        rng = np.random.default_rng(seed)
        best, most, tried = None, 0, 0
        among = np.flatnonzero(np.isfinite(self.z[:, :2]).all(axis=1))
        if len(among) < MINIMAL_POINTS:
            return None
        while tried < hypotheses:
            count = min(_BATCH, hypotheses - tried)
            triples = among[rng.random((count, len(among))).argsort(axis=1)[:, :MINIMAL_POINTS]]
            poses = self.poses_of_three(triples)
            tried += count
            if not len(poses):
                continue
            support = self.agreeing(poses).sum(axis=1)
            if support.max() > most:
                best, most = poses[int(np.argmax(support))], int(support.max())
            if (1 - (most / len(self.points)) ** MINIMAL_POINTS) ** tried < 0.01:
                break
        return best

    def poses_of_three(self, triples: IndexArray) -> Array:
        """Poses T_world_left (H, 4, 4) from left pixels of triples (K, 3) of matches: up to four each (P3P)."""
        import cv2

        bearings = (self.z[:, :2] - [self.stereo.u0, self.stereo.v0]) / self.stereo.f
        turns: list[Array] = []
        shifts: list[Array] = []
        for points, rays in zip(self.points[triples], bearings[triples]):
            _, some, there = cv2.solveP3P(points, rays, _CAMERA, None, cv2.SOLVEPNP_P3P)
            turns += [cv2.Rodrigues(turn)[0] for turn in some]
            shifts += there
        if not turns:
            return np.zeros((0, 4, 4))
        found = inverse(pose(np.array(turns), np.array(shifts)[:, :, 0]))
        return found[np.isfinite(found).all(axis=(1, 2))]
