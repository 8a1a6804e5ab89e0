"""Whether an image's neighbouring pixels belong together: not so in mosaics, interlaced video and swapped bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import Array

_ALTERNATES = 1.1  # guard: difference of neighbours in units of that of the next but one; noise alone gives 1
_SMOOTHER = 0.5  # guard: roughness of the lower byte of each pixel in units of the upper one's, which is smoother


def grain_doubt(image: object) -> str:
    """What is wrong with the grain of an image (H, W) or (H, W, C) of integers, in a line; empty where nothing is."""
    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        return ""
    if min(image.shape) < 1 or min(image.shape[:2]) < 3:
        return ""
    grey = image if image.ndim == 2 else image[:, :, 0]
    if grey.dtype == np.uint16 and 0 < _roughness(grey & 255) < _SMOOTHER * _roughness(grey >> 8):
        return (
            "the two bytes of each pixel look exchanged: 16-bit images of the other byte order; write them again with "
            "image.byteswap()"
        )
    rows, columns = _alternation(grey), _alternation(grey.T)
    if min(rows, columns) > _ALTERNATES:
        return "neighbouring pixels alternate, as in the mosaic of a colour camera (Bayer): give grey or colour images"
    if rows > _ALTERNATES:
        return (
            "rows of the image alternate, as in interlaced video, whose even and odd rows are of two moments: "
            "deinterlace it, or halve the images (cv2.resize)"
        )
    return ""


def _alternation(grey: NDArray) -> float:
    """Mean difference of neighbouring rows in units of that of the next but one; 0 where those are equal."""
    values = np.asarray(grey, np.float32)
    near, far = (float(np.abs(values[step:] - values[:-step]).mean()) for step in (1, 2))
    return near / far if far > 0 else 0.0


def _roughness(grey: NDArray) -> float:
    """Mean difference of neighbouring columns in units of the scatter of all pixels; 0 of a plain image."""
    values: Array = np.asarray(grey, float)
    scatter = float(values.std())
    return float(np.abs(np.diff(values, axis=1)).mean()) / scatter if scatter > 0 else 0.0
