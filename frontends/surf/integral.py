"""Integral images for box filters, exact for 8 and 16 bit images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import kernel


def integral_image(image: NDArray) -> NDArray[np.int32]:
    """Integral image (H+1, W+1) int32 of a grey image (H, W): ``sum(y, x) = image[:y, :x].sum()``.

    Sums wrap around modulo 2**32. Differences of them stay exact as long as one box sum fits 31 bits, which it does
    for every filter size in use, also with 16-bit pixels.
    """
    if image.dtype == np.uint8 and image.size:
        import cv2

        return cv2.integral(image, sdepth=cv2.CV_32S)
    return _integral_image(image)


def float_integral_image(image: NDArray) -> NDArray[np.float64]:
    """The same of a grey image that is not empty, in float64, which may be interpolated: no sum wraps around."""
    import cv2

    return cv2.integral(image, sdepth=cv2.CV_64F)


@kernel
def _integral_image(image):
    """The same for pixel types that OpenCV does not sum up in 32 bits."""
    height, width = image.shape
    out = np.empty((height + 1, width + 1), np.int32)
    out[0, :] = 0
    for y in range(height):
        row, above, below = image[y], out[y], out[y + 1]
        running = np.int32(0)
        below[0] = 0
        for x in range(width):
            running = np.int32(running + np.int32(row[x]))
            below[x + 1] = running
        for x in range(1, width + 1):
            below[x] = np.int32(below[x] + above[x])
    return out


def column_phases(integral: NDArray[np.int32], step: int, first: int, last: int) -> NDArray[np.int32]:
    """The columns of an integral image sorted by their remainder: ``out[p, y, j] = integral[y, step * j + p]``.

    A filter that moves in steps of `step` then reads neighbouring memory. Shape (step, H+1, ceil((W+1) / step)); only
    the rows from `first` to before `last` are filled in, and columns beyond the image are not.
    """
    rows, columns = integral.shape
    if step == 1:
        return integral[None]
    out = np.empty((step, rows, -(-columns // step)), np.int32)
    for p in range(step):
        phase = integral[first:last, p::step]
        out[p, first:last, : phase.shape[1]] = phase
    return out
