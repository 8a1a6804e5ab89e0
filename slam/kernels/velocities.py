"""How a velocity changes over three successive poses, with derivatives."""

from __future__ import annotations

import numpy as np

from slam.kernels.se3 import between, rotation_vector
from slam.runtime.compilation import helper


@helper
def velocity_change(poses, i0, i1, i2, d0, d1, r, J):
    """Velocity [ω, v] between poses i1 and i2, over d1 [s], less that between i0 and i1, over d0 [s], into r (6,).

    ω is a body rate, v is in world axes. J (6, 18) are its derivatives by the perturbations of the three poses on the
    right. Where i0 is −1, the velocity itself.
    """
    a, c, Ja, Jc = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    R = np.empty((3, 4))
    for i in range(6):
        for j in range(18):
            J[i, j] = 0.0
    between(poses[i1], poses[i2], R)
    rotation_vector(R, c, Jc)  # J⁻¹; by the later pose its transpose counts, by the earlier one −J⁻¹
    for i in range(3):
        r[i] = c[i] / d1
        r[3 + i] = (poses[i2, i, 3] - poses[i1, i, 3]) / d1
        for j in range(3):
            J[i, 12 + j] = Jc[j, i] / d1
            J[i, 6 + j] = -Jc[i, j] / d1
            J[3 + i, 15 + j] = poses[i2, i, j] / d1
            J[3 + i, 9 + j] = -poses[i1, i, j] / d1
    if i0 >= 0:
        between(poses[i0], poses[i1], R)
        rotation_vector(R, a, Ja)
        for i in range(3):
            r[i] -= a[i] / d0
            r[3 + i] -= (poses[i1, i, 3] - poses[i0, i, 3]) / d0
            for j in range(3):
                J[i, 6 + j] -= Ja[j, i] / d0
                J[i, j] = Ja[i, j] / d0
                J[3 + i, 9 + j] -= poses[i1, i, j] / d0
                J[3 + i, 3 + j] = poses[i0, i, j] / d0
