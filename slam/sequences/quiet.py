"""Silence for what image and video libraries print on standard error: their faults are reported by us, once."""

from __future__ import annotations

import os
import re
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

_STDERR = 2
_SILENT = 0  # OpenCV's log level

#: How lines of libpng, libjpeg, libtiff, OpenCV and ffmpeg begin; other lines, of other threads, are passed on.
_LIBRARIES = re.compile(
    rb"libpng |Corrupt JPEG|Premature end of JPEG|Invalid (JPEG|SOS|crop|component)|Not a JPEG|JPEG |Bogus |"
    rb"Inconsistent |Warning: unknown JFIF|TIFF|\[ *(WARN|ERROR|INFO)|\[[\w,/ ]+ @ 0x|OpenCV|VIDEOIO|Unexpected |"
    rb"[Uu]nsupported |[Ff]rame size|moov atom|.*: (Invalid data found|No such file)|(Error|Could not|Cannot) |"
    rb"imdecode_|global "
)

_lock = threading.Lock()
_inside = 0
_kept = -1  # the real standard error meanwhile


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep OpenCV, and the libraries below it, from printing what is about to be reported as an error of ours.

    They write to descriptor 2 itself, which all threads share: whoever comes first turns it aside, whoever leaves last
    turns it back, and lines that are not the libraries' are printed then.
    """
    get, set_ = _log_level()
    level = get()
    set_(_SILENT)
    _enter()
    try:
        yield
    finally:
        _leave()
        set_(level)


def _log_level() -> tuple[Callable[[], int], Callable[[int], int]]:
    """What asks for and what sets OpenCV's log level: the place differs between its versions."""
    import cv2

    if hasattr(cv2, "setLogLevel"):
        return cv2.getLogLevel, cv2.setLogLevel  # type: ignore[attr-defined, unused-ignore]
    return cv2.utils.logging.getLogLevel, cv2.utils.logging.setLogLevel


def _enter() -> None:
    global _inside, _kept
    with _lock:
        _inside += 1
        if _inside > 1:
            return
        with suppress(OSError):  # standard error is closed: nothing can be printed there
            _kept = os.dup(_STDERR)
            aside = _anonymous_file()
            os.dup2(aside, _STDERR)
            os.close(aside)


def _leave() -> None:
    global _inside, _kept
    with _lock:
        _inside -= 1
        if _inside or _kept < 0:
            return
        with suppress(OSError):
            length = os.lseek(_STDERR, 0, os.SEEK_CUR)
            os.lseek(_STDERR, 0, os.SEEK_SET)
            printed = os.read(_STDERR, min(length, 2**20)) if length else b""
            os.dup2(_kept, _STDERR)
            os.close(_kept)
            others = [line for line in printed.splitlines(keepends=True) if not _LIBRARIES.match(line)]
            if others:
                os.write(_STDERR, b"".join(others))
        _kept = -1


def _anonymous_file() -> int:
    """A file without a name, open for reading and writing: in memory where the system can do that."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("standard error")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
