"""Any image a camera gives, as the grey, contiguous array that the kernels read, with its integral image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from frontends.surf.epipolar import HalfImage, float_images
from slam.errors import SequenceError
from slam.grey_range import grey_range
from slam.runtime.compilation import disjoint_vector_helper, kernel

_FALL = 0.98  # of the grey value that counts as white, from image to image

#: Largest pixel value by type: responses are on the scale of 8-bit images.
_FULL_SCALE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}


@dataclass(frozen=True, eq=False)
class Picture:
    """A grey image, ready for detection and description."""

    grey: NDArray  # (H, W) uint8 or uint16, C-contiguous
    white: float  # grey value that counts as white

    @classmethod
    def of(cls, image: NDArray | Picture) -> Picture:
        """From an image that `grey` takes, or as it is."""
        if isinstance(image, Picture):
            return image
        pixels = grey(image)
        return cls(pixels, _FULL_SCALE[pixels.dtype])

    @cached_property
    def floats(self) -> tuple[NDArray[np.float32], HalfImage]:
        """The grey values (H, W) in float32, and the image at half resolution."""
        pixels, *half = float_images(self.grey, np.float32(255.0 / self.white))
        return pixels, HalfImage(*half)

    @cached_property
    def integral(self) -> NDArray[np.int32]:
        """Integral image, see `integral_image`."""
        return integral_image(self.grey)


class Sampler:
    """Images (H, W) at fixed places, interpolated linearly: as ``cv2.remap`` with zero outside, in half the time.

    Args:
        places: columns and rows (2, H, W) float32 of each sample.
    """

    def __init__(self, places: NDArray[np.float32]) -> None:
        ends = np.array(places.shape[:0:-1], np.float32)[:, None, None]  # there all four neighbours are zero
        places = np.clip(places, -1.0, ends)
        columns, rows = whole = np.floor(places)
        self._at = ((rows + 1.0).astype(np.int32) * (places.shape[2] + 3) + (columns + 1.0).astype(np.int32)).ravel()
        self._right, self._down = (places - whole).reshape(2, -1)

    def __call__(self, image: NDArray) -> NDArray:
        """The image (H, W), uint8 or uint16, at these places."""
        height, width = image.shape
        padded = np.zeros((height + 3, width + 3), image.dtype)
        padded[1:-2, 1:-2] = image
        return sampled(padded, self._at, self._right, self._down).reshape(height, width)


@disjoint_vector_helper
def _interpolate(pixels, stride, at, right, down, out):
    s, one = np.uint64(stride), np.uint64(1)
    for j in range(len(at)):
        k = np.uint64(at[j])
        a, b = np.float32(pixels[k]), np.float32(pixels[k + one])
        c, d = np.float32(pixels[k + s]), np.float32(pixels[k + s + one])
        upper, lower = a + right[j] * (b - a), c + right[j] * (d - c)
        out[j] = np.int32(np.rint(upper + down[j] * (lower - upper)))


@kernel
def sampled(image, at, right, down):
    """An image's grey values (N,), interpolated beside and below places in the flat image (N,) by fractions (N,)."""
    out = np.empty(len(at), image.dtype)
    _interpolate(image.reshape(-1), image.shape[1], at, right, down, out)
    return out


def grey(image: NDArray, what: str = "image") -> NDArray:
    """A grey image (H, W), C-contiguous, from one in grey, BGR or BGRA of any layout.

    Raises SequenceError, a line that begins with `what`, where it is no array (H, W), (H, W, 3|4) of uint8 or uint16.
    """
    image = np.asarray(image)
    if image.dtype == object and image.ndim == 0:
        raise SequenceError(
            f"{what}: is {image[()]!r:.40} and no array; of a file it cannot read, cv2.imread gives None"
        )
    if image.dtype.newbyteorder("=") not in _FULL_SCALE:
        whole = image.dtype.kind not in "fb" or (image.size and image.max() > 1)
        cure = "image.astype(np.uint8), if its values are 0 to 255" if whole else "(255 * image).astype(np.uint8)"
        hint = f"; give {cure}" if image.dtype.kind in "fbiu" else ""
        raise SequenceError(f"{what}: pixels must be uint8 or uint16, not {image.dtype}{hint}")
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.ndim not in (2, 3) or channels not in (1, 3, 4):
        raise SequenceError(f"{what}: shape {image.shape} is not (H, W), (H, W, 3) or (H, W, 4)")
    native = np.ascontiguousarray(image, image.dtype.newbyteorder("="))
    if channels == 1:
        return native.reshape(image.shape[:2])
    if native.size == 0:
        return native[:, :, 0].copy()
    import cv2

    return cv2.cvtColor(native, cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY)


def integral_image(image: NDArray) -> NDArray[np.int32]:
    """Integral image (H+1, W+1) int32 of a grey image (H, W): ``sum(y, x) = image[:y, :x].sum()``.

    A 16-bit image is first freed of its mean, which no filter sees, but which would cost single-precision sums of small
    contrasts their last digits. Sums wrap around modulo 2**32. Differences of them stay exact as long as one box sum
    fits 31 bits, which it does for every filter size in use.
    """
    if not image.size:
        return np.zeros((image.shape[0] + 1, image.shape[1] + 1), np.int32)
    import cv2

    if image.dtype != np.uint8:  # exact below 2**53
        centred = image - np.rint(image.mean()).astype(np.float32)
        return cv2.integral(centred, sdepth=cv2.CV_64F).astype(np.int64).astype(np.int32)
    return cv2.integral(image, sdepth=cv2.CV_32S)


def following_white(image: NDArray, last: float) -> float:
    """The grey value that counts as white in an image (H, W), uint8 or uint16, `last` in the image before.

    Thresholds on contrast are on the scale of 8-bit images. A 16-bit camera that uses a small part of its range would
    be below all of them, so white follows the range in use. It is twice that, and the type's largest value at most:
    images that use half of their type's range are not scaled. It falls slowly, so that views of little contrast in
    between keep their scale.
    """
    if image.dtype == np.uint8:
        return 255.0
    low, high = grey_range(image)
    return min(max(2.0 * (high - low), _FALL * last, 255.0), 65535.0)
