"""Sub-pixel positions by image correlation: Gauss-Newton alignment of an image's patch to another image's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import helper, kernel, vector_helper

_HALVES = (7, 11)  # half widths of the two patch sizes [px]
_LARGEST = (2 * _HALVES[1] + 1) * (2 * _HALVES[1] + 2)  # pixels of the larger patch, with one more in each row
_ITERATIONS = 12  # numerics: of the alignment at most
_CONVERGED = 0.01  # numerics: px
_MARGIN = 3 * (_HALVES[1] + 1) // 2  # half width of a patch that is kept [px]: it may be seen 1.5 times as large


def patch_windows(spread: float) -> NDArray[np.float32]:
    """Gaussian weights (2, 552) of the pixels of the two patch sizes, by rows, each padded with a zero.

    `spread` is the Gaussian's sigma in units of the patch's half width.
    """
    out = np.zeros((2, _LARGEST), np.float32)
    for k, half in enumerate(_HALVES):
        line = np.exp(-(np.arange(-half, half + 1) ** 2) / (2 * (spread * half) ** 2))
        weights = np.pad(np.outer(line, line) / line.sum() ** 2, ((0, 0), (0, 1)))
        out[k, : weights.size] = weights.reshape(-1)
    return out


@helper
def _work_space():
    """Samples; the patch and its gradients; the other image's patch; the weighted patch and gradients."""
    n, kind = _LARGEST, np.float32
    return (
        np.empty(25 * 26, kind), np.empty(n, kind), np.empty(n, kind), np.empty(n, kind), np.empty(n, kind),
        np.empty(n, kind), np.empty(n, kind), np.empty(n, kind),
    )  # fmt: skip


@helper
def _window_of(size):
    """Number and half width of the window [px] in which a feature of some size [px] is compared."""
    if size < 24.0:
        return 0, _HALVES[0]
    return 1, _HALVES[1]


@vector_helper
def _sample(pixels, shape, x, y, half, rows, lanes, out):
    """Bilinear samples (rows, lanes), flat, the first one at (x - half, y - half); False where outside of the image."""
    if not (y >= half and x >= half and y < shape[0] and x < shape[1]):  # NaN, and more than an integer holds
        return False
    top, left = int(np.floor(y)) - half, int(np.floor(x)) - half
    if top < 0 or left < 0 or top + rows + 1 > shape[0] or left + lanes + 1 > shape[1]:
        return False
    a, b = np.float32(y - np.floor(y)), np.float32(x - np.floor(x))
    stride, one = np.uint64(shape[1]), np.uint64(1)
    for r in range(rows):
        start, to = np.uint64((top + r) * shape[1] + left), np.uint64(r * lanes)
        for c in range(lanes):
            k = start + np.uint64(c)
            first = pixels[k] + a * (pixels[k + stride] - pixels[k])
            second = pixels[k + one] + a * (pixels[k + stride + one] - pixels[k + one])
            out[to + np.uint64(c)] = first + b * (second - first)
    return True


@vector_helper
def _gradients(space, rows, lanes):
    """The patch, and its gradients, of samples that are one pixel wider on each side."""
    sampled, patch, gx, gy = space[:4]
    stride, half = lanes + 2, np.float32(0.5)
    for r in range(rows):
        at, to = np.uint64((r + 1) * stride + 1), np.uint64(r * lanes)
        for c in range(lanes):
            k, j = at + np.uint64(c), to + np.uint64(c)
            patch[j] = sampled[k]
            gx[j] = half * (sampled[k + np.uint64(1)] - sampled[k - np.uint64(1)])
            gy[j] = half * (sampled[k + np.uint64(stride)] - sampled[k - np.uint64(stride)])


@vector_helper
def _template(space, window, k, n):
    """Weighted patch and gradients of n pixels, and their weighted sums.

    Returns the patch's mean and standard deviation; the gradients' sums x, y; the normal matrix xx, xy, yy of the
    gradients less their means; and the sums of gradients times patch, x, y.
    """
    _, patch, dx, dy, _, weighted, gx, gy = space
    zero = np.float32(0.0)
    s, ss, sx, sy, xx, xy, yy, px, py = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for j in range(n):
        w, v, x, y = window[k, j], patch[j], dx[j], dy[j]
        wv, wx, wy = w * v, w * x, w * y
        weighted[j], gx[j], gy[j] = wv, wx, wy
        s += wv
        ss += wv * v
        sx += wx
        sy += wy
        xx += wx * x
        xy += wx * y
        yy += wy * y
        px += wx * v
        py += wy * v
    deviation = np.sqrt(max(ss - s * s, zero))
    return s, deviation, sx, sy, xx - sx * sx, xy - sx * sy, yy - sy * sy, px, py


@vector_helper
def _compare(space, window, k, n):
    """Weighted sums over the other patch: itself, its square, times the template, times the gradients x and y."""
    patch, weighted, gx, gy = space[4:]
    zero = np.float32(0.0)
    s, ss, both, px, py = zero, zero, zero, zero, zero
    for j in range(n):
        v = patch[j]
        wv = window[k, j] * v
        s += wv
        ss += wv * v
        both += weighted[j] * v
        px += gx[j] * v
        py += gy[j] * v
    return s, np.sqrt(max(ss - s * s, zero)), both, px, py


@kernel
def refine(left, right, uv, size, start, min_correlation, reaches, windows):
    """Right pixels (N, 2) to sub-pixel accuracy by image correlation; NaN where the first pass fails.

    The right patch moves in both directions until its difference from the left patch is least; brightness offset
    and contrast are removed from both. This fails where a patch leaves the image, has no texture, moves further than
    its reach from the start, does not converge, or correlates below `min_correlation`. A second pass, with other
    windows, starts where the first one ended; where it fails the first one's result stands.

    Args:
        left: grey image (H, W) float32.
        right: the other one.
        uv: left pixels (N, 2).
        size: of the features (N,) [px]; large ones are compared in large patches.
        start: first guess of the right pixels (N, 2), NaN where there is none.
        min_correlation: least normalised correlation.
        reaches: largest shift along the row and across (P, 2) [px], in each pass.
        windows: of each pass (P, 2, 552), see `patch_windows`.
    """
    out, space, shape = np.full((len(uv), 2), np.nan), _work_space(), left.shape
    left, right = left.reshape(-1), right.reshape(-1)
    for i in range(len(uv)):
        x0, y0 = start[i, 0], start[i, 1]
        if np.isnan(x0):
            continue
        k, half = _window_of(size[i])
        rows, lanes = 2 * half + 1, 2 * half + 2
        if not _sample(left, shape, uv[i, 0], uv[i, 1], half + 1, rows + 2, lanes + 2, space[0]):
            continue
        _gradients(space, rows, lanes)
        for w in range(len(windows)):
            x0, y0 = _best_place(
                right, shape, x0, y0, reaches[w, 0], reaches[w, 1], min_correlation, windows[w], k, half, space
            )
            if np.isnan(x0):
                break
            out[i, 0], out[i, 1] = x0, y0
    return out


@helper
def _best_place(image, shape, x0, y0, reach_x, reach_y, min_correlation, window, k, half, space):
    """Where an image looks like a patch with these gradients, by steps from (x0, y0); NaN where nowhere."""
    rows, lanes = 2 * half + 1, 2 * half + 2
    n = rows * lanes
    mean, deviation, sx, sy, xx, xy, yy, tx, ty = _template(space, window, k, n)
    det = xx * yy - xy * xy
    if deviation < 1e-3 or det <= 1e-4 * (xx + yy) ** 2:
        return np.nan, np.nan
    x, y = x0, y0
    for _ in range(_ITERATIONS):
        if not _sample(image, shape, x, y, half, rows, lanes, space[4]):
            break
        mean2, deviation2, both, px, py = _compare(space, window, k, n)
        if deviation2 < 1e-3:
            break
        gain = deviation / deviation2
        ex = (tx - mean * sx) - gain * (px - mean2 * sx)
        ey = (ty - mean * sy) - gain * (py - mean2 * sy)
        step_x, step_y = (yy * ex - xy * ey) / det, (xx * ey - xy * ex) / det
        x, y = x + step_x, y + step_y
        if not (abs(x - x0) <= reach_x and abs(y - y0) <= reach_y):
            break
        if step_x * step_x + step_y * step_y < _CONVERGED * _CONVERGED:
            if (both - mean * mean2) / (deviation * deviation2) >= min_correlation:
                return x, y
            break
    return np.nan, np.nan


def cut_patches(image: NDArray[np.float32], uv: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The image (H, W) around pixels (N, 2).

    Returns:
        patches (N, S, S), NaN beyond the image and where a pixel is not finite, and the pixels in them (N, 2).
    """
    whole = np.floor(np.where(np.isfinite(uv), uv, -2.0 * _MARGIN)).astype(np.intp)
    offsets = np.arange(-_MARGIN, _MARGIN + 1)
    x, y = whole[:, 0, None] + offsets, whole[:, 1, None] + offsets
    height, width = image.shape
    patches = image[y.clip(0, height - 1)[:, :, None], x.clip(0, width - 1)[:, None, :]]
    patches[(y < 0) | (y >= height)] = np.nan
    patches.transpose(0, 2, 1)[(x < 0) | (x >= width)] = np.nan
    return patches, _MARGIN + uv - whole


@kernel
def align_patches(image, patches, centres, warps, size, start, min_correlation, reach, windows):
    """Pixels (N, 2) at which an image looks as the warped patches do, to sub-pixel accuracy; see `refine`.

    Args:
        image: grey (H, W).
        patches: what is looked for (N, S, S), and
        centres: the pixels in them (N, 2), see `cut_patches`.
        warps: matrices (N, 2, 2) that take offsets in the image to offsets in the patch.
        size: of the features (N,) [px]; large ones are compared in large patches.
        start: first guess of the pixels (N, 2); nothing is found where it is outside of the image, or NaN.
        min_correlation: least normalised correlation.
        reach: largest shift along and across the rows [px].
        windows: see `patch_windows`.
    """
    out, space, shape = np.full((len(start), 2), np.nan), _work_space(), image.shape
    pixels = image.reshape(-1)
    for i in range(len(start)):
        if not (0.0 <= start[i, 0] < shape[1] and 0.0 <= start[i, 1] < shape[0]):
            continue
        k, half = _window_of(size[i])
        rows, lanes = 2 * half + 1, 2 * half + 2
        if not _sample_warped(patches[i], centres[i], warps[i], half + 1, rows + 2, lanes + 2, space[0]):
            continue
        _gradients(space, rows, lanes)
        out[i, 0], out[i, 1] = _best_place(
            pixels, shape, start[i, 0], start[i, 1], reach, reach, min_correlation, windows, k, half, space
        )
    return out


@helper
def _sample_warped(patch, centre, warp, half, rows, lanes, out):
    """Bilinear samples (rows, lanes) of a patch, warped about its centre; False where the patch ends."""
    size = len(patch)
    for r in range(rows):
        for c in range(lanes):
            x = centre[0] + warp[0, 0] * (c - half) + warp[0, 1] * (r - half)
            y = centre[1] + warp[1, 0] * (c - half) + warp[1, 1] * (r - half)
            left, top = int(np.floor(x)), int(np.floor(y))
            if c == lanes - 1:  # beyond the window, which is zero there
                left, top = min(max(left, 0), size - 2), min(max(top, 0), size - 2)
            if left < 0 or top < 0 or left + 1 >= size or top + 1 >= size:
                return False
            a, b = np.float32(y - top), np.float32(x - left)
            first = patch[top, left] + a * (patch[top + 1, left] - patch[top, left])
            second = patch[top, left + 1] + a * (patch[top + 1, left + 1] - patch[top, left + 1])
            value = first + b * (second - first)
            if np.isnan(value):
                return False
            out[r * lanes + c] = value
    return True
