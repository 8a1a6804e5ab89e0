"""Checks that a ground-truth path is possible: errors against one that is not would mean nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import TrajectoryError
from slam.geometry.trajectory import Trajectory

#: Largest coordinate of a true path [m]: the Earth's circumference.
LARGEST = 4.1e7

_ROTATION = 1e-2  # largest error of an element of RᵀR: files have six digits and more


def require_truth(path: Trajectory, source: Path) -> Trajectory:
    """The path, where every pose is a rigid motion, and the whole path not all zeros.

    Args:
        path: the true path; it may hold a single pose.
        source: file that it is from, for the message.

    Raises:
        TrajectoryError: a rotation is none (a matrix of zeros, a reflection), a position is beyond the Earth, or every
            position is exactly zero.
    """
    if not len(path):
        raise TrajectoryError(f"{source}: no pose is left")
    R, positions = path.poses[:, :3, :3], path.positions
    beyond = np.abs(positions).max(axis=1) > LARGEST
    if beyond.any():
        raise TrajectoryError(f"{source}: the position of pose {int(np.argmax(beyond))} is beyond the Earth")
    large = np.abs(R).max(axis=(1, 2)) > 1 + _ROTATION
    R = np.where(large[:, None, None], 0.0, R)
    improper = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2)) > _ROTATION
    improper |= np.linalg.det(R) < 0
    if improper.any():
        raise TrajectoryError(f"{source}: the rotation of pose {int(np.argmax(improper))} is none")
    if len(path) > 1 and not positions.any():
        raise TrajectoryError(f"{source}: every position is zero")
    return path
