"""Compiled loops of the test of the scene: sums of normal equations over many sets of tracks, and what they say.

Symmetric 6x6 matrices of tracks are kept as their lower triangles (21,), row by row: see `slam.bodies.finder` for the
meaning of Λ, η and ξ.
"""

from __future__ import annotations

import numpy as np

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
_BETTER = 4.0  # by how much χ² a member must fit its group's motion better than the rest's, and
_BETTER_AROUND = 6.0  # where it lies outside the window
_AROUND = 1.0  # how far beyond its window a group's tracks are looked for, in widths of the window
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


@helper
def _times(triangle, v, out):
    """The product of a triangle's matrix, with the prior on its diagonal, and a vector (6,)."""
    for i in range(6):
        out[i] = PRIOR[i] * v[i]
    k = 0
    for i in range(6):
        for j in range(i):
            out[i] += triangle[k] * v[j]
            out[j] += triangle[k] * v[i]
            k += 1
        out[i] += triangle[k] * v[i]
        k += 1


# ---------------------------------------------------------------------------------------------- groups


@helper
def _window_tests(starts, tracks, L, eta, alone, scale, rest, asked, support, largest, clear):
    """By how much the χ²(6) of every window exceeds what is asked, into `clear` (M,); −∞ where there is no test.

    The test is whether the motion of the tracks inside is that of the rest; `asked` (N + 1,) is by their number.
    """
    total, told = np.zeros(21), np.zeros(6)
    for n in range(len(alone)):
        if rest[n]:
            weight = min(1.0, _PULL / max(alone[n], 1e-9)) / scale
            _add_weighted(total, L[n], weight)
            _add_weighted(told, eta[n], weight)
    both, own, other = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    _factorise(total, 2.0, both)
    inside, told_inside, outside, told_outside = np.empty(21), np.empty(6), np.empty(21), np.empty(6)
    gap, motion, left, right = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for m in range(len(clear)):
        clear[m] = -np.inf
        own_tracks = tracks[starts[m] : starts[m + 1]]
        size = 0
        for n in own_tracks:
            size += rest[n]
        if size < support or size > largest:
            continue
        inside[:], told_inside[:] = 0.0, 0.0
        for n in own_tracks:
            if rest[n]:
                weight = min(1.0, _PULL / max(alone[n], 1e-9)) / scale
                _add_weighted(inside, L[n], weight)
                _add_weighted(told_inside, eta[n], weight)
        for k in range(21):  # expressions of arrays take seconds to compile
            outside[k] = total[k] - inside[k]
        for i in range(6):
            told_outside[i] = told[i] - told_inside[i]
        _factorise(inside, 1.0, own)
        _factorise(outside, 1.0, other)
        _solve(own, told_inside, gap)
        _solve(other, told_outside, motion)
        for i in range(6):
            gap[i] -= motion[i]
        _times(inside, gap, left)
        _times(outside, gap, right)
        _solve(both, right, motion)
        clear[m] = -asked[size]
        for i in range(6):
            clear[m] += left[i] * motion[i]


@kernel
def groups_apart(L, eta, dWd, place, starts, tracks, centres, widths, asked, support):
    """Groups of tracks that moved alike, and otherwise than the rest: the clearest first, until there is none.

    Tracks have sums as of `normal_equations` and are seen at `place` (N, 3). Windows of `centres` and `widths` (M, 3)
    have `starts` (M + 1,) in the list of their `tracks`; `asked` (N + 1,) is the χ²(6) from which one with so many
    moved. Returns the group of each track (N,), −1 for the rest; χ²(6) of each group (G,); χ²(3) of every track against
    the rest (N,); the rest's common motion (6,); and the ratio by which χ² was divided, 1 at least.
    """
    n = len(dWd)
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
        _window_tests(starts, tracks, L, eta, alone, scale, rest, asked, support, LARGEST * left, clear)
        found = 0
        for _ in range(_MOST):
            window = np.argmax(clear)
            if clear[window] <= 0:
                break
            inside, size = 0, 0
            seeds[:] = False
            for m in tracks[starts[window] : starts[window + 1]]:
                seeds[m] = not doubted[m]
                inside += rest[m]
                size += seeds[m]
            value, clear[window] = clear[window] + asked[inside], -np.inf
            if size < support:
                continue
            for m in range(n):
                rows[m] = rest[m] and not seeds[m]
            _common_motion(L, eta, dWd, rows, work, motion)
            _squares_against(L, eta, dWd, motion, scale, work[3], apart)
            for m in range(n):  # a slice would make Numba compile messages about shapes, for two seconds
                rows[m] = seeds[m]
            found = size
            for _ in range(2):
                if found < support:
                    break
                _common_motion(L, eta, dWd, rows, work, motion)
                _squares_against(L, eta, dWd, motion, scale, work[3], fits)
                found = 0
                for m in range(n):
                    rows[m] = rest[m] and fits[m] < max(FITS, _EXPLAINED * apart[m])
                    rows[m] = rows[m] and apart[m] - fits[m] > (_BETTER if seeds[m] else _BETTER_AROUND)
                    for axis in range(3):
                        off = abs(place[m, axis] - centres[window, axis])
                        rows[m] = rows[m] and off < (0.5 + _AROUND) * widths[window, axis]
                    found += rows[m]
            if found >= support:
                for m in range(n):
                    if rows[m]:
                        group[m], rest[m] = groups, False
                values[groups] = value
                groups, left = groups + 1, left - found
                break
            found = 0
            for m in range(n):
                doubted[m] = doubted[m] or seeds[m]
        if found == 0:
            break
    return group, values[:groups].copy(), alone, common, scale
