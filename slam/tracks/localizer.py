"""Matches landmarks with a frame: by search windows, agreement on one camera pose, and the whole map as a last resort.

The same for every back end, which supplies predictions and positions, and is given matches that agree with each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, Observations, Prediction, StereoFeatures, UpdateReport
from slam.geometry.arrays import isin, median
from slam.geometry.pnp import CLEAR_MAJORITY, MINIMAL_POINTS, PoseConsensus, find_consensus, measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import LEAST_VARIANCE, Array, inverse, log, transform
from slam.models import EstimatorModels
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import Matches, follow, match_everywhere
from slam.tracks.informative import most_informative
from slam.tracks.standing import Standing
from slam.tracks.state import NO_POSE, PoseHypotheses, TrackingState
from slam.tracks.table import LandmarkTable
from slam.tracks.visibility import similar_view


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """Landmarks found in a frame."""

    ids: IdArray  # landmark ids (K,), ascending
    rows: NDArray[np.intp]  # rows of their features (K,)
    T_world_left: Array | None = None  # the pose (4, 4) on which they agree, if there is one
    # the prediction's uncertainty does not allow that pose, but several frames agree on it: the camera was moved while
    # it saw nothing
    kidnapped: bool = False
    doubted: int = 0  # number of landmarks that agree on a pose which is too far from the prediction to be believed yet

    def __len__(self) -> int:
        return len(self.ids)

    def without(self, ids: IdArray) -> LandmarkMatches:
        """A copy without some landmarks."""
        return self.select(~isin(self.ids, ids))

    def joined(self, other: LandmarkMatches) -> LandmarkMatches:
        """These and others, of other landmarks."""
        ids, rows = np.concatenate([self.ids, other.ids]), np.concatenate([self.rows, other.rows])
        return replace(self, ids=ids, rows=rows)

    def select(self, rows: NDArray) -> LandmarkMatches:
        """Some of the landmarks (a mask or indices)."""
        return LandmarkMatches(self.ids[rows], self.rows[rows], self.T_world_left, doubted=self.doubted)

    def rows_of(self, ids: IdArray) -> NDArray[np.intp]:
        """Rows of the features that show landmarks, by their ids, all of which were found."""
        order = np.argsort(self.ids, kind="stable")
        return self.rows[order[np.searchsorted(self.ids, ids, sorter=order)]]

    def landmark_of(self, features: int) -> IdArray:
        """Id of the landmark matched with each of N = `features` features (N,), −1 for none."""
        ids = np.full(features, -1, np.int64)
        ids[self.rows] = self.ids
        return ids

    def observations(self, features: StereoFeatures) -> Observations:
        """The landmarks with the pixels of the features that they were matched with."""
        return Observations(self.ids, features.uv_left[self.rows], features.uv_right[self.rows])

    @classmethod
    def nothing(cls) -> LandmarkMatches:
        """No landmark found."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp))


class Localizer:
    """Finds landmarks in frames, and decides whether the pose that they give is credible.

    Args:
        rig: the cameras.
        config: settings.
        models: noise of uL, vL, uR [px], and how fast a camera may move.
        lost_after: frames without a measured pose after which a camera with an uncertain prediction is lost.
    """

    def __init__(self, rig: StereoRig, config: AssociationConfig, models: EstimatorModels, lost_after: int = 5) -> None:
        self.rig = rig
        self.config = config
        self.pixel_sigma = models.pixel_sigma
        self._models = models
        self._lost_after = lost_after

    def follow(
        self,
        prediction: Prediction,
        landmarks: LandmarkTable,
        positions: Array,
        features: StereoFeatures,
        tracking: TrackingState,
        standing: Standing,
        seed: int,
        elsewhere: Callable[[], Array | None],
    ) -> tuple[LandmarkMatches, TrackingState, Standing]:
        """Landmarks found in a frame, with which poses are doubted and believed then, and whether the camera stands.

        `localize`, unless the camera stands in spite of the pose on which landmarks agree: then what stays is matched.
        """
        if standing.stands:
            found = self.match(prediction, landmarks, positions, features, seed)
            if found.T_world_left is not None:
                standing = standing.contested(self.rig, self.pixel_sigma, features, found.rows, found.T_world_left)
            if standing.stands:
                if 2 * isin(found.rows, standing.witnesses).sum() <= len(found):
                    at, witnessed = standing.T_world_left, standing.witnessed(features)
                    found = self.match_around(at, prediction, landmarks, positions, witnessed, seed)
                    found = replace(found, rows=standing.witnesses[found.rows])
                if len(found) or standing.holds(tracking.lost):
                    return found, tracking, standing
        found, tracking = self.localize(prediction, landmarks, positions, features, tracking, seed, elsewhere)
        return found, tracking, standing

    def localize(
        self,
        prediction: Prediction,
        landmarks: LandmarkTable,
        positions: Array,
        features: StereoFeatures,
        tracking: TrackingState,
        seed: int,
        elsewhere: Callable[[], Array | None] = lambda: None,
    ) -> tuple[LandmarkMatches, TrackingState]:
        """`match`, but a pose farther from the prediction than its uncertainty allows needs proof.

        Either most of what is in view from there agrees on it, and a camera may have moved so far since its last
        measured pose; or several frames agree on it, wherever it is. Until then nothing counts as matched; in the last
        of these frames the matches have a pose, no landmarks, and the mark `kidnapped`. If nothing matches, the atlas
        is asked for a pose, which is treated likewise, but is accepted at once if the prediction allows it and enough
        landmarks match around it.
        """
        doubtful = tracking.unmatched > 0
        matches = self.match(prediction, landmarks, positions, features, seed, doubtful)
        T, farthest = matches.T_world_left, self.config.lost_jump if doubtful else self.config.max_jump
        here = prediction, landmarks, positions, features, seed
        if T is None:
            T = elsewhere()
            if T is None:
                return matches, replace(tracking, doubted=NO_POSE)
            if jump(prediction, T) <= farthest:
                matches = self.match_around(T, *here)
        carried = tracking.carried(T)
        if carried:  # two, so that the place does not count as unknown: it is what hides the view
            none = replace(LandmarkMatches.nothing(), doubted=len(matches))
            return none, replace(tracking, doubted=PoseHypotheses(2, features.stamp, T))
        hidden_at = tracking.hidden_at if carried is None else None
        allowed = jump(prediction, T) <= farthest
        if not allowed and tracking.believed.after(T, features.stamp, self._models).count > 1:
            around = self.match_around(T, *here)
            allowed = self._most_agree(around, landmarks, positions, features)
            matches = around if allowed else matches
        if allowed and len(matches):
            return matches, tracking.believing(T, features.stamp, hidden_at)
        doubted = tracking.doubted.after(T, features.stamp, self._models)
        if doubted.count < self.config.kidnapped_after:
            return replace(LandmarkMatches.nothing(), doubted=len(matches)), replace(tracking, doubted=doubted)
        nothing = replace(LandmarkMatches.nothing(), T_world_left=T, kidnapped=True)
        return nothing, tracking.believing(T, features.stamp)

    def _most_agree(
        self, matches: LandmarkMatches, landmarks: LandmarkTable, positions: Array, features: StereoFeatures
    ) -> bool:
        """Whether most of the landmarks in view from a pose agree on it, or of the features where these are fewer."""
        if matches.T_world_left is None:
            return False
        view = self.rig.left.in_image(self.rig.left.project(transform(inverse(matches.T_world_left), positions)))
        shown = view & self._looked_for(matches.T_world_left, landmarks, positions)
        # 0.5: share of what is in view that makes a majority
        enough = max(0.5 * min(int(shown.sum()), len(features)), 2 * self.config.minimum_consistent)
        return len(matches) >= enough

    def informative(
        self, prediction: Prediction, matches: LandmarkMatches, positions: Array, dt: float
    ) -> tuple[LandmarkMatches, IdArray]:
        """The matches at `positions` (K, 3) [m] to give to the back end, and the ids of the others."""
        most = self.config.measured
        if not most or len(matches) <= most or not np.isfinite(dt):
            return matches, matches.ids[:0]
        rows = most_informative(self.rig, self._models, prediction, matches.ids, positions, dt, most)
        others = np.setdiff1d(matches.ids, matches.ids[rows])
        return matches.without(others), others

    def state_after(
        self,
        tracking: TrackingState,
        prediction: Prediction,
        features: StereoFeatures,
        matches: LandmarkMatches,
        report: UpdateReport,
        stands: bool,
    ) -> TrackingState:
        """The tracking state after a frame, by whether its pose was measured.

        It was not measured if the back end used less than half of the landmarks that agree with each other; a lost
        camera must match more landmarks than a tracked one. A frame whose pose agrees with the last frame's, but
        awaits a third one, does not count as showing an unknown place.
        """
        least = self.config.minimum_consistent if tracking.lost else MINIMAL_POINTS
        measured = len(report.used) >= least and 2 * len(report.used) >= len(matches)
        uncertain = median_deviation(prediction) > self.config.tight_window
        enough = 0 if tracking.doubted.count > 1 else int(features.has_stereo.sum())
        return tracking.after(measured, stands, uncertain, enough, self._lost_after)

    def match(
        self,
        prediction: Prediction,
        landmarks: LandmarkTable,
        positions: Array,
        features: StereoFeatures,
        seed: int,
        doubtful: bool = False,
    ) -> LandmarkMatches:
        """Landmarks whose features agree with one camera pose.

        First in windows around the predictions. If these are wide, or too few matches agree, a pose is computed by
        consensus from the matches in windows or, without windows, against the whole map; the other landmarks are then
        searched for in small windows around the pixels that this pose predicts.

        Args:
            prediction: of the back end.
            landmarks: the map's bookkeeping (N rows).
            positions: the landmarks' positions (N, 3) in world coordinates.
            features: of the frame.
            seed: of the random choice in the geometric check.
            doubtful: nothing was matched in the last frame, so that a pose from the whole map needs more matches, see
                `AssociationConfig.wide_share`.
        """
        if not len(landmarks) or not len(features):
            return LandmarkMatches.nothing()
        rows = landmarks.rows(prediction.ids)
        looked_for = self._looked_for(prediction.T_world_left, landmarks, positions)[rows]
        matches = self._in_windows(_select(prediction, looked_for), landmarks, rows[looked_for], features)
        consensus = self._consensus(matches, positions, features, prediction.T_world_left, seed)
        tight = median_deviation(prediction) <= self.config.tight_window
        least = 0.0
        if consensus.inliers.sum() < self.config.minimum_consistent:
            matches_wide = match_everywhere(landmarks.descriptors, landmarks.laplacian, features, self.config)
            wide = self._consensus(matches_wide, positions, features, prediction.T_world_left, seed, wide=True)
            if wide.inliers.sum() >= self.config.minimum_consistent:
                matches, consensus, tight = matches_wide, wide, False
                least = self.config.wide_share if doubtful else 0.0
            elif not tight:
                return LandmarkMatches.nothing()
        if not tight or consensus.inliers.sum() < CLEAR_MAJORITY * len(matches):
            expected = self._expected(consensus.T_world_left, prediction, landmarks, positions)
            matches, consensus = self._again(consensus, matches, expected, landmarks, positions, features, seed)
            if consensus.inliers.sum() < least * min(len(expected.ids), len(features)):
                return LandmarkMatches.nothing()
        return _matches_of(landmarks, matches.select(consensus.inliers), consensus.T_world_left)

    def match_around(
        self,
        T_world_left: Array,
        prediction: Prediction,
        landmarks: LandmarkTable,
        positions: Array,
        features: StereoFeatures,
        seed: int,
    ) -> LandmarkMatches:
        """Match landmarks in small windows around a known pose (4, 4); nothing if too few of them agree."""
        expected = self._expected(T_world_left, prediction, landmarks, positions)
        matches = self._in_windows(expected, landmarks, landmarks.rows(expected.ids), features)
        consensus = self._consensus(matches, positions, features, T_world_left, seed)
        if consensus.inliers.sum() < self.config.minimum_consistent:
            return LandmarkMatches.nothing()
        return _matches_of(landmarks, matches.select(consensus.inliers), consensus.T_world_left)

    def similar_view(self, T_world_left: Array, landmarks: LandmarkTable, positions: Array) -> BoolArray:
        """Which landmarks (N,) at `positions` are seen from this pose (4, 4) much as they were at first sight."""
        limits = self.config.view_angle, self.config.view_ratio
        return similar_view(positions, landmarks.seen_from, T_world_left[:3, 3], *limits)

    def _looked_for(self, T_world_left: Array, landmarks: LandmarkTable, positions: Array) -> BoolArray:
        """Which landmarks (N,) are searched for in windows: those in a similar view, and those long out of view."""
        alike = self.similar_view(T_world_left, landmarks, positions)
        return alike | landmarks.long_out_of_view(self.config.rematch_after)

    def _in_windows(
        self, prediction: Prediction, landmarks: LandmarkTable, rows: NDArray[np.intp], features: StereoFeatures
    ) -> Matches:
        """Matches by rows of the whole map."""
        looks = landmarks.descriptors, landmarks.laplacian
        return follow(prediction.uv_left, prediction.innovation, *looks, features, self.config, rows)

    def _consensus(
        self, matches: Matches, positions: Array, features: StereoFeatures, guess: Array, seed: int, wide: bool = False
    ) -> PoseConsensus:
        """The pose on which matches agree."""
        rows, points = matches.features, positions[matches.landmarks]
        measured = measurement_rows(features.uv_left[rows], features.uv_right[rows])
        threshold = self.config.consistency_sigmas * self.pixel_sigma
        if wide and len(matches) < self.config.minimum_consistent:
            return PoseConsensus(guess, np.zeros(len(matches), bool))
        hypotheses = self.config.wide_hypotheses if wide else self.config.hypotheses
        return find_consensus(self.rig, points, measured, guess, threshold, hypotheses, seed)

    def _expected(
        self, T_world_left: Array, prediction: Prediction, landmarks: LandmarkTable, positions: Array
    ) -> Prediction:
        """The prediction for another pose, with small windows."""
        left, right = self.rig.project(transform(inverse(T_world_left), positions))
        looked_for = self._looked_for(T_world_left, landmarks, positions)
        view = np.flatnonzero(self.rig.left.in_image(left) & looked_for)
        innovation = np.tile(np.eye(2) * self.config.refined_window**2, (len(view), 1, 1))
        return replace(
            prediction,
            T_world_left=T_world_left,
            ids=landmarks.ids[view],
            uv_left=left[view],
            uv_right=right[view],
            innovation=innovation,
        )

    def _again(
        self,
        consensus: PoseConsensus,
        matches: Matches,
        expected: Prediction,
        landmarks: LandmarkTable,
        positions: Array,
        features: StereoFeatures,
        seed: int,
    ) -> tuple[Matches, PoseConsensus]:
        """Search again in small windows around the consensus pose's predictions; returns the better matches of both."""
        matches_again = self._in_windows(expected, landmarks, landmarks.rows(expected.ids), features)
        consensus_again = self._consensus(matches_again, positions, features, consensus.T_world_left, seed)
        if consensus_again.inliers.sum() < consensus.inliers.sum():
            return matches, consensus
        return matches_again, consensus_again


def _select(prediction: Prediction, keep: BoolArray) -> Prediction:
    """Some of the landmarks of a prediction."""
    p = prediction
    return replace(
        p, ids=p.ids[keep], uv_left=p.uv_left[keep], uv_right=p.uv_right[keep], innovation=p.innovation[keep]
    )


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


def _matches_of(landmarks: LandmarkTable, matches: Matches, T_world_left: Array) -> LandmarkMatches:
    if not len(matches):
        return LandmarkMatches.nothing()
    order = np.argsort(matches.landmarks, kind="stable")
    return LandmarkMatches(landmarks.ids[matches.landmarks[order]], matches.features[order], T_world_left)


def nowhere(stamp: float, T_world_left: Array) -> Prediction:
    """An uninformative prediction: an unknown pose, and no landmark expected anywhere."""
    none, P = np.zeros((0, 2)), np.diag(np.repeat([np.pi**2, 1e6], 3))
    return Prediction(stamp, T_world_left, P, np.zeros(0, np.int64), none, none, np.zeros((0, 2, 2)))
