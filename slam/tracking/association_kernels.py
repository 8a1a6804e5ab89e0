"""Compiled loops of `slam.tracking.association`."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel


@kernel
def pairs_in_boxes(centres, reach, x, y, rows, places):
    """Pairs of boxes and of points inside them, by ascending box; returns how many there are.

    Boxes have centres and half sizes `reach` (M, 2); the points x, y (N,) ascend in x. Pairs are written into `rows` of
    boxes and `places` of points as far as there is room.
    """
    count = 0
    for row in range(len(centres)):
        low, high = centres[row, 0] - reach[row, 0], centres[row, 0] + reach[row, 0]
        place, last = 0, len(x)
        while place < last:
            middle = (place + last) // 2
            if x[middle] < low:
                place = middle + 1
            else:
                last = middle
        while place < len(x) and x[place] <= high:
            if abs(y[place] - centres[row, 1]) <= reach[row, 1]:
                if count < len(rows):
                    rows[count], places[count] = row, place
                count += 1
            place += 1
    return count


@kernel
def mutual_best(rows, columns, distance, allowed, size, d_match, ratio):
    """Which pairs (P,) are each other's nearest, nearer than `d_match`, and clearly nearer than the row's second.

    Pairs are of rows and columns, of which there are `size`, and have a distance; those that are not allowed do not
    count.
    """
    nearest, second = np.full(size[0], np.float32(np.inf)), np.full(size[0], np.float32(np.inf))
    of_column, good = np.full(size[1], np.float32(np.inf)), np.zeros(len(rows), np.bool_)
    for p in range(len(rows)):
        if allowed[p]:
            row, column, d = rows[p], columns[p], distance[p]
            if d < nearest[row]:
                second[row], nearest[row] = nearest[row], d
            elif d < second[row]:  # also one that is as near as the first
                second[row] = d
            if d < of_column[column]:
                of_column[column] = d
    for p in range(len(rows)):
        row, d = rows[p], distance[p]
        mutual = allowed[p] and d == nearest[row] and d <= of_column[columns[p]]
        good[p] = mutual and d < d_match and d < ratio * second[row]
    return good
