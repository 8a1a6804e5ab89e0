"""What the system asks of a detector of moving objects; this one takes everything for still."""

from __future__ import annotations

import numpy as np

from slam.data import Estimate, IdArray, StereoFeatures
from slam.geometry.arrays import IndexArray
from slam.geometry.se3 import Array
from slam.interfaces import Backend
from slam.object_data import MotionLabels, MovingObject
from slam.objects.revision import CorrectRows
from slam.tracks.table import Tracks


class ObjectDetector:
    """What the system asks of a detector of moving objects in every step; by itself it takes everything for still.

    `newly_moving` and `suspects` are asked before the back end's update, `step` comes after it.
    """

    #: Number of frames for which the table of tracks keeps what it measured.
    window: int = 0
    #: Ids of landmarks that may move: they do not measure the camera's next pose.
    suspects: IdArray = np.zeros(0, np.int64)

    def newly_moving(
        self, tracks: Tracks, features: StereoFeatures, at: IndexArray, rows: IndexArray, T_world_left: Array
    ) -> IdArray:
        """Ids of landmarks that move in the run's first frames, before it is known what moves: see `suspects`.

        Args:
            tracks: the table of tracks, as the last frame left it.
            features: of the frame, before the back end's update.
            at: rows in the table of the landmarks found in it (K,).
            rows: of their features (K,).
            T_world_left: the camera's pose (4, 4), as far as it is known.
        """
        return np.zeros(0, np.int64)

    def restart(self) -> None:
        """Forget all tracks and bodies, after a kidnapping for instance; ids are not used again."""

    def revise(self, tracks: Tracks, correct: CorrectRows) -> None:
        """Take note that the rig's correction changes before the next frame.

        Args:
            tracks: the table of tracks.
            correct: takes rectified rows (uL, vL, uR) (N, 3) [px] as they were corrected before to what they are now.
        """

    def step(
        self, backend: Backend, tracks: Tracks, features: StereoFeatures, estimate: Estimate, still: IndexArray
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Say which features move, before any of them becomes a landmark, and report the bodies.

        Args:
            backend: gives the camera's last poses with their joint covariance.
            tracks: the table of tracks; landmarks that were found have their feature already. Changed in place.
            features: of the frame.
            estimate: the camera's pose after the update.
            still: rows of features that stay at their pixels while the camera stands.
        """
        none = np.zeros(0, np.intp)
        return MotionLabels(none, none, np.zeros(0, np.int64)), ()
