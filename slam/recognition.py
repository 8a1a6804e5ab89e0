"""Which landmarks are in this frame: search windows, agreement on one camera pose, and the whole map as a last resort.

The same for every back end: a back end gives predictions and positions, and gets matches that agree with each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.association import AssociationConfig, Matches, match_everywhere, match_in_windows
from slam.data import IdArray, Prediction, StereoFeatures
from slam.landmarks import LandmarkRows
from slam.pose_solver import PoseConsensus, find_consensus, measurement_rows
from slam.rig import StereoRig
from slam.se3 import Array, inverse, transform


@dataclass(frozen=True)
class Recognition:
    """Landmarks found in a frame.

    Attributes:
        ids: landmark ids (K,), ascending.
        rows: rows of their features (K,).
        T_world_left: the pose (4, 4) on which they agree; None where there is none.
    """

    ids: IdArray
    rows: NDArray[np.intp]
    T_world_left: Array | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def nothing(cls) -> Recognition:
        """No landmark found."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp))


class Recogniser:
    """Finds landmarks in frames.

    Args:
        rig: the cameras.
        config: settings.
        pixel_sigma: noise of uL, vL, uR [px].
    """

    def __init__(self, rig: StereoRig, config: AssociationConfig, pixel_sigma: float) -> None:
        self.rig = rig
        self.config = config
        self.pixel_sigma = pixel_sigma

    def recognise(
        self, prediction: Prediction, landmarks: LandmarkRows, positions: Array, features: StereoFeatures, seed: int
    ) -> Recognition:
        """Landmarks whose features agree with one camera pose.

        In windows around the predictions first. Where these are wide, or too few matches agree, the pose on which the
        matches agree (from the windows, or from the whole map without windows) predicts anew, and small windows around
        that find the rest.

        Args:
            prediction: of the back end.
            landmarks: the map's bookkeeping (N rows).
            positions: the landmarks' positions (N, 3) in world coordinates.
            features: of the frame.
            seed: of the random choice in the geometric check.
        """
        if not len(landmarks) or not len(features):
            return Recognition.nothing()
        rows = landmarks.rows(prediction.ids)
        matches = self._in_windows(prediction, landmarks, rows, features)
        consensus = self._consensus(matches, positions, features, prediction.T_world_left, seed)
        tight = _median_deviation(prediction) <= self.config.tight_window
        if consensus.inliers.sum() < self.config.minimum_consistent:
            matches_wide = match_everywhere(landmarks.descriptors, landmarks.laplacian, features, self.config)
            wide = self._consensus(matches_wide, positions, features, prediction.T_world_left, seed, wide=True)
            if wide.inliers.sum() >= self.config.minimum_consistent:
                matches, consensus, tight = matches_wide, wide, False
            elif not tight:
                return Recognition.nothing()
        if not tight:
            matches, consensus = self._again(consensus, matches, prediction, landmarks, positions, features, seed)
        return _recognition(landmarks, matches.select(consensus.inliers), consensus.T_world_left)

    def _in_windows(
        self, prediction: Prediction, landmarks: LandmarkRows, rows: NDArray[np.intp], features: StereoFeatures
    ) -> Matches:
        """Matches by rows of the whole map."""
        found = match_in_windows(
            prediction, landmarks.descriptors[rows], landmarks.laplacian[rows], features, self.config
        )
        return Matches(rows[found.landmarks], found.features)

    def _consensus(
        self, matches: Matches, positions: Array, features: StereoFeatures, guess: Array, seed: int, wide: bool = False
    ) -> PoseConsensus:
        measured = measurement_rows(features.uv_left[matches.features], features.uv_right[matches.features])
        threshold = self.config.consistency_sigmas * self.pixel_sigma
        hypotheses = self.config.wide_hypotheses if wide else self.config.hypotheses
        return find_consensus(self.rig, positions[matches.landmarks], measured, guess, threshold, hypotheses, seed)

    def _again(
        self,
        consensus: PoseConsensus,
        matches: Matches,
        prediction: Prediction,
        landmarks: LandmarkRows,
        positions: Array,
        features: StereoFeatures,
        seed: int,
    ) -> tuple[Matches, PoseConsensus]:
        """Search once more in small windows around what the consensus pose predicts; the better of both comes back."""
        local = transform(inverse(consensus.T_world_left), positions)
        left, right = self.rig.project(local)
        view = np.flatnonzero(self.rig.left.in_image(left))
        innovation = np.tile(np.eye(2) * self.config.refined_window**2, (len(view), 1, 1))
        anew = replace(
            prediction,
            T_world_left=consensus.T_world_left,
            ids=landmarks.ids[view],
            uv_left=left[view],
            uv_right=right[view],
            innovation=innovation,
        )
        matches_anew = self._in_windows(anew, landmarks, view, features)
        consensus_anew = self._consensus(matches_anew, positions, features, consensus.T_world_left, seed)
        if consensus_anew.inliers.sum() < consensus.inliers.sum():
            return matches, consensus
        return matches_anew, consensus_anew


def _median_deviation(prediction: Prediction) -> float:
    """Median over landmarks of the larger standard deviation of the innovation [px]."""
    if not len(prediction.ids):
        return float("inf")
    return float(np.median(np.sqrt(np.linalg.eigvalsh(prediction.innovation)[:, -1])))


def _recognition(landmarks: LandmarkRows, matches: Matches, T_world_left: Array) -> Recognition:
    if not len(matches):
        return Recognition.nothing()
    order = np.argsort(matches.landmarks, kind="stable")
    return Recognition(landmarks.ids[matches.landmarks[order]], matches.features[order], T_world_left)
