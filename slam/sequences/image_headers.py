"""Sizes of images from their headers alone, so that no image is decoded that is far larger than its file deserves."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

Size = tuple[int, int]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
JPEG_SCAN = 0xDA

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_NUMBERS = {3: "H", 4: "I", 16: "Q"}  # SHORT, LONG, LONG8
_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")


def header_size(data: bytes) -> Size | None:
    """Width and height that an image file's header names; None for no image of a known kind, or a damaged one."""
    for magic, read in _KINDS:
        if data.startswith(magic):
            try:
                return read(data)
            except struct.error:  # cut off
                return None
    return None


def _png(data: bytes) -> Size | None:
    if data[12:16] != b"IHDR":
        return None
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: bytes) -> Size | None:
    at = len(JPEG_START)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker == JPEG_SCAN:
            return None
        at += 1 if marker == 0xFF else 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _pnm(data: bytes) -> Size | None:
    match = _PNM.match(data[:4096])
    return (int(match[1]), int(match[2])) if match else None


def _bmp(data: bytes) -> Size | None:
    (length,) = struct.unpack_from("<I", data, 14)
    if length == 12:  # the form of OS/2
        width, height = struct.unpack_from("<HH", data, 18)
        return width, height
    width, height = struct.unpack_from("<ii", data, 18)
    return (width, abs(height)) if width > 0 else None


def _webp(data: bytes) -> Size | None:
    kind = data[12:16]
    if data[8:12] != b"WEBP":
        return None
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X" and len(data) >= 30:
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    return None


def _tiff(data: bytes) -> Size | None:
    """By the first directory's entries; a BigTIFF has larger ones."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    at += 8 if big else 2
    found: dict[int, int] = {}
    for _ in range(min(count, 4096)):
        tag, kind = struct.unpack_from(order + "HH", data, at)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_NUMBERS:
            found[tag] = struct.unpack_from(order + _TIFF_NUMBERS[kind], data, at + (12 if big else 8))[0]
        at += 20 if big else 12
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


_KINDS: tuple[tuple[bytes, Callable[[bytes], Size | None]], ...] = (
    (PNG_SIGNATURE, _png),
    (JPEG_START, _jpeg),
    (b"BM", _bmp),
    (b"RIFF", _webp),
    *((f"P{i}".encode(), _pnm) for i in range(1, 7)),
    *((mark, _tiff) for mark in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
)
