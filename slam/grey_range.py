"""The range of grey values that an image uses: 16-bit cameras, thermal ones above all, use a small part of theirs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_EVERY = 8  # cost: rows and columns that are looked at
_OUTLIERS = 0.5  # guard: share of pixels that may be dead or glare [%]


def grey_range(image: NDArray) -> tuple[float, float]:
    """Grey values between which nearly all pixels of an image (H, W) or (H, W, C) lie; (0, 0) of an empty one."""
    some = np.asarray(image)[::_EVERY, ::_EVERY]
    if not some.size:
        return 0.0, 0.0
    low, high = np.percentile(some, [_OUTLIERS, 100 - _OUTLIERS])
    return float(low), float(high)


def eight_bits(image: NDArray) -> NDArray[np.uint8]:
    """An image of uint8 as it is; of one of uint16, the range that it uses."""
    if image.dtype == np.uint8:
        return image
    low, high = grey_range(image)
    scaled = (image.astype(np.float32) - low) * (255.0 / max(high - low, 255.0))
    return np.clip(scaled, 0, 255).astype(np.uint8)
