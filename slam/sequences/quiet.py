"""Silence for what image and video libraries print on standard error: their faults are reported by us, once."""

from __future__ import annotations

import os
import re
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

#: How lines of libpng, libjpeg, libtiff, OpenCV and ffmpeg begin; other lines, of other threads, are passed on.
_LIBRARIES = re.compile(
    rb"libpng |Corrupt JPEG|Premature end of JPEG|Invalid (JPEG|SOS|crop|component)|Not a JPEG|JPEG |Bogus |"
    rb"Inconsistent |Warning: unknown JFIF|TIFF|\[ *(WARN|ERROR|INFO)|\[[\w,/ ]+ @ 0x|OpenCV|VIDEOIO|Unexpected |"
    rb"[Uu]nsupported |[Ff]rame size|moov atom|.*: (Invalid data found|No such file)|(Error|Could not|Cannot) |"
    rb"imdecode_|global |\s*$"
)
_lock = threading.Lock()
_inside = 0
_kept = _aside = -1  # the real standard error meanwhile, and where lines go


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep OpenCV, and the libraries below it, from printing what is about to be reported as an error of ours.

    They write to descriptor 2 itself, which all threads share: whoever comes first turns it aside, whoever leaves last
    turns it back, and lines that are not the libraries' are printed then.
    """
    _count(1)
    try:
        yield
    finally:
        _count(-1)


def _count(step: int) -> None:
    global _inside, _kept, _aside
    with _lock, suppress(OSError):  # standard error is closed: nothing can be printed there
        _inside += step
        if _inside == step == 1:
            _kept = os.dup(2)
            if hasattr(os, "memfd_create"):
                _aside = os.memfd_create("standard error")
            else:
                with tempfile.TemporaryFile() as file:
                    _aside = os.dup(file.fileno())
            os.dup2(_aside, 2)
        elif not _inside and _kept >= 0:
            os.dup2(_kept, 2)
            os.close(_kept)
            _kept = -1
            os.lseek(_aside, 0, os.SEEK_SET)
            printed = os.read(_aside, 2**20)
            os.close(_aside)
            os.write(2, b"".join(line for line in printed.splitlines(keepends=True) if not _LIBRARIES.match(line)))
