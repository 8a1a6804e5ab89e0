"""How a velocity changes over three successive poses, with derivatives, and its part of normal equations."""

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


@helper
def add_velocity_rows(J, r, triple, column, H, b):
    """Add whitened rows J (6, 18), r (6,) of the poses `triple` to normal equations (lower triangle of H, and b).

    `column` (K,) are the poses' first unknowns; a pose that is −1, or has none, is left out.
    """
    for p in range(3):
        at = -1 if triple[p] < 0 else column[triple[p]]
        if at < 0:
            continue
        for i in range(6):
            for k in range(6):
                b[at + i] -= J[k, 6 * p + i] * r[k]
        for o in range(3):
            to = -1 if triple[o] < 0 else column[triple[o]]
            if to < 0 or to > at:
                continue
            for i in range(6):
                for j in range(6 if to < at else i + 1):
                    for k in range(6):
                        H[at + i, to + j] += J[k, 6 * p + i] * J[k, 6 * o + j]
