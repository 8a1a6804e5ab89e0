"""Reading single images: grey, as stored, whole or not at all."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam.errors import SequenceError

#: Endings of image files, in lower case.
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp"})

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_SCAN = 0xDA


def read_image(path: Path) -> np.ndarray:
    """The image (H, W) in grey, uint8 or uint16 as stored; colour is converted, EXIF rotation ignored.

    PNG checksums and the end marks of PNG and JPEG are checked first, so that a file that is cut off is never taken
    for a partly grey image.

    Raises:
        SequenceError: the file is missing, cut off, damaged, or no image; the message names it.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise SequenceError(f"{path}: {error.strerror or error}") from error
    fault = _fault(data)
    if fault:
        raise SequenceError(f"{path}: {fault}")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    with quiet_opencv():
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            raise SequenceError(f"{path}: cannot be decoded") from error
    if image is None:
        raise SequenceError(f"{path}: not a readable image")
    if image.dtype not in (np.uint8, np.uint16):
        raise SequenceError(f"{path}: pixels are {image.dtype}, not 8 or 16 bit")
    return image


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from logging what is about to be reported as an error of ours."""
    from cv2.utils import logging

    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


def _fault(data: bytes) -> str:
    """What is wrong with the bytes of an image file, as far as its frame shows; empty if nothing."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG_SIGNATURE):
        return _png_fault(data)
    if data.startswith(_JPEG_START):
        return _jpeg_fault(data)
    return ""


def _png_fault(data: bytes) -> str:
    """Walk the chunks: each must be whole and agree with its checksum, and the last one must be IEND."""
    at = len(_PNG_SIGNATURE)
    view = memoryview(data)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[at + 4 : end - 4]) != checksum:
            return f"PNG is damaged at byte {at}"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end
    return f"PNG is cut off after {len(data)} bytes"


def _jpeg_fault(data: bytes) -> str:
    """Walk the segments to the first scan (an embedded preview is jumped over) and look for the end mark."""
    at = len(_JPEG_START)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], struct.unpack_from(">H", data, at + 2)[0]
        if marker == _JPEG_SCAN:
            return "" if data.rfind(_JPEG_END, at) >= 0 else f"JPEG is cut off after {len(data)} bytes"
        at += 1 if marker == 0xFF else 2 + length
    return f"JPEG is cut off or damaged at byte {min(at, len(data))}"
