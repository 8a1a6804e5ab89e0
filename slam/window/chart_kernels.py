"""Charts of inverse distance, in which a point's error is Gaussian: with c the centre, ``p = c + B (α, β, 1) / ρ``.

What a camera near c measures is almost linear in (α, β, ρ), however far the point. `place` (N,) is what each point is
to the solver, see `slam.window.kernels`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import row_times
from slam.kernels.se3 import transform_back
from slam.kernels.stereo import by_pose
from slam.runtime.compilation import helper, kernel

NEAR = 1e-6  # numerics: no distance below this [m] is inverted


@helper
def charts(poses, centre, points, place, basis):
    """Derivatives E (N, 3, 3) of all points by their charts' coordinates (α, β, ρ).

    A point of the prior has the prior's chart, centred at the first pose; any other has one about its own
    direction from the pose `centre`.
    """
    E, e = np.empty((len(points), 3, 3)), np.empty((3, 3))
    s, q, n = np.empty(3), np.empty(3), np.empty(3)
    for m in range(len(points)):
        if place[m] >= 0:
            T, B = poses[0], basis[place[m]]
            transform_back(T, points[m], q)
            for i in range(3):
                s[i] = B[0, i] * q[0] + B[1, i] * q[1] + B[2, i] * q[2]
                for j in range(3):
                    e[i, j] = T[i, 0] * B[0, j] + T[i, 1] * B[1, j] + T[i, 2] * B[2, j]
            r, a, b = s[2], s[0] / s[2], s[1] / s[2]
        else:
            r = 0.0
            for i in range(3):
                n[i] = points[m, i] - poses[centre, i, 3]
                r += n[i] * n[i]
            r = max(np.sqrt(r), NEAR)
            for i in range(3):
                n[i] /= r
            _basis(n, e)
            a, b = 0.0, 0.0
        for i in range(3):
            E[m, i, 0], E[m, i, 1] = e[i, 0] * r, e[i, 1] * r
            E[m, i, 2] = -(e[i, 2] + a * e[i, 0] + b * e[i, 1]) * r * r
    return E


@helper
def chart(T, point, basis, origin, q, s, D):
    """Coordinates s = (α, β, ρ) less `origin` (3,) of a point from a pose T; D (3, 3) are derivatives by Rᵀ (p − t).

    Returns whether the point is in the half space that the chart covers.
    """
    transform_back(T, point, q)
    x = basis[0, 0] * q[0] + basis[1, 0] * q[1] + basis[2, 0] * q[2]
    y = basis[0, 1] * q[0] + basis[1, 1] * q[1] + basis[2, 1] * q[2]
    r = basis[0, 2] * q[0] + basis[1, 2] * q[1] + basis[2, 2] * q[2]
    if not r > NEAR:
        return False
    w = 1.0 / r
    s[0], s[1], s[2] = x * w - origin[0], y * w - origin[1], w - origin[2]
    for j in range(3):
        D[0, j] = (basis[j, 0] - x * w * basis[j, 2]) * w
        D[1, j] = (basis[j, 1] - y * w * basis[j, 2]) * w
        D[2, j] = -basis[j, 2] * w * w
    return True


@helper
def _basis(n, e):
    """Columns of e (3, 3): two axes across the unit vector n, and n."""
    k = 0
    if abs(n[1]) < abs(n[k]):
        k = 1
    if abs(n[2]) < abs(n[k]):
        k = 2
    # across both n and the axis that it is least along
    size = 0.0
    for i in range(3):
        e[i, 2] = n[i]
        e[i, 0] = (1.0 if i == k else 0.0) - n[k] * n[i]
        size += e[i, 0] * e[i, 0]
    size = 1.0 / np.sqrt(size)
    for i in range(3):
        e[i, 0] *= size
    e[0, 1] = n[1] * e[2, 0] - n[2] * e[1, 0]
    e[1, 1] = n[2] * e[0, 0] - n[0] * e[2, 0]
    e[2, 1] = n[0] * e[1, 0] - n[1] * e[0, 0]


@kernel
def relative_charts(T, points):
    """Charts about the directions of points from a pose T: bases (N, 3, 3) in its axes, and coordinates (N, 3)."""
    B, s, q = np.empty((len(points), 3, 3)), np.zeros((len(points), 3)), np.empty(3)
    for m in range(len(points)):
        transform_back(T, points[m], q)
        r = max(np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]), NEAR)
        for i in range(3):
            q[i] /= r
        _basis(q, B[m])
        s[m, 2] = 1.0 / r
    return B, s


@helper
def displace(p, E, d, out):
    """The point after a step d of its chart: its inverse distance is changed, not its distance.

    With ``E = [e₁ r, e₂ r, −u r²]`` and u the point's direction: ``p + (E₀ d₀ + E₁ d₁ + E₂ d₂) / (1 + r d₂)``. The
    distance grows tenfold at most.
    """
    r = np.sqrt(E[0, 0] * E[0, 0] + E[1, 0] * E[1, 0] + E[2, 0] * E[2, 0])
    scale = max(1.0 + r * d[2], 0.1)
    for i in range(3):
        out[i] = p[i] + (E[i, 0] * d[0] + E[i, 1] * d[1] + E[i, 2] * (scale - 1.0) / r) / scale


@kernel
def chart_changes(T, points, basis, E):
    """How coordinates in charts `basis` (D, 3, 3) from a pose T (4, 4) change with those of other charts, and with T.

    Returns present coordinates (D, 3), derivatives (D, 3, 3) by the coordinates of which E are the points' derivatives,
    and (D, 3, 6) by the pose; NaN for a point behind its chart.
    """
    origin, change, by = np.empty((len(points), 3)), np.empty((len(points), 3, 3)), np.empty((len(points), 3, 6))
    q, D, zero, row = np.empty(3), np.empty((3, 3)), np.zeros(3), np.empty(3)
    for d in range(len(points)):
        if not chart(T, points[d], basis[d], zero, q, origin[d], D):
            origin[d] = np.nan
            D[:] = np.nan
        for i in range(3):
            by_pose(D[i], q, by[d, i])
            for k in range(3):
                row[k] = row_times(T, k, D[i])
            for j in range(3):
                change[d, i, j] = row[0] * E[d, 0, j] + row[1] * E[d, 1, j] + row[2] * E[d, 2, j]
    return origin, change, by
