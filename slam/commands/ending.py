"""How a command ends: a signal lets the present frame and its files be completed, an error is one line and a status."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from slam.errors import PartError, SlamError, one_line
from slam.files import reason

if TYPE_CHECKING:
    from slam.data import FrameResult

#: Signals that end a run with all its files: Ctrl-C, a request to end, a closed terminal.
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")

_pending: list[int] = []  # a signal that waits for the end of a frame
_in_frames = False
_until: threading.Event | None = None  # ends the frames of a live run


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
    """Stop at once; while frames are worked on, after the present one, so that all files agree. Twice: at once.

    Frames of a live run are not waited for any more; that is how one from a camera ends.
    """
    if not _in_frames or _pending or (_until is not None and _until.is_set()):
        raise Stopped(number)
    if _until is not None:
        _until.set()
        if number == signal.SIGINT:
            return
    _pending.append(number)


@contextmanager
def whole_frames(
    after_frame: Callable[[FrameResult], None], folder: Path, until: threading.Event | None = None
) -> Iterator[Callable[[FrameResult], None]]:
    """A callback for the end of every frame, at which a signal that came meanwhile takes effect.

    It calls `after_frame`, too. A signal's message names the run's `folder`. Where there is `until`, a signal sets it:
    its run then has no more frames, and Ctrl-C has no further effect.
    """
    global _in_frames, _until
    done = 0

    def end_of_frame(result: FrameResult) -> None:
        nonlocal done
        after_frame(result)
        done += 1
        if _pending:
            raise Stopped(_pending.pop())

    _in_frames, _until = True, until
    try:
        yield end_of_frame
        if _pending:  # no frame came after it
            raise Stopped(_pending.pop())
    except Stopped as stopped:
        kept = f"frames done so far are kept: `slam plot {shlex.quote(str(folder))}` draws them"
        stopped.leaves = kept if done else "no frame was done yet"
        raise
    finally:
        _in_frames, _until = False, None


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
