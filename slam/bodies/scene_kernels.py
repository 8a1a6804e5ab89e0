"""Compiled loops of the test of the scene: sums of normal equations over many sets of tracks, and what they say.

Symmetric 6x6 matrices of tracks are kept as their lower triangles (21,), row by row: see `slam.bodies.finder` for the
meaning of Λ, η and ξ.
"""

from __future__ import annotations

import numpy as np

from slam.bodies.config import CLEAR
from slam.chi_square import chi_square_limit
from slam.kernels.linear import factorise, solve_factorised, square
from slam.kernels.se3 import point_by_motion
from slam.runtime.compilation import helper, kernel

PRIOR = np.array([1e-4] * 3 + [1e-6] * 3)  #: keeps Λ of nearly collinear tracks invertible [1/rad², 1/m²]
_PULL = 16.0  # no track brings more χ² than this: single false ones find no company
_SOFT, _SHARP = 3, 2  # numerics: rounds of reweighting: Huber's first, which has one minimum, then a sharper one
LARGEST = 0.4  #: share of all tracks that a body may have: the still world has most
FITS = 14.2  #: derived: χ²(3) at 99.7 %, of a track and a common motion
_EXPLAINED = 0.25  # share of χ² that the common motion may leave: an uneven motion is seen by tracks unevenly
_BETTER = 4.0  # by how much χ² a member must fit its group's motion better than the rest's; outside the window CLEAR
_AROUND = 1.0  # how far beyond its window a group's tracks are looked for, in widths of the window
_CELLS = 2**12  # numerics: more than there are windows along an axis
_MOST = 20  # cost: windows looked into for the next group
MEDIAN = chi_square_limit(3, 0.5)  #: of χ²(3)

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


@helper
def _common_motion(L, eta, dWd, rows, work, out):
    """The motion ξ (6,) on which some tracks agree, by reweighted least squares, into `out`."""
    weight, total, told, products, factor = work
    weight[:] = 1.0
    for k in range(_SOFT + _SHARP):
        total[:], told[:] = 0.0, 0.0
        for m in range(len(dWd)):
            if rows[m]:
                _add_weighted(total, L[m], weight[m])
                _add_weighted(told, eta[m], weight[m])
        _factorise(total, 1.0, factor)
        _solve(factor, told, out)
        _products(out, products)
        changed = False
        for m in range(len(dWd)):
            if rows[m]:
                share = min(1.0, _PULL / max(_square(L[m], eta[m], dWd[m], out, products), 1e-9))
                changed = changed or share < 1.0 or weight[m] < 1.0
                weight[m] = np.sqrt(share) if k < _SOFT else share
        if not changed:  # nor would it in the next round
            break


@helper
def _squares_against(L, eta, dWd, motion, scale, products, out):
    """χ²(3) of every displacement against a motion ξ (6,), divided by `scale`, into `out` (N,)."""
    _products(motion, products)
    for m in range(len(dWd)):
        out[m] = _square(L[m], eta[m], dWd[m], motion, products) / scale


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
def _factorise(triangle, priors, out):
    """A triangle's matrix, with so many priors on its diagonal, through `factorise`."""
    k = 0
    for i in range(6):
        for j in range(i + 1):
            out[i, j] = triangle[k] + (priors * PRIOR[i] if i == j else 0.0)
            k += 1
    factorise(out, 6)


@helper
def _solve(factor, right, out):
    """The solution for a right side (6,), from `_factorise`."""
    for i in range(6):
        out[i] = right[i]
    solve_factorised(factor, 6, out)


# ---------------------------------------------------------------------------------------------- groups


@kernel
def window_codes(place, sizes):
    """A number for every window that a track at `place` (N, 3) is in, and the track itself in its last digits.

    Windows have `sizes` (S, 3), and each is half a width from the next along every axis: eight overlap. Sorted (8 S N,)
    numbers have each window's tracks in a row.
    """
    n = len(place)
    codes = np.empty(8 * len(sizes) * n, np.int64)
    k = 0
    for kind in range(8 * len(sizes)):
        for m in range(n):
            code = kind
            for axis in range(3):
                cell = np.floor(place[m, axis] / sizes[kind // 8, axis] + _shift(kind, axis))
                code = code * _CELLS + min(max(int(cell) + _CELLS // 2, 0), _CELLS - 1)
            codes[k] = code * n + m
            k += 1
    return codes


@helper
def _shift(kind, axis):
    """By which part of a width windows of a kind are shifted along an axis: the kind's last binary digits say where."""
    return 0.5 * (kind >> (2 - axis) & 1)


@kernel
def full_windows(codes, n, sizes, least):
    """Windows with at least so many of n tracks, by the sorted `window_codes`.

    As starts (M + 1,) of the windows in the list of their tracks, that list, and centres and widths (M, 3).
    """
    most = len(codes) // least + 1
    starts, tracks = np.empty(most + 1, np.int64), np.empty(len(codes), np.int64)
    centres, widths = np.empty((most, 3)), np.empty((most, 3))
    windows = size = first = 0
    starts[0] = 0
    for k in range(len(codes)):
        code = codes[k] // n
        if k + 1 < len(codes) and codes[k + 1] // n == code:
            continue
        if k + 1 - first >= least:
            for i in range(first, k + 1):
                tracks[size] = codes[i] - code * n
                size += 1
            kind = code // _CELLS**3
            for axis in range(2, -1, -1):
                widths[windows, axis] = sizes[kind // 8, axis]
                cell = code % _CELLS - _CELLS // 2
                centres[windows, axis] = (cell + 0.5 - _shift(kind, axis)) * widths[windows, axis]
                code //= _CELLS
            windows += 1
            starts[windows] = size
        first = k + 1
    return starts[: windows + 1], tracks[:size], centres[:windows], widths[:windows]


@helper
def _gain(triangle, gradient, factor, work):
    """By how much a triangle's tracks fit better with a motion of their own, from the gradient (6,) at another."""
    _factorise(triangle, 1.0, factor)
    _solve(factor, gradient, work)
    total = 0.0
    for i in range(6):
        total += gradient[i] * work[i]
    return total


@helper
def _window_tests(starts, tracks, L, eta, dWd, alone, scale, rest, asked, support, largest, clear):
    """By how much the χ²(6) of every window exceeds what is asked, into `clear` (M,); −∞ where it does not.

    The test is whether the tracks inside move as the rest; `asked` (N + 1,) is by their number. It is what both gain by
    motions of their own over the one that they share, ξ: ``gᵀ (Λ_w⁻¹ + Λ_r⁻¹) g`` with ``g = Λ_w ξ − η_w``. The first
    gain is at most the χ² of those inside against ξ, and both together at most the first over 1 − ρ: of the information
    on any motion those inside have no more than ``ρ = tr(Λ⁻¹ Λ_w)``. Most windows need no more than these sums.
    """
    n = len(alone)
    total, told, weight, off, hold = np.zeros(21), np.zeros(6), np.zeros(n), np.empty(n), np.empty(n)
    for m in range(n):
        if rest[m]:
            weight[m] = min(1.0, _PULL / max(alone[m], 1e-9)) / scale
            _add_weighted(total, L[m], weight[m])
            _add_weighted(told, eta[m], weight[m])
    factor, motion, products, shares = np.empty((6, 6)), np.empty(6), np.empty(21), np.empty(21)
    inside, outside, gradient, column, unit = np.empty(21), np.empty(21), np.empty(6), np.empty(6), np.zeros(6)
    _factorise(total, 2.0, factor)
    _solve(factor, told, motion)
    _products(motion, products)
    prior_off = prior_hold = 0.0
    for i in range(6):
        unit[:] = 0.0
        unit[i] = 1.0
        _solve(factor, unit, column)
        prior_off += PRIOR[i] * motion[i] ** 2
        prior_hold += PRIOR[i] * column[i]
        for j in range(i + 1):
            shares[i * (i + 1) // 2 + j] = (1.0 if i == j else 2.0) * column[j]
    for m in range(n):
        off[m] = weight[m] * _square(L[m], eta[m], dWd[m], motion, products)
        hold[m] = 0.0
        for k in range(21):
            hold[m] += weight[m] * L[m, k] * shares[k]
    for w in range(len(clear)):
        clear[w] = -np.inf
        own = tracks[starts[w] : starts[w + 1]]
        size, most, share = 0, prior_off, prior_hold
        for m in own:
            if rest[m]:
                size, most, share = size + 1, most + off[m], share + hold[m]
        if size < support or size > largest or most <= asked[size] * (1.0 - share):
            continue
        inside[:], gradient[:] = 0.0, 0.0
        for m in own:
            _add_weighted(inside, L[m], weight[m])
            _add_weighted(gradient, eta[m], -weight[m])
        for i in range(6):
            gradient[i] += PRIOR[i] * motion[i]
            for j in range(6):
                gradient[i] += inside[max(i, j) * (max(i, j) + 1) // 2 + min(i, j)] * motion[j]
        value = _gain(inside, gradient, factor, column)
        if value <= asked[size] * (1.0 - share):
            continue
        for k in range(21):  # expressions of arrays take seconds to compile
            outside[k] = total[k] - inside[k]
        value += _gain(outside, gradient, factor, column) - asked[size]
        if value > 0.0:
            clear[w] = value


@helper
def _seeds(own, rest, doubted, seeds):
    """Which of a window's `own` tracks no group was sought from in vain, into `seeds` (N,).

    How many, and how many of its tracks are of the rest.
    """
    size = inside = 0
    seeds[:] = False
    for m in own:
        seeds[m] = not doubted[m]
        size += seeds[m]
        inside += rest[m]
    return size, inside


@helper
def _company(sums, place, centre, width, scale, rest, seeds, support, work, motion, apart, fits, rows):
    """Tracks of the rest near a window that move as its `seeds` (N,) do, into `rows` (N,); how many.

    The search ends below `support`. `motion`, `apart` and `fits` are overwritten.
    """
    L, eta, dWd = sums
    for m in range(len(dWd)):
        rows[m] = rest[m] and not seeds[m]
    _common_motion(L, eta, dWd, rows, work, motion)
    _squares_against(L, eta, dWd, motion, scale, work[3], apart)
    found = 0
    for m in range(len(dWd)):  # a slice would make Numba compile messages about shapes, for two seconds
        rows[m] = seeds[m]
        found += seeds[m]
    for _ in range(2):
        if found < support:
            break
        _common_motion(L, eta, dWd, rows, work, motion)
        _squares_against(L, eta, dWd, motion, scale, work[3], fits)
        found = 0
        for m in range(len(dWd)):
            rows[m] = rest[m] and fits[m] < max(FITS, _EXPLAINED * apart[m])
            rows[m] = rows[m] and apart[m] - fits[m] > (_BETTER if seeds[m] else CLEAR)
            for axis in range(3):
                rows[m] = rows[m] and abs(place[m, axis] - centre[axis]) < (0.5 + _AROUND) * width[axis]
            found += rows[m]
    return found


@kernel
def groups_apart(L, eta, dWd, place, starts, tracks, centres, widths, asked, support):
    """Groups of tracks that moved alike, and otherwise than the rest: the clearest first, until there is none.

    Tracks have sums as of `normal_equations` and are seen at `place` (N, 3). Windows of `centres` and `widths` (M, 3)
    have `starts` (M + 1,) in the list of their `tracks`; `asked` (N + 1,) is the χ²(6) from which one with so many
    moved. Returns the group of each track (N,), −1 for the rest; χ²(6) of each group (G,); χ²(3) of every track against
    the rest (N,); the rest's common motion (6,); and the ratio by which χ² was divided, 1 at least.
    """
    n, sums = len(dWd), (L, eta, dWd)
    work = np.empty(n), np.empty(21), np.empty(6), np.empty(21), np.empty((6, 6))
    group, values, common, motion = np.full(n, -1), np.empty(n), np.empty(6), np.empty(6)
    alone, apart, fits, clear = np.empty(n), np.empty(n), np.empty(n), np.empty(len(centres))
    rest, seeds, rows = np.ones(n, np.bool_), np.empty(n, np.bool_), np.empty(n, np.bool_)
    doubted = np.zeros(n, np.bool_)
    scale, groups, left = 1.0, 0, n
    while True:
        _common_motion(L, eta, dWd, rest, work, common)
        _squares_against(L, eta, dWd, common, 1.0, work[3], alone)
        scale = max(1.0, np.median(alone[rest]) / MEDIAN)
        for m in range(n):
            alone[m] /= scale
            doubted[m] = not rest[m]
        if 3 * left < n or len(clear) == 0:
            break
        _window_tests(starts, tracks, L, eta, dWd, alone, scale, rest, asked, support, LARGEST * left, clear)
        found, value = 0, 0.0
        for _ in range(_MOST):
            window = np.argmax(clear)
            if clear[window] <= 0:
                break
            size, inside = _seeds(tracks[starts[window] : starts[window + 1]], rest, doubted, seeds)
            value, clear[window] = clear[window] + asked[inside], -np.inf
            if size < support:
                continue
            at, wide = centres[window], widths[window]
            found = _company(sums, place, at, wide, scale, rest, seeds, support, work, motion, apart, fits, rows)
            if found >= support:
                break
            for m in range(n):
                doubted[m] = doubted[m] or seeds[m]
        if found < support:
            break
        for m in range(n):
            if rows[m]:
                group[m], rest[m] = groups, False
        values[groups] = value
        groups, left = groups + 1, left - found
    return group, values[:groups].copy(), alone, common, scale
