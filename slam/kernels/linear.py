"""Linear algebra of small matrices; of symmetric ones only the lower triangle is read."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import disjoint_vector_helper, helper


@helper
def factorise(M, n):
    """``M = L D Lᵀ`` (n, n) in place of its lower triangle: L below the diagonal, D on it.

    ``M_ij ← M_ij − Σ_h<j L_ih L_jh D_h`` and, below the diagonal, ``L_ij = M_ij / D_j``.
    """
    for i in range(n):
        for j in range(i + 1):
            value = M[i, j]
            for h in range(j):
                value -= M[i, h] * M[j, h] * M[h, h]
            M[i, j] = value if i == j else value / M[j, j]


@helper
def solve_factorised(M, n, v):
    """``M⁻¹ v`` in place of v (n,), where M has been through `factorise`."""
    for i in range(n):
        value = v[i]
        for h in range(i):
            value -= M[i, h] * v[h]
        v[i] = value
    for i in range(n - 1, -1, -1):
        value = v[i] / M[i, i]
        for h in range(i + 1, n):
            value -= M[h, i] * v[h]
        v[i] = value


@helper
def median(values):
    """The median of numbers (n,), at least one, whose order is changed: by selection, as Hoare's.

    NumPy's takes a second to compile.
    """
    low, high, middle = 0, len(values) - 1, len(values) // 2
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        low, high = i if middle >= i else low, j if middle <= j else high
        if j < middle < i:
            break
    below = values[middle]
    if len(values) % 2 == 0:
        below = values[0]
        for k in range(1, middle):
            below = max(below, values[k])
    return 0.5 * (below + values[middle])


@helper
def cholesky(M, U):
    """``M = Uᵀ U`` (n, n), of which U is filled in above its diagonal; whether M is positive definite.

    NumPy's raises an exception, which leaves a kernel's arrays behind in memory. Two rows at a time less four others:
    what is loaded once serves twice.
    """
    n = len(M)
    for j in range(n):
        for i in range(j, n):
            U[j, i] = M[i, j]
    for j in range(0, n, 2):
        h, end = 0, min(n, j + 2)
        while end == j + 2 and h + 4 <= j:
            _subtract_four(
                U[j, j:], U[j + 1, j:], U[h, j:], U[h + 1, j:], U[h + 2, j:], U[h + 3, j:],
                (U[h, j], U[h + 1, j], U[h + 2, j], U[h + 3, j]),
                (U[h, j + 1], U[h + 1, j + 1], U[h + 2, j + 1], U[h + 3, j + 1]),
            )  # fmt: skip
            h += 4
        for row in range(j, end):
            for k in range(h, row):
                for i in range(row, n):
                    U[row, i] -= U[k, row] * U[k, i]
            if not U[row, row] > 0.0:
                return False
            root = np.sqrt(U[row, row])
            for i in range(row, n):
                U[row, i] /= root
        if end == j + 2:
            U[j + 1, j] = 0.0
    return True


@disjoint_vector_helper
def _subtract_four(v, w, x0, x1, x2, x3, a, b):
    """``v − Σ a_h x_h`` and ``w − Σ b_h x_h``, in place."""
    a0, a1, a2, a3 = a
    b0, b1, b2, b3 = b
    for i in range(len(v)):
        y0, y1, y2, y3 = x0[i], x1[i], x2[i], x3[i]
        v[i] -= a0 * y0 + a1 * y1 + a2 * y2 + a3 * y3
        w[i] -= b0 * y0 + b1 * y1 + b2 * y2 + b3 * y3


@disjoint_vector_helper
def subtract(v, x, row):
    """``v − x row`` (n,), in place."""
    for j in range(len(v)):
        v[j] -= x * row[j]


@helper
def invert_symmetric(M, ridge, out):
    """Inverse (3, 3) of a symmetric matrix (3, 3) with `ridge` added to its diagonal, by ``L D Lᵀ``."""
    d0 = M[0, 0] + ridge
    l10, l20 = M[1, 0] / d0, M[2, 0] / d0
    d1 = M[1, 1] + ridge - l10 * M[1, 0]
    rest = M[2, 1] - l20 * M[1, 0]
    l21 = rest / d1
    d2 = M[2, 2] + ridge - l20 * M[2, 0] - l21 * rest
    m20 = l10 * l21 - l20  # of the inverse of L
    out[0, 0] = 1 / d0 + l10 * l10 / d1 + m20 * m20 / d2
    out[1, 0] = out[0, 1] = -l10 / d1 - m20 * l21 / d2
    out[2, 0] = out[0, 2] = m20 / d2
    out[1, 1] = 1 / d1 + l21 * l21 / d2
    out[2, 1] = out[1, 2] = -l21 / d2
    out[2, 2] = 1 / d2


@helper
def squared_distance(g, C):
    """``gᵀ C⁻¹ g`` of a vector (3,) by the Cholesky factor of C (3, 3); NaN where C is not positive definite.

    Where the third entry of g is NaN, the first two count alone.
    """
    a = np.sqrt(C[0, 0])
    b, c = C[1, 0] / a, C[2, 0] / a
    d = np.sqrt(C[1, 1] - b * b)
    e = (C[2, 1] - b * c) / d
    f = np.sqrt(C[2, 2] - c * c - e * e)
    x = g[0] / a
    y = (g[1] - b * x) / d
    z = (g[2] - c * x - e * y) / f
    if np.isnan(g[2]):
        return x * x + y * y
    return x * x + y * y + z * z if f > 0.0 else np.nan


@helper
def whitener(C, out):
    """Inverse (3, 3) of the Cholesky factor of C (3, 3): ``Wᵀ W = C⁻¹``; NaN where C is not positive definite."""
    a = 1.0 / np.sqrt(C[0, 0])
    b, c = C[1, 0] * a, C[2, 0] * a
    e = 1.0 / np.sqrt(C[1, 1] - b * b)
    g = (C[2, 1] - b * c) * e
    h = 1.0 / np.sqrt(C[2, 2] - c * c - g * g)
    out[0, 0], out[1, 1], out[2, 2] = a, e, h
    out[1, 0], out[2, 1], out[2, 0] = -b * a * e, -g * e * h, (b * g * e - c) * a * h
    out[0, 1] = out[0, 2] = out[1, 2] = 0.0


@helper
def trace(M):
    """Trace of a matrix (3, 3)."""
    return M[0, 0] + M[1, 1] + M[2, 2]


@helper
def row_times(M, i, v):
    """Entry i of ``M v`` for v (3,)."""
    return M[i, 0] * v[0] + M[i, 1] * v[1] + M[i, 2] * v[2]


@helper
def assign(M, out):
    """Copy a matrix: ``out[:] = M`` makes Numba compile messages about shapes, for as long as a large kernel."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = M[i, j]


@helper
def multiply(A, B, out):
    """``A B`` of matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@helper
def square(M, v):
    """``vᵀ M v`` for v (3,)."""
    total = 0.0
    for i in range(3):
        total += v[i] * row_times(M, i, v)
    return total


@helper
def turn(R, M, out):
    """``R M Rᵀ`` (3, 3) of a symmetric M, of which all is read."""
    for i in range(3):
        x, y, z = row_times(M, 0, R[i]), row_times(M, 1, R[i]), row_times(M, 2, R[i])
        for j in range(3):
            out[i, j] = x * R[j, 0] + y * R[j, 1] + z * R[j, 2]
