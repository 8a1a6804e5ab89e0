"""Reading single images: grey, as stored, whole or not at all; and their sizes."""

from __future__ import annotations

import io
import os
import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError, one_line
from slam.files import read_bytes
from slam.geometry.rig import StereoRig

Size = tuple[int, int]  #: width, height

#: Endings of image files, in lower case.
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp"})

#: Most pixels of an image: 64 Mi, twice what the largest stereo cameras have.
MOST_PIXELS = 2**26

_LARGEST = 8 * MOST_PIXELS  # bytes of a file
_KINDS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP")  # Pillow's names; PPM is PGM, too

# What Pillow raises for damaged files.
_DAMAGED = (OSError, SyntaxError, ValueError, LookupError, TypeError, EOFError, MemoryError, zlib.error, struct.error)


def read_image(path: Path, size: Size | None = None) -> np.ndarray:
    """The image (H, W) in grey, uint8 or uint16 as stored; colour is converted, EXIF rotation ignored.

    The size is taken from the header before anything is decoded. A file that is cut off, or a PNG with a wrong
    checksum, is never taken for a partly grey image. SequenceError where the file is missing, damaged or no image, or
    of another `size`.
    """
    return decode_image(read_bytes(path, _LARGEST), str(path), size)


def decode_image(data: bytes, what: str, size: Size | None = None) -> np.ndarray:
    """The image of the bytes of an image file, as `read_image`; `what` is named in errors."""
    from PIL import Image

    if not data:
        raise SequenceError(f"{what}: the file is empty")
    try:
        with warnings.catch_warnings(action="ignore"):
            image = Image.open(io.BytesIO(data), formats=_KINDS)
            require_image_size(image.size, size, what)
            if image.format == "PNG":
                image.verify()  # all checksums
                image = Image.open(io.BytesIO(data), formats=_KINDS)
            image.draft("L", image.size)
            unknown = image.format == "PPM" or (image.mode.startswith("RGB") and ";16" in str(image.tile))
            image.load()
    except Image.UnidentifiedImageError:
        raise SequenceError(f"{what}: not a readable image") from None
    except Image.DecompressionBombError:
        raise SequenceError(f"{what}: at most {MOST_PIXELS} pixels are read") from None
    except _DAMAGED as error:
        raise SequenceError(f"{what}: the image is cut off or damaged: {one_line(str(error))}") from error
    return _by_opencv(data, image.size, what) if unknown else _grey(image, what)


def _grey(image: Any, what: str) -> np.ndarray:
    import cv2

    if image.mode == "L":
        return np.asarray(image)
    if image.mode.startswith(("I", "F")):
        pixels = np.asarray(image)
        if image.mode == "F" or pixels.min() < 0 or pixels.max() > np.iinfo(np.uint16).max:
            raise SequenceError(f"{what}: pixels are {pixels.dtype}, not 8 or 16 bit")
        return pixels.astype(np.uint16)
    return np.asarray(cv2.cvtColor(np.asarray(image.convert("RGB")), cv2.COLOR_RGB2GRAY))


def _by_opencv(data: bytes, size: Size, what: str) -> np.ndarray:
    """The pixels (H, W) of a whole image of which Pillow scales the grey values (PGM), or has no colours of 16 bits."""
    import cv2

    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None or pixels.shape != size[::-1] or pixels.dtype not in (np.uint8, np.uint16):
        raise SequenceError(f"{what}: cannot be decoded")
    return np.asarray(pixels)


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep OpenCV, and ffmpeg below it, from printing what is about to be reported as an error of ours."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = getattr(cv2.utils, "logging", cv2)  # before OpenCV 5, the functions are in `cv2` itself
    before = logging.setLogLevel(0)  # 0: silent
    try:
        yield
    finally:
        logging.setLogLevel(before)


def grabbed_image(capture: Any) -> np.ndarray | None:
    """The image that a ``cv2.VideoCapture`` has grabbed, in grey (H, W), 8 or 16 bits as stored; None for none."""
    import cv2

    with quiet_libraries(), suppress(cv2.error):
        good, image = capture.retrieve()
        if good and image is not None and image.size:
            return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return None


def require_image_size(found: Size, expected: Size | None, what: str) -> None:
    """Raise SequenceError where an image is of another size than expected, or larger than any."""
    if expected is not None and found != expected:
        raise SequenceError(f"{what}: image is {size_text(found)}, not {size_text(expected)}")
    if min(found) < 1 or found[0] * found[1] > MOST_PIXELS:
        raise SequenceError(f"{what}: image is {size_text(found)}: at most {MOST_PIXELS} pixels are read")


def recorded_size(rig: StereoRig) -> Size:
    """Width and height of a rig's images as they are recorded, before they are turned."""
    return (rig.height, rig.width) if rig.turns % 2 else (rig.width, rig.height)


def both(images: Sequence[Any], what: object) -> tuple[Any, Any]:
    """The left and the right image of two, or of one (H, 2W) that holds them side by side; what is no image stands."""
    if len(images) == 2:
        return images[0], images[1]
    (image,) = images
    if not isinstance(image, np.ndarray):
        return image, image
    width = image.shape[1] // 2
    if image.shape[1] % 2 or not width:
        raise SequenceError(f"{what}: an image of {size_text(image.shape[1::-1])} cannot hold two side by side")
    return image[:, :width], image[:, width:]


def require_same_size(left: np.ndarray, right: np.ndarray, *names: object) -> Size:
    """Width and height of both images (H, W); SequenceError, with their names, where they differ in size."""
    if left.shape != right.shape:
        sizes = ", ".join(f"{name} is {size_text(image.shape[::-1])}" for name, image in zip(names, (left, right)))
        raise SequenceError(f"left and right images differ in size: {sizes}")
    return left.shape[1], left.shape[0]


def size_text(size: tuple[int, ...]) -> str:
    """A size as text, width first."""
    return "x".join(str(s) for s in size)
