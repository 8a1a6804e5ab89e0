"""Reading single images: grey, as stored, whole or not at all."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.files import read_bytes
from slam.sequences.quiet import quiet_libraries

Size = tuple[int, int]

#: Endings of image files, in lower case.
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp"})

#: Most pixels of an image: 64 Mi, twice what the largest stereo cameras have.
MOST_PIXELS = 2**26

_LARGEST = 8 * MOST_PIXELS  # bytes of a file
_KINDS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP")  # Pillow's names; PPM is PGM, too
_PNG, _JPEG, _JPEG_SCAN, _JPEG_END = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", 0xDA, b"\xff\xd9"


def read_image(path: Path, size: Size | None = None) -> np.ndarray:
    """The image (H, W) in grey, uint8 or uint16 as stored; colour is converted, EXIF rotation ignored.

    Before anything is decoded the size is taken from the header. PNG checksums and the end marks of PNG and JPEG are
    checked, so that a file that is cut off is never taken for a partly grey image.

    Args:
        path: the file.
        size: width and height that the image must have; None for any up to `MOST_PIXELS`.

    Raises:
        SequenceError: the file is missing, cut off, damaged, or no image, or of another size; the message names it.
    """
    return decode_image(read_bytes(path, _LARGEST), str(path), size)


def decode_image(data: bytes, what: str, size: Size | None = None) -> np.ndarray:
    """The image of the bytes of an image file, as `read_image`; `what` is named in errors.

    Raises:
        SequenceError: they are cut off, damaged, or no image, or of another size.
    """
    import cv2

    fault = _fault(data, size)
    if fault:
        raise SequenceError(f"{what}: {fault}")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    with quiet_libraries():
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, SystemError, MemoryError) as error:
            raise SequenceError(f"{what}: cannot be decoded") from error
    if image is None:
        raise SequenceError(f"{what}: not a readable image")
    if size is not None and image.shape[1::-1] != size:
        raise SequenceError(f"{what}: image is {size_text(image.shape[1::-1])}, not {size_text(size)}")
    if image.dtype not in (np.uint8, np.uint16):
        raise SequenceError(f"{what}: pixels are {image.dtype}, not 8 or 16 bit")
    return image


def halves(image: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    """The left and the right half of an image that holds two side by side.

    Raises:
        SequenceError: its width is odd; the message names `what`.
    """
    width = image.shape[1]
    if width % 2 or width < 2:
        raise SequenceError(f"{what}: an image of {size_text(image.shape[1::-1])} cannot hold two side by side")
    return image[:, : width // 2], image[:, width // 2 :]


def size_text(size: tuple[int, ...]) -> str:
    """A size as text, width first."""
    return "x".join(str(s) for s in size)


def _fault(data: bytes, expected: Size | None) -> str:
    """What is wrong with the bytes of an image file, as far as its frame shows; empty if nothing."""
    if not data:
        return "the file is empty"
    fault = _png_fault(data) if data.startswith(_PNG) else _jpeg_fault(data) if data.startswith(_JPEG) else ""
    if fault:
        return fault
    size = _header_size(data)
    if size is None:
        return "not a readable image"
    if expected is not None and size != expected:
        return f"image is {size_text(size)}, not {size_text(expected)}"
    if min(size) < 1 or size[0] * size[1] > MOST_PIXELS:
        return f"image is {size_text(size)}: at most {MOST_PIXELS} pixels are read"
    return ""


def _header_size(data: bytes) -> Size | None:
    """Width and height that an image file's header names; None for no image of a known kind, or a damaged one."""
    from PIL import Image

    if data.startswith(_PNG):
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    try:
        with warnings.catch_warnings(action="ignore"):
            return Image.open(io.BytesIO(data), formats=_KINDS).size
    except Image.DecompressionBombError:
        return MOST_PIXELS + 1, 1
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, struct.error):  # of damaged headers
        return None


def _png_fault(data: bytes) -> str:
    """Walk the chunks: each must be whole and agree with its checksum, and the last one must be IEND."""
    at = len(_PNG)
    view = memoryview(data)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[at + 4 : end - 4]) != checksum or (at == len(_PNG) and data[12:16] != b"IHDR"):
            return f"PNG is damaged at byte {at}"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end
    return f"PNG is cut off after {len(data)} bytes"


def _jpeg_fault(data: bytes) -> str:
    """Walk the segments to the first scan (an embedded preview is jumped over) and look for the end mark."""
    at = len(_JPEG)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], struct.unpack_from(">H", data, at + 2)[0]
        if marker == _JPEG_SCAN:
            return "" if data.rfind(_JPEG_END, at) >= 0 else f"JPEG is cut off after {len(data)} bytes"
        at += 1 if marker == 0xFF else 2 + length
    return f"JPEG is cut off or damaged at byte {min(at, len(data))}"
