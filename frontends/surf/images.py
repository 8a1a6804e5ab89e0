"""Any image a camera gives, as the grey, contiguous array that the kernels read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.errors import SequenceError
from slam.grey_range import grey_range

_FALL = 0.98  # of the grey value that counts as white, from image to image

#: Largest pixel value by type: responses are on the scale of 8-bit images.
FULL_SCALE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}


def grey(image: NDArray, what: str = "image") -> NDArray:
    """A grey image (H, W), C-contiguous and writeable, uint8 or uint16, from grey, BGR or BGRA of any layout.

    Raises:
        SequenceError: not an array of such a shape and type; the line begins with `what`.
    """
    image = np.asarray(image)
    if image.dtype.newbyteorder("=") not in FULL_SCALE:
        raise SequenceError(f"{what}: pixels must be uint8 or uint16, not {image.dtype}")
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.ndim not in (2, 3) or channels not in (1, 3, 4):
        raise SequenceError(f"{what}: shape {image.shape} is not (H, W), (H, W, 3) or (H, W, 4)")
    native = np.require(image, image.dtype.newbyteorder("="), ["C", "W"])
    if channels == 1:
        return native.reshape(image.shape[:2])
    if native.size == 0:
        return native[:, :, 0].copy()
    import cv2

    return cv2.cvtColor(native, cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY)


class FullScale:
    """The grey value that counts as white: for 16-bit images it follows the range that they use.

    Thresholds on contrast are on the scale of 8-bit images. A camera that uses a small part of 16 bits would be below
    all of them. White is twice the used range, and the type's largest value at most: images that use half of their
    type's range are not scaled. It falls slowly, so that views of little contrast in between keep their scale.
    """

    def __init__(self) -> None:
        self._last = 0.0

    def of(self, image: NDArray) -> float:
        """White of an image (H, W) or (H, W, C), uint8 or uint16, the next one of its camera."""
        most = FULL_SCALE[image.dtype.newbyteorder("=")]
        if image.dtype.itemsize == 1:
            return most
        low, high = grey_range(image)
        self._last = min(max(2.0 * (high - low), _FALL * self._last, FULL_SCALE[np.dtype(np.uint8)]), most)
        return self._last


def binary_mask(mask: NDArray, shape: tuple[int, ...], what: str = "mask") -> NDArray[np.uint8]:
    """A mask (H, W) as 0 and 1.

    Raises:
        SequenceError: the mask's shape is not the image's.
    """
    mask = np.asarray(mask)
    if mask.shape != shape:
        raise SequenceError(f"{what}: shape {mask.shape} is not the image's, {shape}")
    return (mask != 0).astype(np.uint8)
