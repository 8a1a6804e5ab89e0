"""Compiled passes of `slam.tracks.mapper`: over all landmarks after a frame, and over features that may become some."""

from __future__ import annotations

import numpy as np

from slam.chi_square import SIGMAS
from slam.runtime.compilation import helper, kernel
from slam.tracks.follow import first_column

_SAME_PIXELS = 6.0  # landmarks further apart in the image than this [px] are not the same


@kernel
def births(uv, rows, occupied, wanted, separation, grid, size):
    """The first `wanted` of the `rows` (K,), by falling response, of features at pixels `uv` (N, 2): `new_landmarks`.

    Features of cells with few landmarks, at pixels `occupied` (M, 2), and few features before them come first.
    """
    load, last = np.zeros(grid[0] * grid[1], np.int64), -1
    for k in range(len(occupied)):
        load[_cell(occupied[k], grid, size)] += 1
    turn = np.full(len(rows), -1)
    for k in range(len(rows)):
        if _clear(uv[rows[k]], occupied, len(occupied), separation):
            cell = _cell(uv[rows[k]], grid, size)
            turn[k] = load[cell]
            load[cell] += 1
            last = max(last, turn[k])
    wanted = min(wanted, len(rows))
    chosen, places, count = np.empty(wanted, np.intp), np.empty((wanted, 2)), 0
    for now in range(last + 1):
        for k in range(len(rows)):
            if turn[k] == now and count < wanted and _clear(uv[rows[k]], places, count, separation):
                chosen[count] = rows[k]
                places[count, 0], places[count, 1] = uv[rows[k], 0], uv[rows[k], 1]
                count += 1
    return chosen[:count]


@helper
def _cell(pixel, grid, size):
    """Number of the cell of a grid of columns and rows in which a pixel lies; `size` is that of the image."""
    column, row = int(pixel[0] / (size[0] / grid[0])), int(pixel[1] / (size[1] / grid[1]))
    return min(max(row, 0), grid[1] - 1) * grid[0] + min(max(column, 0), grid[0] - 1)


@helper
def _clear(pixel, others, count, separation):
    """Whether a pixel is not closer than the separation [px] to the first `count` of the others."""
    for k in range(count):
        dx, dy = pixel[0] - others[k, 0], pixel[1] - others[k, 1]
        if dx * dx + dy * dy < separation * separation:
            return False
    return True


@kernel
def census(
    rows, counts, seen_from, looks, signs, view, expected, measured, withheld, frame, features, limits, replaceable,
    kept,
):  # fmt: skip
    """Which landmarks (N,) go, and which features (F,) are one of them; the columns of the table count the frame.

    See `take_census` of the mapper. `rows` (N,) are the landmarks' in the columns; `limits` and `kept` are settings.
    """
    positions, local, uv, in_image, points, sigma = view
    feature_uv, feature_looks, feature_signs, order = features
    radius, same_distance, same_look = limits
    _count(rows, counts, view, expected, measured, withheld, frame, feature_uv, order, radius)
    seen, newest = counts[0], 0
    going, known = np.zeros(len(rows), np.bool_), np.zeros(len(feature_uv), np.bool_)
    for n in range(len(rows)):
        row = rows[n]
        newest = max(newest, counts[3][row])
        if not in_image[n]:
            continue
        for other in range(len(rows)):
            if (
                in_image[other] and _gives_way(seen, rows, n, other)
                and abs(uv[n, 0] - uv[other, 0]) <= _SAME_PIXELS and abs(uv[n, 1] - uv[other, 1]) <= _SAME_PIXELS
                and _distance(local[n], local[other]) < same_distance
                and signs[row] == signs[rows[other]] and _distance(looks[row], looks[rows[other]]) < same_look
            ):  # fmt: skip
                going[n] = True
                break
        place = first_column(feature_uv, order, uv[n, 0] - _SAME_PIXELS)
        while place < len(order) and feature_uv[order[place], 0] <= uv[n, 0] + _SAME_PIXELS:
            f = order[place]
            place += 1
            if abs(feature_uv[f, 1] - uv[n, 1]) <= _SAME_PIXELS and feature_signs[f] == signs[row] and not known[f]:
                same = abs(points[f, 2] - local[n, 2]) < SIGMAS * sigma[f]
                same = same or _distance(points[f], local[n]) < same_distance
                known[f] = same and _distance(feature_looks[f], looks[row]) < same_look
    for n in range(len(rows)):
        going[n] = going[n] or (replaceable and _undetected(counts, rows[n], newest, kept))
    _thin_out(rows, counts, seen_from, positions, kept[0], kept[4], going)
    return going, known


@helper
def _gives_way(seen, rows, one, other):
    """Whether of two landmarks the one goes: it was seen less, or as often and is younger."""
    return seen[rows[one]] < seen[rows[other]] or (seen[rows[one]] == seen[rows[other]] and one > other)


@helper
def _distance(a, b):
    """Of two vectors."""
    total = (a[0] - b[0]) * (a[0] - b[0])
    for i in range(1, len(a)):
        total += (a[i] - b[i]) * (a[i] - b[i])
    return np.sqrt(total)


@helper
def _count(rows, counts, view, expected, measured, withheld, frame, feature_uv, order, radius):
    """Count a frame in the columns of the table."""
    seen, in_view, missed, last_seen, out_of_view, unseen = counts
    _, local, uv, in_image, points, sigma = view
    any_measured = False
    for n in range(len(rows)):
        any_measured = any_measured or measured[n]
    for n in range(len(rows)):
        row, shown = rows[n], expected[n] and not withheld[n]
        shown = shown and not _hidden(uv[n], local[n, 2], radius, feature_uv, order, points, sigma)
        in_view[row] += shown or measured[n]
        missed[row] += shown
        out_of_view[row] += not in_image[n]
        unseen[row] += any_measured and not withheld[n]
        if measured[n]:
            seen[row] += 1
            last_seen[row] = frame
            missed[row] = out_of_view[row] = unseen[row] = 0


@helper
def _hidden(uv, depth, radius, feature_uv, order, points, sigma):
    """Whether most of the features around a landmark's pixel are clearly nearer than it is."""
    near, nearer = 0, 0
    place = first_column(feature_uv, order, uv[0] - radius)
    while place < len(order) and feature_uv[order[place], 0] <= uv[0] + radius:
        f = order[place]
        place += 1
        if abs(feature_uv[f, 1] - uv[1]) <= radius and np.isfinite(sigma[f]):
            near += 1
            # 0.9: a surface nearer than this share of a landmark's depth may hide it
            nearer += points[f, 2] + SIGMAS * sigma[f] < 0.9 * depth
    return radius > 0 and 2 * nearer > near


@helper
def _undetected(counts, row, newest, kept):
    """Whether a landmark is not continuously detected although in view, or forgotten."""
    seen, in_view, missed, last_seen, _, unseen = counts
    erase_missed, share, confirmed, forget_after, _ = kept
    rare = in_view[row] > erase_missed and seen[row] < share * in_view[row]
    unconfirmed = seen[row] < confirmed and unseen[row] > erase_missed and last_seen[row] >= 0
    forgotten = forget_after > 0 and newest - last_seen[row] > forget_after
    return missed[row] >= erase_missed or rare or unconfirmed or forgotten


@helper
def _thin_out(rows, counts, seen_from, positions, erase_missed, spacing, going):
    """Mark in `going` (N,) which landmarks out of view are redundant."""
    seen, _, _, last_seen, _, unseen = counts
    gone, reach = np.zeros(len(rows), np.bool_), np.zeros(len(rows))
    for n in range(len(rows)):
        gone[n] = unseen[rows[n]] > erase_missed and np.isfinite(seen_from[rows[n], 0])
        reach[n] = spacing * _distance(positions[n], seen_from[rows[n]])
    for n in range(len(rows)):
        if not (gone[n] and unseen[rows[n]] <= 2 * erase_missed and last_seen[rows[n]] >= 0):
            continue
        for other in range(len(rows)):
            if gone[other] and other != n and _distance(positions[n], positions[other]) < min(reach[n], reach[other]):
                going[n if _gives_way(seen, rows, n, other) else other] = True
