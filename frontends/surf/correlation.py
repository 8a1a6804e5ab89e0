"""Sub-pixel positions by image correlation: Gauss-Newton alignment of an image's patch to another image's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import helper, kernel, vector_helper

_HALVES = (7, 11)  # half widths of the two patch sizes [px]
_LARGE = 24.0  # size of a feature from which the larger patch is compared [px]
_LARGEST = (2 * _HALVES[1] + 1) * (2 * _HALVES[1] + 2)  # pixels of the larger patch, with one more in each row
_WIDER = (2 * _HALVES[1] + 3) * (2 * _HALVES[1] + 4)  # of samples a pixel wider on each side
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


@helper
def _sample_warped(patch, centre, warp, half, out):
    """Bilinear samples (2 half + 1, 2 half + 2) of a patch, warped about its centre; False where the patch ends."""
    size, lanes = len(patch), 2 * half + 2
    for r in range(2 * half + 1):
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


@vector_helper
def _gradients(sampled, half, planes):
    """The patch (rows, lanes) and its gradients, into planes 0 to 2, of samples that are a pixel wider on each side."""
    patch, gx, gy = planes[0], planes[1], planes[2]
    lanes, weight = 2 * half + 2, np.float32(0.5)
    stride = lanes + 2
    for r in range(2 * half + 1):
        at, to = np.uint64((r + 1) * stride + 1), np.uint64(r * lanes)
        for c in range(lanes):
            k, j = at + np.uint64(c), to + np.uint64(c)
            patch[j] = sampled[k]
            gx[j] = weight * (sampled[k + np.uint64(1)] - sampled[k - np.uint64(1)])
            gy[j] = weight * (sampled[k + np.uint64(stride)] - sampled[k - np.uint64(stride)])


@vector_helper
def _template(planes, window, n):
    """Weighted patch and gradients of n pixels, into planes 3 to 5, and their weighted sums.

    Returns the patch's mean and standard deviation; the gradients' sums x, y; the normal matrix xx, xy, yy of the
    gradients less their means; and the sums of gradients times patch, x, y.
    """
    patch, dx, dy, weighted, gx, gy = planes[0], planes[1], planes[2], planes[3], planes[4], planes[5]
    zero = np.float32(0.0)
    s, ss, sx, sy, xx, xy, yy, px, py = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for j in range(n):
        w, v, x, y = window[j], patch[j], dx[j], dy[j]
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
def _compare(patch, planes, window, n):
    """Weighted sums over another patch: itself, its deviation, times the template, times the gradients x and y."""
    weighted, gx, gy = planes[3], planes[4], planes[5]
    zero = np.float32(0.0)
    s, ss, both, px, py = zero, zero, zero, zero, zero
    for j in range(n):
        v = patch[j]
        wv = window[j] * v
        s += wv
        ss += wv * v
        both += weighted[j] * v
        px += gx[j] * v
        py += gy[j] * v
    return s, np.sqrt(max(ss - s * s, zero)), both, px, py


@helper
def _best_place(image, shape, start, reach, min_correlation, window, half, planes, other):
    """Where an image looks like a patch with these gradients, by steps from a start (x, y); NaN where nowhere."""
    rows, lanes = 2 * half + 1, 2 * half + 2
    n = rows * lanes
    mean, deviation, sx, sy, xx, xy, yy, tx, ty = _template(planes, window, n)
    det = xx * yy - xy * xy
    if deviation < 1e-3 or det <= 1e-4 * (xx + yy) ** 2:
        return np.nan, np.nan
    x, y = start
    for _ in range(_ITERATIONS):
        if not _sample(image, shape, x, y, half, rows, lanes, other):
            break
        mean2, deviation2, both, px, py = _compare(other, planes, window, n)
        if deviation2 < 1e-3:
            break
        gain = deviation / deviation2
        ex = (tx - mean * sx) - gain * (px - mean2 * sx)
        ey = (ty - mean * sy) - gain * (py - mean2 * sy)
        step_x, step_y = (yy * ex - xy * ey) / det, (xx * ey - xy * ex) / det
        x, y = x + step_x, y + step_y
        if not (abs(x - start[0]) <= reach[0] and abs(y - start[1]) <= reach[1]):
            break
        if step_x * step_x + step_y * step_y < _CONVERGED * _CONVERGED:
            if (both - mean * mean2) / (deviation * deviation2) >= min_correlation:
                return x, y
            break
    return np.nan, np.nan


@kernel
def align(source, at, warps, image, size, start, min_correlation, reaches, windows):
    """Pixels (N, 2) to sub-pixel accuracy at which an image looks as patches do; NaN where the first pass fails.

    The patch in the image moves in both directions until its difference from the given one is least; brightness offset
    and contrast are removed from both. This fails where a patch leaves the image, has no texture, moves further than
    its reach from the start, does not converge, or correlates below `min_correlation`. Another pass, with other
    windows, starts where the one before ended; where it fails that one's result stands.

    Args:
        source: patches (N, S, S), see `cut_patches`; or another image (1, H, W), which is not warped.
        at: the pixels in them (N, 2).
        warps: matrices (N, 2, 2) that take offsets in the image to offsets in the patch; (0, 2, 2) of an image.
        image: grey (H, W) float32.
        size: of the features (N,) [px]; large ones are compared in large patches.
        start: first guess of the pixels (N, 2); nothing is found where it is outside of the image, or NaN.
        min_correlation: least normalised correlation.
        reaches: largest shift along the row and across (P, 2) [px], in each pass.
        windows: of each pass (P, 2, 552), see `patch_windows`.
    """
    out, shape, pixels, kind = np.full((len(start), 2), np.nan), image.shape, image.reshape(-1), np.float32
    sampled, planes, other = np.empty(_WIDER, kind), np.empty((6, _LARGEST), kind), np.empty(_LARGEST, kind)
    frame, flat = source.shape[1:], source[0].reshape(-1) if len(warps) == 0 and len(source) else pixels
    for i in range(len(start)):
        if not (0.0 <= start[i, 0] < shape[1] and 0.0 <= start[i, 1] < shape[0]):
            continue
        k = 0 if size[i] < _LARGE else 1
        half = _HALVES[k]
        if len(warps) == 0:
            sees = _sample(flat, frame, at[i, 0], at[i, 1], half + 1, 2 * half + 3, 2 * half + 4, sampled)
        else:
            sees = _sample_warped(source[i], at[i], warps[i], half + 1, sampled)
        if not sees:
            continue
        _gradients(sampled, half, planes)
        x, y = start[i, 0], start[i, 1]
        for p in range(len(windows)):
            x, y = _best_place(pixels, shape, (x, y), reaches[p], min_correlation, windows[p, k], half, planes, other)
            if np.isnan(x):
                break
            out[i, 0], out[i, 1] = x, y
    return out


def cut_patches(image: NDArray[np.float32], uv: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The image (H, W) around pixels (N, 2), as patches (N, S, S), and the pixels in them (N, 2).

    Patches are NaN beyond the image and where a pixel is not finite.
    """
    whole = np.floor(np.where(np.isfinite(uv), uv, -2.0 * _MARGIN)).astype(np.intp)
    offsets = np.arange(-_MARGIN, _MARGIN + 1)
    x, y = whole[:, 0, None] + offsets, whole[:, 1, None] + offsets
    height, width = image.shape
    patches = image[y.clip(0, height - 1)[:, :, None], x.clip(0, width - 1)[:, None, :]]
    patches[(y < 0) | (y >= height)] = np.nan
    patches.transpose(0, 2, 1)[(x < 0) | (x >= width)] = np.nan
    return patches, _MARGIN + uv - whole
