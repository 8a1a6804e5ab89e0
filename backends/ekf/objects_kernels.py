"""Compiled loops over a body's points."""

from __future__ import annotations

import numpy as np

from slam.kernels.stereo import by_pose
from slam.runtime.compilation import kernel


@kernel
def point_geometry(T_body_anchor, coordinates):
    """Positions of points in inverse-depth coordinates, with derivatives: see `BodyPoints` of `objects_measurement`.

    Args:
        T_body_anchor: poses (M, 4, 4) in the body of the cameras that saw them first.
        coordinates: (x/z, y/z, 1/z) (M, 3) in those cameras' frames.

    Returns:
        positions (M, 3), NaN where 1/z is not positive; their derivatives (M, 3, 3) by the coordinates; those of the
        coordinates by them (M, 3, 3); and those of the coordinates by the body's frame (M, 3, 6).
    """
    count = len(coordinates)
    positions, D = np.empty((count, 3)), np.empty((count, 3, 3))
    by_position, by_frame = np.empty((count, 3, 3)), np.empty((count, 3, 6))
    for m in range(count):
        T, a, b, w = T_body_anchor[m], coordinates[m, 0], coordinates[m, 1], coordinates[m, 2]
        positive, depth = w if w > 0 else np.nan, 1 / w
        for i in range(3):
            positions[m, i] = T[i, 0] * (a / positive) + T[i, 1] * (b / positive) + T[i, 2] / positive + T[i, 3]
            D[m, i, 0], D[m, i, 1] = T[i, 0] * depth, T[i, 1] * depth
            D[m, i, 2] = -(T[i, 0] * a + T[i, 1] * b + T[i, 2]) * depth * depth
            by_position[m, 0, i] = w * T[i, 0] - w * a * T[i, 2]
            by_position[m, 1, i] = w * T[i, 1] - w * b * T[i, 2]
            by_position[m, 2, i] = -w * w * T[i, 2]
        for i in range(3):
            by_pose(by_position[m, i], positions[m], by_frame[m, i])
    return positions, D, by_position, by_frame
