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
    line, status = "", 2
    try:
        yield
        return
    except SlamError as error:
        if os.environ.get("SLAM_DEBUG"):
            raise
        line = f"{error}{'; with SLAM_DEBUG=1 there is a traceback' if isinstance(error, PartError) else ''}"
    except BrokenPipeError:  # whoever read the output has gone
        status = 1
    except OSError as error:
        line = one_line(f"{f'{error.filename}: ' if error.filename else ''}{reason(error)}")
    except MemoryError:
        line = "there is not enough memory for this"
    except Stopped as stopped:
        line, status = f"stopped by {stopped}{stopped.leaves and f'; {stopped.leaves}'}", 128 + stopped.number
    try:
        if line:
            print(f"slam: {line}", file=sys.stderr, flush=True)
        else:
            sys.stdout = _nowhere()
    except OSError:  # no terminal is left to say it on
        sys.stderr = _nowhere()
    sys.exit(status)


def _nowhere() -> IO[str]:
    """A stream of which nothing is kept: Python flushes standard streams at its end, which must not fail."""
    return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123
