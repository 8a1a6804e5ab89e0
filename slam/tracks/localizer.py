"""Finds landmarks in a frame: by search windows, agreement on one camera pose, and the whole map as a last resort.

The same for every back end, which supplies predictions and positions, and is given matches that agree with each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, Prediction, StereoFeatures
from slam.geometry.arrays import changed, isin, median
from slam.geometry.rig import StereoRig, measurement_rows
from slam.geometry.se3 import LEAST_VARIANCE, Array, inverse, log, transform
from slam.models import EstimatorModels
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import Matches, Windows, follow, match_everywhere
from slam.tracks.standing import Standing
from slam.tracks.step import NO_POSE, LandmarkMatches, PoseHypotheses, TrackingState
from slam.tracks.table import LandmarkTable
from slam.window.consensus import CLEAR_MAJORITY, PoseConsensus, find_consensus


@dataclass(frozen=True, eq=False)
class Localizer:
    """How landmarks are searched for in frames, and when the pose that they give is credible."""

    rig: StereoRig
    config: AssociationConfig
    models: EstimatorModels

    def similar_view(self, T_world_left: Array, seen_from: Array, positions: Array) -> BoolArray:
        """Which landmarks (N,) are seen from a pose (4, 4) at a similar angle and distance as at their first sight.

        From another viewpoint, the point that a descriptor describes shifts over the surface, and then changes. The
        camera was at `seen_from` (N, 3) [m] at first sight; where that is unknown, NaN, nothing is ruled out.
        """
        then, now = positions - seen_from, positions - T_world_left[:3, 3]
        before, after = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
        turned = np.einsum("ij,ij->i", then, now) < np.cos(np.deg2rad(self.config.view_angle)) * before * after
        ratio = self.config.view_ratio
        return np.asarray(~(turned | (after > ratio * before) | (before > ratio * after)))


@dataclass(frozen=True, eq=False)
class Search:
    """The search for landmarks in one frame."""

    localizer: Localizer
    prediction: Prediction  # of the back end
    landmarks: LandmarkTable  # the map's bookkeeping (N rows)
    positions: Array  # of the landmarks (N, 3) [m] in world coordinates
    features: StereoFeatures  # of the frame
    seed: int  # of the random choice in the geometric check

    def follow(
        self, tracking: TrackingState, standing: Standing, elsewhere: Callable[[], Array | None]
    ) -> tuple[LandmarkMatches, TrackingState, Standing]:
        """Matches, the poses doubted and believed after them, and whether the camera stands.

        `localize`, unless the camera stands in spite of the pose on which landmarks agree: then what stays is matched.
        """
        if standing.stands:
            matches = self.match()
            if matches.T_world_left is not None:
                rig, sigma = self.localizer.rig, self.localizer.models.pixel_sigma
                standing = standing.contested(rig, sigma, self.features, matches.rows, matches.T_world_left)
            if standing.stands:
                if 2 * isin(matches.rows, standing.witnesses).sum() <= len(matches):
                    staying = changed(self, features=self.features.select(standing.witnesses))
                    matches, _ = staying.match_around(standing.T_world_left)
                    matches = changed(matches, rows=standing.witnesses[matches.rows])
                if len(matches) or standing.holds(tracking.lost):
                    return matches, tracking, standing
        return *self.localize(tracking, elsewhere), standing

    def localize(
        self, tracking: TrackingState, elsewhere: Callable[[], Array | None] = lambda: None
    ) -> tuple[LandmarkMatches, TrackingState]:
        """`match`, but a pose farther from the prediction than its uncertainty allows needs proof.

        Either most of what is in view from there agrees on it, and a camera may have moved so far since its last
        measured pose; or several frames agree on it, wherever it is. Until then nothing counts as matched; in the last
        of these frames the matches have a pose, no landmarks, and the mark `kidnapped`. If nothing matches, the atlas
        is asked for a pose, which is treated likewise, but is accepted at once if the prediction allows it and enough
        landmarks match around it.
        """
        c, models, stamp = self.localizer.config, self.localizer.models, self.features.stamp
        doubtful = tracking.unmeasured > 0
        matches, farthest = self.match(doubtful), c.lost_jump if doubtful else c.max_jump
        T = matches.T_world_left
        if T is None:
            T = elsewhere()
            if T is None:
                return matches, changed(tracking, doubted=NO_POSE)
            if jump(self.prediction, T) <= farthest:
                matches, _ = self.match_around(T)
        carried = tracking.carried(T)
        if carried:  # two, so that the place does not count as unknown: it is what hides the view
            none = changed(LandmarkMatches.nothing(), doubted=len(matches))
            return none, changed(tracking, doubted=PoseHypotheses(2, stamp, T))
        hidden_at = tracking.hidden_at if carried is None else None
        allowed = jump(self.prediction, T) <= farthest
        if not allowed and tracking.believed.after(T, stamp, models).count > 1:
            around, expected = self.match_around(T)
            # 0.5: share of the landmarks in view, or of the features where these are fewer, that makes a majority
            majority = 0.5 * min(expected, len(self.features))
            allowed = len(around) >= max(majority, 2 * c.minimum_consistent)
            matches = around if allowed else matches
        if allowed and len(matches.ids):
            return matches, tracking.believing(T, stamp, hidden_at)
        doubted = tracking.doubted.after(T, stamp, models)
        if doubted.count < c.kidnapped_after:
            return changed(LandmarkMatches.nothing(), doubted=len(matches)), changed(tracking, doubted=doubted)
        nothing = changed(LandmarkMatches.nothing(), T_world_left=T, kidnapped=True)
        return nothing, tracking.believing(T, stamp)

    def match(self, doubtful: bool = False) -> LandmarkMatches:
        """Landmarks whose features agree with one camera pose.

        First in windows around the predictions. If these are wide, or too few matches agree, a pose is computed by
        consensus from the matches in windows or, without windows, against the whole map; the other landmarks are then
        searched for in small windows around the pixels that this pose predicts.

        `doubtful` says that nothing was matched in the last frame, so that a pose from the whole map needs more
        matches, see `AssociationConfig.wide_share`.
        """
        if not len(self.landmarks.ids) or not len(self.features.scale):
            return LandmarkMatches.nothing()
        c, p = self.localizer.config, self.prediction
        rows = self.landmarks.rows(p.ids)
        searched = self._searched_for(p.T_world_left)[rows]
        matches = self._in_windows(p.uv_left[searched], p.innovation[searched], rows[searched])
        consensus = self._consensus(matches, p.T_world_left)
        tight = median_deviation(p) <= c.tight_window
        least = 0.0
        if consensus.inliers.sum() < c.minimum_consistent:
            looks = self.landmarks.descriptors, self.landmarks.laplacian
            matches_wide = match_everywhere(*looks, self.features, c.wide_d_match, c.wide_ratio)
            wide = self._consensus(matches_wide, p.T_world_left, wide=True)
            if wide.inliers.sum() >= c.minimum_consistent:
                matches, consensus, tight = matches_wide, wide, False
                least = c.wide_share if doubtful else 0.0
            elif not tight:
                return LandmarkMatches.nothing()
        if not tight or consensus.inliers.sum() < CLEAR_MAJORITY * len(matches):
            again, expected = self._around(consensus.T_world_left)
            consensus_again = self._consensus(again, consensus.T_world_left)
            if consensus_again.inliers.sum() >= consensus.inliers.sum():  # the better ones of both
                matches, consensus = again, consensus_again
            if consensus.inliers.sum() < least * min(expected, len(self.features)):
                return LandmarkMatches.nothing()
        return self._agreeing(matches, consensus)

    def match_around(self, T_world_left: Array) -> tuple[LandmarkMatches, int]:
        """Landmarks in small windows around a pose (4, 4), none if too few agree, and how many were searched for."""
        matches, expected = self._around(T_world_left)
        consensus = self._consensus(matches, T_world_left)
        enough = consensus.inliers.sum() >= self.localizer.config.minimum_consistent
        return self._agreeing(matches, consensus) if enough else LandmarkMatches.nothing(), expected

    def _searched_for(self, T_world_left: Array) -> BoolArray:
        """Which landmarks (N,) are searched for in windows: those in a similar view, and those long out of view."""
        alike = self.localizer.similar_view(T_world_left, self.landmarks.seen_from, self.positions)
        return alike | self.landmarks.long_out_of_view(self.localizer.config.rematch_after)

    def _in_windows(self, uv: Array, innovation: Array, rows: NDArray[np.intp]) -> Matches:
        """Matches of the landmarks at `rows` (M,), in windows around their pixels (M, 2)."""
        looks = self.landmarks.descriptors[rows], self.landmarks.laplacian[rows]
        c = self.localizer.config
        windows = Windows(c.window_sigmas, c.d_match, c.ratio, c.window_max, c.window_min)
        pairs = follow(uv, innovation, *looks, self.features, windows)
        return Matches(rows[pairs.tracks], pairs.features)

    def _around(self, T_world_left: Array) -> tuple[Matches, int]:
        """Matches in small windows around a pose, and the number of landmarks searched for."""
        left = self.localizer.rig.left
        uv = left.project(transform(inverse(T_world_left), self.positions))
        view = np.flatnonzero(left.in_image(uv) & self._searched_for(T_world_left))
        innovation = np.tile(np.eye(2) * self.localizer.config.refined_window**2, (len(view), 1, 1))
        return self._in_windows(uv[view], innovation, view), len(view)

    def _consensus(self, matches: Matches, guess: Array, wide: bool = False) -> PoseConsensus:
        c, rows, rig = self.localizer.config, matches.features, self.localizer.rig
        if wide and len(matches) < c.minimum_consistent:
            return PoseConsensus(guess, np.zeros(len(matches), bool))
        measured = measurement_rows(self.features.uv_left[rows], self.features.uv_right[rows])
        threshold = c.consistency_sigmas * self.localizer.models.pixel_sigma
        hypotheses = c.wide_hypotheses if wide else c.hypotheses
        return find_consensus(rig, self.positions[matches.tracks], measured, guess, threshold, hypotheses, self.seed)

    def _agreeing(self, matches: Matches, consensus: PoseConsensus) -> LandmarkMatches:
        """The matches that agree with a pose, by ascending id.

        A few of many landmarks long out of view agree by chance with any pose, here with that of all others, as if the
        path had not drifted since. They count where enough for a pose are found at once, or the same in several frames.
        """
        matches = matches.select(consensus.inliers)
        if not len(matches):
            return LandmarkMatches.nothing()
        matches = matches.select(np.argsort(matches.tracks, kind="stable"))
        c, table = self.localizer.config, self.landmarks
        agreeing = LandmarkMatches(table.ids[matches.tracks], matches.features, consensus.T_world_left)
        awaited = table.long_out_of_view(c.rematch_after) & (table.returning + 1 < c.kidnapped_after)
        awaited = awaited[matches.tracks]
        if not 0 < awaited.sum() < min(c.minimum_consistent, len(agreeing)):
            return agreeing
        return changed(agreeing.select(~awaited), returning=agreeing.ids[awaited])


def jump(prediction: Prediction, T_world_left: Array) -> float:
    """Mahalanobis distance of a pose (4, 4) from the predicted one."""
    step = log(inverse(prediction.T_world_left) @ T_world_left)
    squared = step @ np.linalg.solve(prediction.covariance + LEAST_VARIANCE * np.eye(6), step)
    return float(np.sqrt(max(float(squared), 0.0)))


def median_deviation(prediction: Prediction) -> float:
    """Median over landmarks of the larger standard deviation of the innovation [px]."""
    if not len(prediction.ids):
        return float("inf")
    S = prediction.innovation
    largest = 0.5 * (S[:, 0, 0] + S[:, 1, 1]) + np.hypot(0.5 * (S[:, 0, 0] - S[:, 1, 1]), S[:, 0, 1])
    return float(np.sqrt(median(largest)))


def nowhere(stamp: float, T_world_left: Array) -> Prediction:
    """An uninformative prediction: an unknown pose, and no landmark expected anywhere."""
    none, P = np.zeros((0, 2)), np.diag(np.repeat([np.pi**2, 1e6], 3))
    return Prediction(stamp, T_world_left, P, np.zeros(0, np.int64), none, none, np.zeros((0, 2, 2)))
