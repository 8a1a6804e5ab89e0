"""Compiled loop of `slam.calibration.model`."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel


@kernel
def polynomials(x, y, centre, half, beyond, scales, first, second, out):
    """Products of Legendre polynomials at points (N,), into `out` (K, N).

    Args:
        x, y: of the points [focal lengths].
        centre, half: of the image (2,) each [focal lengths].
        beyond: half widths from the centre at which the polynomials are held.
        scales: factor of the polynomial of each degree.
        first, second: degrees (K,) in x and in y.
    """
    P = np.ones((2, len(scales)))
    for n in range(len(x)):
        for axis in range(2):
            v = ((y[n] if axis else x[n]) - centre[axis]) / half[axis]
            v = min(max(v, -beyond), beyond)
            P[axis, 1] = v
            for i in range(2, len(scales)):
                P[axis, i] = (P[axis, i - 1] * v * (2 * i - 1) - P[axis, i - 2] * (i - 1)) / i
        for k in range(len(first)):
            i, j = first[k], second[k]
            out[k, n] = (P[0, i] * scales[i]) * (P[1, j] * scales[j])
