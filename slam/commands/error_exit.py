"""How the command ends where something fails: one line on standard error, and an exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

from slam.commands.signals import Stopped
from slam.errors import PartError, SlamError, one_line
from slam.files import reason


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Errors end the process with one line and an exit status.

    Bad input, files that cannot be read or written, and too little memory: 2. A reader of the output that has gone: 1.
    A signal: 128 + its number. With the environment variable SLAM_DEBUG, a `SlamError` shows its traceback instead.
    """
    try:
        yield
    except SlamError as error:
        if os.environ.get("SLAM_DEBUG"):
            raise
        foreign = isinstance(error, PartError)
        _end(f"slam: {error}{'; with SLAM_DEBUG=1 there is a traceback' if foreign else ''}", 2)
    except BrokenPipeError:  # whoever read the output has gone
        _end("", 1)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _end(f"slam: {one_line(f'{place}{reason(error)}')}", 2)
    except MemoryError:
        _end("slam: there is not enough memory for this", 2)
    except Stopped as stopped:
        _end(f"slam: stopped by {stopped}{stopped.leaves and f'; {stopped.leaves}'}", 128 + stopped.number)


def _nowhere() -> IO[str]:
    """A stream of which nothing is kept: Python flushes standard streams at its end, which must not fail."""
    return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123


def _end(line: str, status: int) -> None:
    """Say why, where there is still a terminal to say it on, and end; no line where a reader has gone."""
    try:
        if line:
            print(line, file=sys.stderr, flush=True)
        else:
            sys.stdout = _nowhere()
    except OSError:
        sys.stderr = _nowhere()
    sys.exit(status)
