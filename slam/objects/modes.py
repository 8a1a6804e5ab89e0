"""What the system asks of a detector of moving objects; this one takes everything for still."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slam.data import Estimate, IdArray, StereoFeatures
from slam.geometry.arrays import IndexArray
from slam.geometry.se3 import Array
from slam.interfaces import Backend
from slam.object_data import MotionLabels, MovingObject
from slam.objects.revision import CorrectRows

#: Gives the positions (K, 3) of landmarks in the world [m] by their ids (K,).
Places = Callable[[IdArray], Array]


class ObjectDetector:
    """What the system asks of a detector of moving objects in every step; by itself it takes everything for still.

    `parting` and `suspects` are asked before the back end's update, `step` comes after it.
    """

    #: Ids of landmarks that may move: they do not measure the camera's next pose.
    suspects: IdArray = np.zeros(0, np.int64)

    def parting(
        self, features: StereoFeatures, ids: IdArray, rows: IndexArray, places: Places, T_world_left: Array
    ) -> IdArray:
        """Ids of landmarks that may have begun to move in this frame or the last ones: see `suspects`.

        Args:
            features: of the frame, before the back end's update.
            ids: of the landmarks found in it (K,).
            rows: of their features (K,).
            places: gives the positions of landmarks (K, 3) in the world [m] by their ids.
            T_world_left: the camera's pose (4, 4), as far as it is known.
        """
        return np.zeros(0, np.int64)

    def restart(self) -> None:
        """Forget all tracks and bodies, after a kidnapping for instance; ids are not used again."""

    def revise(self, correct: CorrectRows) -> None:
        """Take note that the rig's correction changes before the next frame.

        Args:
            correct: takes rectified rows (uL, vL, uR) (N, 3) [px] as they were corrected before to what they are now.
        """

    def step(
        self, backend: Backend, features: StereoFeatures, estimate: Estimate, landmark: IdArray,
        still: IndexArray,
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Say which features move, before any of them becomes a landmark, and report the bodies.

        Args:
            backend: gives the camera's last poses with their joint covariance.
            features: of the frame.
            estimate: the camera's pose after the update.
            landmark: id of the landmark that each feature was matched to (N,), -1 for none.
            still: rows of features that stay at their pixels while the camera stands.
        """
        none = np.zeros(0, np.intp)
        return MotionLabels(none, none, np.zeros(0, np.int64)), ()
