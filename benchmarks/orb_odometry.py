"""Stereo odometry as OpenCV's tutorials have it, ORB and PnP from frame to frame: a measure of time for `frame.py`."""

from __future__ import annotations

import cv2
import numpy as np

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, pose

_ROW = 1.5  # rows [px] that a match may lie apart


class OrbOdometry:
    """ORB in both images, matches along rows and to the last frame, PnP with RANSAC.

    Args:
        rig: the rectified cameras.
        features: of an image.

    Attributes:
        T_world_left: pose (4, 4) of the left camera; it stays where a frame has too few matches.
    """

    def __init__(self, rig: StereoRig, features: int) -> None:
        self.rig = rig
        self.T_world_left: Array = np.eye(4)
        self._orb = cv2.ORB_create(features)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._last: tuple[Array, np.ndarray] | None = None  # points in the last camera's coordinates, descriptors
        camera = rig.left
        self._K = np.array([[camera.fu, 0, camera.u0], [0, camera.fv, camera.v0], [0, 0, 1.0]])

    def process(self, left: np.ndarray, right: np.ndarray) -> Array:
        """Pose (4, 4) after one more frame."""
        uv, descriptors = self._features(left)
        uv_right, descriptors_right = self._features(right)
        if self._last is not None:
            points, old = self._last
            i, j = self._matches(old, descriptors)
            if len(i) >= 6:
                cv2.setRNGSeed(0)
                found, turn, shift, _ = cv2.solvePnPRansac(points[i], uv[j], self._K, None)
                if found:
                    R = cv2.Rodrigues(turn)[0]
                    self.T_world_left = self.T_world_left @ pose(R.T, -R.T @ shift[:, 0])
        i, j = self._matches(descriptors, descriptors_right)
        near = np.abs(uv[i, 1] - uv_right[j, 1]) < _ROW
        i, j = i[near], j[near]
        points = self.rig.triangulate(uv[i], uv_right[j])
        good = np.isfinite(points).all(axis=1)
        self._last = points[good], descriptors[i[good]]
        return self.T_world_left

    def _features(self, image: np.ndarray) -> tuple[Array, np.ndarray]:
        keypoints, descriptors = self._orb.detectAndCompute(image, None)
        uv = np.array([k.pt for k in keypoints]).reshape(-1, 2)
        return uv, np.zeros((0, 32), np.uint8) if descriptors is None else descriptors

    def _matches(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not len(first) or not len(second):
            return np.zeros(0, np.intp), np.zeros(0, np.intp)
        pairs = np.array([(m.queryIdx, m.trainIdx) for m in self._matcher.match(first, second)], np.intp)
        return pairs[:, 0], pairs[:, 1]
