"""Integral images for box filters, exact for 8 and 16 bit images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def integral_image(image: NDArray) -> NDArray[np.int32]:
    """Integral image (H+1, W+1) int32 of a grey image (H, W): ``sum(y, x) = image[:y, :x].sum()``.

    Sums wrap around modulo 2**32. Differences of them stay exact as long as one box sum fits 31 bits, which it does
    for every filter size in use, also with 16-bit pixels.
    """
    if not image.size:
        return np.zeros((image.shape[0] + 1, image.shape[1] + 1), np.int32)
    if image.dtype != np.uint8:  # exact below 2**53
        return float_integral_image(image).astype(np.int64).astype(np.int32)
    import cv2

    return cv2.integral(image, sdepth=cv2.CV_32S)


def float_integral_image(image: NDArray) -> NDArray[np.float64]:
    """The same of a grey image that is not empty, in float64, which may be interpolated: no sum wraps around."""
    import cv2

    return cv2.integral(image, sdepth=cv2.CV_64F)


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
