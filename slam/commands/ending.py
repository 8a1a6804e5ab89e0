"""How a command ends: a signal lets the present frame and its files be completed, an error is one line and a status."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from slam.errors import PartError, SlamError, one_line
from slam.files import reason

#: Signals that end a run with all its files: Ctrl-C, a request to end, a closed terminal.
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")

_until: threading.Event | None = None  # that a run looks at after each frame
_received = 0  # the signal that set it


class Stopped(BaseException):
    """Asked to end by a signal; no handler of errors catches it, and files are completed on the way out."""

    leaves = ""  # what there is of the work, in words; empty where nothing is to be said

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def catch_signals() -> None:
    """Have the signals raise `Stopped`, but for those that this process is told to ignore, as `nohup` has it."""
    for name in _SIGNALS:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _stop(number: int, frame: object) -> None:
    """Stop at once; a run after its present frame, so that all files agree. Twice: at once."""
    global _received
    if _until is None or _until.is_set():
        raise Stopped(number)
    _received = number
    _until.set()


@contextmanager
def ended_by_signals(folder: Path, live: bool = False) -> Iterator[threading.Event]:
    """What a signal sets, so that a run has no more frames; it raises `Stopped` when the run has left its files.

    Ctrl-C is how a `live` run ends, and has no further effect there. A signal's message names the run's `folder`.
    """
    global _until
    _until = until = threading.Event()
    try:
        yield until
        if until.is_set() and not (live and _received == signal.SIGINT):
            raise Stopped(_received)
    except Stopped as stopped:
        stopped.leaves = f"frames done so far are kept: `slam plot {shlex.quote(str(folder))}` draws them"
        raise
    finally:
        _until = None


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
