"""Compiled loops of the test of the scene: sums of normal equations over many sets of tracks, and what they say.

Symmetric 6x6 matrices of tracks are kept as their lower triangles (21,), row by row: see `slam.bodies.finder` for the
meaning of Λ, η and ξ.
"""

from __future__ import annotations

import numpy as np

from slam.bodies.config import CLEAR
from slam.bodies.track_kernels import add_rows, add_weighted
from slam.chi_square import chi_square_limit
from slam.kernels.linear import factorise, median, solve_factorised, square
from slam.kernels.se3 import point_by_motion
from slam.runtime.compilation import disjoint_helper, helper, kernel

PRIOR = np.array([1e-4] * 3 + [1e-6] * 3)  #: keeps Λ of nearly collinear tracks invertible [1/rad², 1/m²]
_PULL = 16.0  # no track brings more χ² than this: single false ones find no company
_SOFT, _SHARP = 3, 1  # numerics: rounds of reweighting: Huber's first, which has one minimum, then a sharper one
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
    """Each track's Λ, η and dᵀ W d side by side (N, 28), of displacements d with information W at `points`."""
    n = len(d)
    sums = np.zeros((n, 28))
    J, WJ = np.empty((3, 6)), np.empty((3, 6))
    for m in range(n):
        point_by_motion(points[m], lag[m], J)
        for i in range(3):
            for j in range(6):
                WJ[i, j] = W[m, i, 0] * J[0, j] + W[m, i, 1] * J[1, j] + W[m, i, 2] * J[2, j]
                sums[m, 21 + j] += WJ[i, j] * d[m, i]
        sums[m, 27] = square(W[m], d[m])
        k = 0
        for i in range(6):
            for j in range(i + 1):
                sums[m, k] = J[0, i] * WJ[0, j] + J[1, i] * WJ[1, j] + J[2, i] * WJ[2, j]
                k += 1
    return sums


@helper
def _by_column(sums, rows, count):
    """Sums (N, 28) of the first `count` of the `rows`, and the same by column (28, N): for loops over tracks."""
    own, columns = np.empty((count, 28)), np.empty((28, count))
    for m in range(count):
        for k in range(28):
            own[m, k] = columns[k, m] = sums[rows[m], k]
    return own, columns


@helper
def _common_motion(sums, columns, members, out):
    """The motion ξ (6,) on which the tracks that are `members` (N,) agree, by reweighted least squares, into `out`."""
    n = len(sums)
    weight, off, total, factor = np.empty(n), np.zeros(n), np.empty(28), np.empty((6, 6))
    every = np.arange(n)
    for k in range(1 + _SOFT + _SHARP):
        _reweigh(off, members, k <= _SOFT, weight)
        total[:] = 0.0
        add_rows(total, sums, every, weight)
        _factorise(total, 1.0, factor)
        _solve(factor, total[21:27], out)
        _squares_against(columns, out, off)


@disjoint_helper
def _reweigh(off, members, soft, weight):
    """Weights (N,) of the members by their χ²."""
    for m in range(len(off)):
        share = min(1.0, _PULL / max(off[m], 1e-9)) if members[m] else 0.0
        weight[m] = np.sqrt(share) if soft else share


@helper
def _squares_against(columns, motion, out):
    """χ²(3) of every displacement against a motion ξ (6,), into `out` (N,).

    ``ξᵀ Λ ξ`` is a sum over the triangle of Λ with the products of the motion's entries.
    """
    products = np.empty(21)
    k = 0
    for i in range(6):
        for j in range(i):
            products[k] = 2 * motion[i] * motion[j]
            k += 1
        products[k] = motion[i] * motion[i]
        k += 1
    _squares(columns, products, motion, out)


@disjoint_helper
def _squares(columns, products, motion, out):
    for m in range(len(out)):
        s0 = s1 = s2 = s3 = 0.0
        for k in range(7):
            s0 += columns[k, m] * products[k]
            s1 += columns[k + 7, m] * products[k + 7]
            s2 += columns[k + 14, m] * products[k + 14]
        for i in range(6):
            s3 += columns[21 + i, m] * motion[i]
        out[m] = columns[27, m] + (s0 + s1 + s2) - 2 * s3


@helper
def _factorise(triangle, priors, out):
    """A triangle's matrix, with so many priors on its diagonal, through `factorise`."""
    _unfold(triangle, priors, out)
    factorise(out, 6)


@helper
def _unfold(triangle, priors, out):
    """A triangle's matrix, with so many priors on its diagonal."""
    k = 0
    for i in range(6):
        for j in range(i + 1):
            out[i, j] = out[j, i] = triangle[k] + (priors * PRIOR[i] if i == j else 0.0)
            k += 1


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

    Windows have `sizes` (S, 3), and each is half a width from the next along every axis: eight overlap. Rows of the
    numbers (8 S, N) are of one kind of window each; sorted, they have each window's tracks side by side.
    """
    n = len(place)
    codes = np.empty((8 * len(sizes), n), np.int64)
    for kind in range(8 * len(sizes)):
        for m in range(n):
            code = kind
            for axis in range(3):
                cell = np.floor(place[m, axis] / sizes[kind // 8, axis] + _shift(kind, axis))
                code = code * _CELLS + min(max(int(cell) + _CELLS // 2, 0), _CELLS - 1)
            codes[kind, m] = code * n + m
    return codes


@helper
def _shift(kind, axis):
    """By which part of a width windows of a kind are shifted along an axis: the kind's last binary digits say where."""
    return 0.5 * (kind >> (2 - axis) & 1)


@helper
def _full_windows(codes, sizes, least):
    """Windows with at least so many tracks, by the sorted `window_codes`.

    As starts (M + 1,) of the windows in the list of their tracks, that list, and centres and widths (M, 3).
    """
    kinds, n = codes.shape
    most = kinds * n // least + 1
    starts, tracks = np.empty(most + 1, np.int64), np.empty(kinds * n, np.int64)
    centres, widths = np.empty((most, 3)), np.empty((most, 3))
    windows = size = 0
    starts[0] = 0
    for kind in range(kinds):
        first = 0
        for k in range(n):
            code = codes[kind, k] // n
            if k + 1 < n and codes[kind, k + 1] // n == code:
                continue
            if k + 1 - first >= least:
                for i in range(first, k + 1):
                    tracks[size] = codes[kind, i] - code * n
                    size += 1
                for axis in range(2, -1, -1):
                    widths[windows, axis] = sizes[kind // 8, axis]
                    cell = code % _CELLS - _CELLS // 2
                    centres[windows, axis] = (cell + 0.5 - _shift(kind, axis)) * widths[windows, axis]
                    code //= _CELLS
                windows += 1
                starts[windows] = size
            first = k + 1
    return starts[: windows + 1], tracks, centres, widths


@helper
def _gain(triangle, gradient, lower, scaled):
    """By how much a triangle's tracks fit better with a motion of their own, from the gradient (6,) at another.

    With the matrix ``L D Lᵀ`` and ``z = L⁻¹ g`` that is ``zᵀ D⁻¹ z``. `lower` (6, 6) holds L, and D⁻¹ on its diagonal,
    `scaled` (6, 7) L D, and z in its last column.
    """
    total, k = 0.0, 0
    for i in range(6):
        for j in range(i):
            value = triangle[k]
            for h in range(j):
                value -= scaled[i, h] * lower[j, h]
            scaled[i, j], lower[i, j] = value, value * lower[j, j]
            k += 1
        z, d = gradient[i], triangle[k] + PRIOR[i]
        for h in range(i):
            z -= lower[i, h] * scaled[h, 6]
            d -= scaled[i, h] * lower[i, h]
        k += 1
        lower[i, i], scaled[i, 6] = 1.0 / d, z
        total += z * z * lower[i, i]
    return total


@helper
def _window_tests(starts, tracks, sums, columns, alone, scale, rest, asked, support, largest, clear):
    """By how much the χ²(6) of every window exceeds what is asked, into `clear` (M,); −∞ where it does not.

    The test is whether the tracks inside move as the rest; `asked` (N + 1,) is by their number. It is what both gain by
    motions of their own over the one that they share, ξ: ``gᵀ (Λ_w⁻¹ + Λ_r⁻¹) g`` with ``g = Λ_w ξ − η_w``. The first
    gain is at most the χ² of those inside against ξ, and both together at most the first over 1 − ρ: of the information
    on any motion those inside have no more than ``ρ = tr(Λ⁻¹ Λ_w)``. Most windows need no more than these sums.
    """
    n = len(alone)
    total, weight, off, hold = np.zeros(28), np.zeros(n), np.empty(n), np.empty(n)
    for m in range(n):
        if rest[m]:
            weight[m] = min(1.0, _PULL / max(alone[m], 1e-9)) / scale
            add_weighted(total, sums[m], weight[m])
    factor, motion, shares = np.empty((6, 6)), np.empty(6), np.empty(21)
    inside, outside, column, unit = np.empty(28), np.empty(21), np.empty(6), np.zeros(6)
    gradient, whole, lower, scaled = np.empty(6), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 7))
    _factorise(total, 2.0, factor)
    _solve(factor, total[21:27], motion)
    _squares_against(columns, motion, off)
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
        off[m] *= weight[m]
        hold[m] = 0.0
        for k in range(21):
            hold[m] += weight[m] * sums[m, k] * shares[k]
    for w in range(len(clear)):
        clear[w] = -np.inf
        own = tracks[starts[w] : starts[w + 1]]
        size, most, share = 0, prior_off, prior_hold
        for m in own:
            if rest[m]:
                size, most, share = size + 1, most + off[m], share + hold[m]
        if size < support or size > largest or most <= asked[size] * (1.0 - share):
            continue
        inside[:] = 0.0
        add_rows(inside, sums, own, weight)
        _unfold(inside, 0.0, whole)
        for i in range(6):
            gradient[i] = PRIOR[i] * motion[i] - inside[21 + i]
            for j in range(6):
                gradient[i] += whole[i, j] * motion[j]
        value = _gain(inside, gradient, lower, scaled)
        if value <= asked[size] * (1.0 - share):
            continue
        for k in range(21):  # expressions of arrays take seconds to compile
            outside[k] = total[k] - inside[k]
        value += _gain(outside, gradient, lower, scaled) - asked[size]
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
def _company(sums, columns, place, centre, width, scale, rest, seeds, support, rows):
    """Tracks of the rest near a window that move as its `seeds` (N,) do, into `rows` (N,); how many.

    The search ends below `support`.
    """
    n, found = len(sums), 0
    members, every = np.empty(n, np.intp), np.ones(n, np.bool_)
    motion, apart, fits = np.empty(6), np.zeros(n), np.zeros(n)
    for m in range(n):
        rows[m] = rest[m] and not seeds[m]
    for which in range(3):  # of the others, the seeds, and those that go with these; compiled once for all
        count, own, own_columns, chosen = 0, sums, columns, rows
        if which:
            for m in range(n):
                if rows[m]:
                    members[count] = m
                    count += 1
            own, own_columns = _by_column(sums, members, count)
            chosen = every
        _common_motion(own, own_columns, chosen, motion)
        _squares_against(columns, motion, fits if which else apart)
        found = 0
        for m in range(n):
            one, other = fits[m] / scale, apart[m] / scale
            goes = rest[m] and one < max(FITS, _EXPLAINED * other)
            goes = goes and other - one > (_BETTER if seeds[m] else CLEAR)
            for axis in range(3):
                goes = goes and abs(place[m, axis] - centre[axis]) < (0.5 + _AROUND) * width[axis]
            rows[m] = goes if which else seeds[m]
            found += rows[m]
        if found < support:
            break
    return found


@kernel
def groups_apart(sums, place, codes, sizes, asked, support):
    """Groups of tracks that moved alike, and otherwise than the rest: the clearest first, until there is none.

    Tracks have `sums` (N, 28) as of `normal_equations` and are seen at `place` (N, 3), in windows of `sizes` (S, 3)
    that have sorted `codes` (8 S, N) and at least `support` tracks; `asked` (N + 1,) is the χ²(6) from which one with
    so many moved. Returns the group of each track (N,), −1 for the rest; χ²(6) of each group (G,); χ²(3) of every track
    against the rest (N,); the rest's common motion (6,), and the information (6, 6) on it; and the ratio by which χ²
    was divided, 1 at least.
    """
    n = len(sums)
    _, columns = _by_column(sums, np.arange(n), n)
    starts, tracks, centres, widths = _full_windows(codes, sizes, support)
    clear = np.empty(len(starts) - 1)
    group, values, common, alone = np.full(n, -1), np.empty(n), np.empty(6), np.empty(n)
    rest, rows, kept = np.ones(n, np.bool_), np.empty(n, np.bool_), np.empty(n)
    seeds, doubted = np.empty(n, np.bool_), np.zeros(n, np.bool_)
    groups, left = 0, n
    while True:
        _common_motion(sums, columns, rest, common)
        _squares_against(columns, common, alone)
        count = 0
        for m in range(n):
            if rest[m]:
                kept[count] = alone[m]
                count += 1
        scale = max(1.0, median(kept[:count]) / MEDIAN)
        for m in range(n):
            alone[m] /= scale
            doubted[m] = not rest[m]
        if 3 * left < n or len(clear) == 0:
            break
        _window_tests(starts, tracks, sums, columns, alone, scale, rest, asked, support, LARGEST * left, clear)
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
            found = _company(sums, columns, place, at, wide, scale, rest, seeds, support, rows)
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
    total, information = np.zeros(28), np.empty((6, 6))
    for m in range(n):
        if rest[m]:
            add_weighted(total, sums[m], 1.0)
    _unfold(total, 1.0, information)
    return group, values[:groups].copy(), alone, common, information, scale
