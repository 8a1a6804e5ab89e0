"""The fast Hessian detector written plainly and slowly, on the conventions of OpenCV's implementation: a reference."""

from __future__ import annotations

import numpy as np

#: Lobes (left, top, right, bottom, weight) of the 9x9 filters; larger ones have all corners scaled and rounded.
DXX = ((0, 2, 3, 7, 1), (3, 2, 6, 7, -2), (6, 2, 9, 7, 1))
DYY = tuple((top, left, bottom, right, w) for left, top, right, bottom, w in DXX)
DXY = ((1, 1, 4, 4, 1), (5, 1, 8, 4, -1), (1, 5, 4, 8, -1), (5, 5, 8, 8, 1))


def plain_keypoints(image, threshold, octaves, layers):
    """Keypoints (N, 6): x, y [px], size [px], response, sign of the Laplacian, octave."""
    sums = np.pad(np.cumsum(np.cumsum(image.astype(np.int64), axis=0), axis=1), ((1, 0), (1, 0)))
    rows = [row for o in range(octaves) for row in octave_keypoints(sums, threshold, o, layers)]
    return np.array(rows).reshape(-1, 6)


def octave_keypoints(sums, threshold, octave, layers):
    """Those of one octave."""
    step, sizes = 1 << octave, [(9 + 6 * k) << octave for k in range(layers + 2)]
    maps = [responses(sums, size, step) for size in sizes]
    height, width = maps[0][0].shape
    for layer in range(1, layers + 1):
        margin = sizes[layer + 1] // 2 // step + 1
        for i in range(margin, height - margin):
            for j in range(margin, width - margin):
                cube = np.array([maps[k][0][i - 1 : i + 2, j - 1 : j + 2] for k in range(layer - 1, layer + 2)])
                if cube[1, 1, 1] <= threshold or (cube >= cube[1, 1, 1]).sum() > 1:
                    continue
                shift = interpolated(cube)
                if shift is None:
                    continue
                first = np.array([j, i]) - sizes[layer] // 2 // step
                at = step * (first + shift[:2]) + 0.5 * (sizes[layer] - 1)
                size = np.rint(sizes[layer] + shift[2] * (sizes[layer] - sizes[layer - 1]))
                yield *at, size, cube[1, 1, 1], np.sign(maps[layer][1][i, j]), octave


def responses(sums, size, step):
    """Determinant and trace of the Hessian on the octave's grid, zero where the filter leaves the image.

    Determinants are rounded to single precision: equal ones, none of which is a maximum, are then equal.
    """
    height, width = sums.shape[0] - 1, sums.shape[1] - 1
    maps = np.zeros((2, height // step, width // step))
    if size > min(height, width):
        return maps
    rows, columns = 1 + (height - size) // step, 1 + (width - size) // step
    xx, yy, xy = (filtered(sums, lobes, size, step, rows, columns) for lobes in (DXX, DYY, DXY))
    margin = size // 2 // step
    maps[:, margin : margin + rows, margin : margin + columns] = np.float32(xx * yy - 0.81 * xy**2), xx + yy
    return maps


def filtered(sums, lobes, size, step, rows, columns):
    """Weighted means of the pixels in the lobes, for filters `step` apart."""
    total = np.zeros((rows, columns))
    y, x = step * np.arange(rows)[:, None], step * np.arange(columns)[None]
    for *corners, weight in lobes:
        left, top, right, bottom = (int(np.rint(size * c / 9)) for c in corners)
        box = sums[y + bottom, x + right] - sums[y + top, x + right] - sums[y + bottom, x + left]
        total += weight * (box + sums[y + top, x + left]) / ((right - left) * (bottom - top))
    return total


def interpolated(cube):
    """Offset (x, y, layer) of the maximum of the quadratic through the responses; None where out of reach."""
    c = cube.transpose(2, 1, 0)  # by x, y, layer
    axes, middle = tuple(np.eye(3, dtype=int)), np.ones(3, int)

    def at(*steps):
        return c[tuple(middle + sum(steps))]

    gradient = [0.5 * (at(a) - at(-a)) for a in axes]
    mixed = [[0 if a is b else at(a, b) - at(a, -b) - at(-a, b) + at(-a, -b) for b in axes] for a in axes]
    hessian = np.array(mixed) / 4
    np.fill_diagonal(hessian, [at(a) - 2 * at(0 * a) + at(-a) for a in axes])
    if np.linalg.det(hessian) == 0:
        return None
    shift = -np.linalg.solve(hessian, gradient)
    return shift if shift.any() and (np.abs(shift) <= 1).all() else None
