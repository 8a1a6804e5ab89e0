"""Compiled loops of the test of the scene: sums of normal equations over many sets of tracks, and what they say.

Symmetric 6x6 matrices of tracks are kept as their lower triangles (21,), row by row: see `slam.objects.regions` for the
meaning of Λ, η and ξ.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, solve_factorised, square
from slam.kernels.se3 import point_by_motion
from slam.runtime.compilation import helper, kernel

_CELLS = 2**12  # more than there are windows along an axis
_SPREAD = 0x1E3779B97F4A7C15  # numerics: an odd number that spreads codes over a table

# ---------------------------------------------------------------------------------------------- a common motion


@kernel
def normal_equations(points, d, W, lag):
    """Each track's Λ (N, 21), η (N, 6), and dᵀ W d (N,), of displacements d with information W at `points`."""
    n = len(d)
    L, eta, dWd = np.empty((n, 21)), np.zeros((n, 6)), np.empty(n)
    J, WJ = np.empty((3, 6)), np.empty((3, 6))
    for m in range(n):
        point_by_motion(points[m], lag[m], J)
        for i in range(3):
            for j in range(6):
                WJ[i, j] = W[m, i, 0] * J[0, j] + W[m, i, 1] * J[1, j] + W[m, i, 2] * J[2, j]
                eta[m, j] += WJ[i, j] * d[m, i]
        dWd[m] = square(W[m], d[m])
        k = 0
        for i in range(6):
            for j in range(i + 1):
                L[m, k] = J[0, i] * WJ[0, j] + J[1, i] * WJ[1, j] + J[2, i] * WJ[2, j]
                k += 1
    return L, eta, dWd


@kernel
def common_motion(L, eta, dWd, rows, prior, pull, soft, sharp):
    """The motion ξ (6,) on which tracks agree, by reweighted least squares.

    Args:
        L: Λ of the tracks (N, 21).
        eta: η of the tracks (N, 6).
        dWd: ``dᵀ W d`` of the tracks (N,).
        rows: which of them (N,).
        prior: on the diagonal of the sum of Λ (6,).
        pull: χ² above which tracks weigh less.
        soft: rounds with Huber's weights, after which come those
        sharp: where such tracks bring that much χ² each.
    """
    weight = np.ones(len(dWd))
    total, told, motion, products = np.empty(21), np.empty(6), np.empty(6), np.empty(21)
    factor = np.empty((6, 6))
    for k in range(soft + sharp):
        total[:], told[:] = 0.0, 0.0
        for m in range(len(dWd)):
            if rows[m]:
                _add_weighted(total, L[m], weight[m])
                _add_weighted(told, eta[m], weight[m])
        _factorise(total, prior, factor)
        _solve(factor, told, motion)
        _products(motion, products)
        changed = False
        for m in range(len(dWd)):
            if rows[m]:
                share = min(1.0, pull / max(_square(L[m], eta[m], dWd[m], motion, products), 1e-9))
                changed = changed or share < 1.0 or weight[m] < 1.0
                weight[m] = np.sqrt(share) if k < soft else share
        if not changed:  # nor would it in the next round
            break
    return motion


@kernel
def squares_against(L, eta, dWd, motion):
    """χ²(3) of every displacement (N,) against a motion ξ (6,)."""
    squares, products = np.empty(len(dWd)), np.empty(21)
    _products(motion, products)
    for m in range(len(dWd)):
        squares[m] = _square(L[m], eta[m], dWd[m], motion, products)
    return squares


@helper
def _add_weighted(total, part, weight):
    for k in range(len(total)):
        total[k] += weight * part[k]


@helper
def _products(motion, out):
    """Products of a motion's entries, so that ``ξᵀ Λ ξ`` is a sum over the triangle of Λ."""
    k = 0
    for i in range(6):
        for j in range(i):
            out[k] = 2 * motion[i] * motion[j]
            k += 1
        out[k] = motion[i] * motion[i]
        k += 1


@helper
def _square(L, eta, dWd, motion, products):
    """χ²(3) of a displacement against a motion, in sums that need not wait for one another."""
    s0 = s1 = s2 = s3 = 0.0
    for k in range(7):
        s0 += L[k] * products[k]
        s1 += L[k + 7] * products[k + 7]
        s2 += L[k + 14] * products[k + 14]
    for i in range(6):
        s3 += eta[i] * motion[i]
    return dWd + (s0 + s1 + s2) - 2 * s3


@helper
def _factorise(triangle, prior, out):
    """A triangle's matrix, with `prior` (6,) on its diagonal, through `factorise`."""
    k = 0
    for i in range(6):
        for j in range(i + 1):
            out[i, j] = triangle[k] + (prior[i] if i == j else 0.0)
            k += 1
    factorise(out, 6)


@helper
def _solve(factor, right, out):
    """The solution for a right side (6,), from `_factorise`."""
    for i in range(6):
        out[i] = right[i]
    solve_factorised(factor, 6, out)


@helper
def _times(triangle, prior, v, out):
    """The product of a triangle's matrix, with `prior` on its diagonal, and a vector (6,)."""
    for i in range(6):
        out[i] = prior[i] * v[i]
    k = 0
    for i in range(6):
        for j in range(i):
            out[i] += triangle[k] * v[j]
            out[j] += triangle[k] * v[i]
            k += 1
        out[i] += triangle[k] * v[i]
        k += 1


# ---------------------------------------------------------------------------------------------- windows


@kernel
def full_windows(place, sizes, support):
    """Windows with at least `support` tracks, of every size, each half a width from the next along every axis.

    Args:
        place: of the tracks (N, 3).
        sizes: of windows (S, 3).
        support: least number of tracks in a window.

    Returns:
        starts (M + 1,) of the windows in the list of their tracks, that list, and centres and widths (M, 3).
    """
    kinds, n = 8 * len(sizes), len(place)
    most = kinds * (n // support)
    starts, tracks = np.zeros(most + 1, np.int64), np.empty(kinds * n, np.int64)
    centres, widths = np.empty((most, 3)), np.empty((most, 3))
    lines = np.empty((2, n, 3), np.int64)
    window, size, code = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    full, begin = np.empty(n, np.int64), np.empty(n, np.int64)
    places = 1
    while places < 2 * n:
        places *= 2
    table = np.empty(places, np.int64)
    windows = 0
    for kind in range(kinds):
        if kind % 8 == 0:
            _lines(place, sizes[kind // 8], lines)
        count = _grouped(lines, kind, table, window, size, code)
        chosen = _with_support(size[:count], code, support, full)
        for k in range(chosen):
            begin[full[k]] = starts[windows]
            starts[windows + 1] = starts[windows] + size[full[k]]
            rest = code[full[k]]
            for axis in range(2, -1, -1):
                half = 0.5 * ((kind >> (2 - axis)) & 1)
                widths[windows, axis] = sizes[kind // 8, axis]
                centres[windows, axis] = (rest % _CELLS - _CELLS // 2 + 0.5 - half) * widths[windows, axis]
                rest //= _CELLS
            windows += 1
        for i in range(n):
            if size[window[i]] >= support:
                tracks[begin[window[i]]] = i
                begin[window[i]] += 1
    return starts[: windows + 1].copy(), tracks[: starts[windows]].copy(), centres[:windows], widths[:windows]


@helper
def _lines(place, size, out):
    """In which cell along each axis every track lies, where cells begin at 0, and where at a half (2, N, 3)."""
    for i in range(len(place)):
        for axis in range(3):
            at = place[i, axis] / size[axis]
            for half in range(2):
                cell = int(np.floor(at + 0.5 * half)) + _CELLS // 2
                out[half, i, axis] = min(max(cell, 0), _CELLS - 1)


@helper
def _grouped(lines, kind, table, window, size, code):
    """Number the windows of one size and offset that are not empty; returns how many there are.

    Args:
        lines: from `_lines`.
        kind: its lowest three bits say along which axes the windows are offset.
        table: of 2^k places, at least twice as many as tracks; overwritten, and so are
        window: the window of each track (N,),
        size: the number of tracks in each window, and
        code: the cells of each window, as one number.
    """
    table[:] = -1
    count = 0
    for i in range(len(window)):
        own = 0
        for axis in range(3):
            own = own * _CELLS + lines[(kind >> (2 - axis)) & 1, i, axis]
        at = ((own * _SPREAD) >> 20) & (len(table) - 1)
        while table[at] >= 0 and code[table[at]] != own:
            at = (at + 1) & (len(table) - 1)
        if table[at] < 0:
            table[at], code[count], size[count] = count, own, 0
            count += 1
        window[i] = table[at]
        size[window[i]] += 1
    return count


@helper
def _with_support(size, code, support, out):
    """Windows with enough tracks, by ascending code, into `out`; returns how many there are."""
    count = 0
    for k in range(len(size)):
        if size[k] < support:
            continue
        at = count
        while at > 0 and code[out[at - 1]] > code[k]:
            out[at] = out[at - 1]
            at -= 1
        out[at] = k
        count += 1
    return count


@kernel
def window_tests(starts, tracks, L, eta, weight, brought, rest, asked, support, largest, prior):
    """Test of every window: whether the motion of the tracks inside is that of the rest.

    Args:
        starts: of the windows in the list of their tracks (M + 1,).
        tracks: that list.
        L: Λ of the tracks (N, 21).
        eta: η of the tracks (N, 6).
        weight: of the tracks (N,).
        brought: χ²(3) that each track can bring (N,).
        rest: which tracks are in no group yet (N,).
        asked: χ²(6) from which a window with so many tracks moved (N + 1,).
        support: least number of tracks in a window, and
        largest: greatest.
        prior: on the diagonals (6,).

    Returns:
        χ²(6) (M,), and by how much it exceeds what is asked (M,); −∞ where there is no test.
    """
    total, told = np.zeros(21), np.zeros(6)
    for n in range(len(weight)):
        if rest[n]:
            _add_weighted(total, L[n], weight[n])
            _add_weighted(told, eta[n], weight[n])
    both, own, other, twice = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    for i in range(6):
        twice[i] = 2 * prior[i]
    _factorise(total, twice, both)
    inside, told_inside, outside, told_outside = np.empty(21), np.empty(6), np.empty(21), np.empty(6)
    gap, motion, left, right = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    values, clear = np.full(len(starts) - 1, -np.inf), np.full(len(starts) - 1, -np.inf)
    for m in range(len(values)):
        own_tracks = tracks[starts[m] : starts[m + 1]]
        size, most = 0, 0.0
        for n in own_tracks:
            if rest[n]:
                size += 1
                most += brought[n]
        if size < support or size > largest or most <= asked[size]:
            continue
        inside[:], told_inside[:] = 0.0, 0.0
        for n in own_tracks:
            if rest[n]:
                _add_weighted(inside, L[n], weight[n])
                _add_weighted(told_inside, eta[n], weight[n])
        for k in range(21):  # expressions of arrays take seconds to compile
            outside[k] = total[k] - inside[k]
        for i in range(6):
            told_outside[i] = told[i] - told_inside[i]
        _factorise(inside, prior, own)
        _factorise(outside, prior, other)
        _solve(own, told_inside, gap)
        _solve(other, told_outside, motion)
        for i in range(6):
            gap[i] -= motion[i]
        _times(inside, prior, gap, left)
        _times(outside, prior, gap, right)
        _solve(both, right, motion)
        values[m] = 0.0
        for i in range(6):
            values[m] += left[i] * motion[i]
        clear[m] = values[m] - asked[size]
    return values, clear
