"""How a command ends: a signal lets the present frame and its files be completed, an error is one line and a status."""

from __future__ import annotations

import os
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from slam.errors import PartError, SlamError, one_line
from slam.files import reason
from slam.run.until import Until

if TYPE_CHECKING:
    from slam.run.run_record import RunRecord

#: Signals that end a run with all its files: Ctrl-C, a request to end, a closed terminal.
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Stopped(BaseException):
    """Asked to end by a signal; no handler of errors catches it, and files are completed on the way out."""

    leaves = ""  # what there is of the work, in words; empty where nothing is to be said

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def catch_signals() -> None:
    """Have the signals raise `Stopped`, but for those that this process is told to ignore, as `nohup` has it."""
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _stop(number: int, frame: object) -> None:
    raise Stopped(number)


@contextmanager
def ended_by_signals(folder: Path, record: RunRecord, live: bool = False) -> Iterator[Until]:
    """What a signal sets, so that a run has no more frames; it raises `Stopped` when the run has left its files.

    A second signal stops it at once. Ctrl-C is how a `live` run ends, and has no further effect there. A signal's
    message names the run's `folder`, where its `record` has a frame.
    """
    until, received = Until(), list[int]()

    def receive(number: int, frame: object) -> None:
        if received:
            raise Stopped(number)
        received.append(number)
        if number != signal.SIGINT:
            until.ended = f"stopped: {signal.Signals(number).name}"
        until.set()

    caught = [number for number in _SIGNALS if signal.getsignal(number) is _stop]
    for number in caught:
        signal.signal(number, receive)
    try:
        yield until
        if received and not (live and received == [signal.SIGINT]):
            raise Stopped(received[0])
    except Stopped as stopped:
        kept = f"frames done so far are kept: `slam plot {shlex.quote(str(folder))}` draws them"
        stopped.leaves = kept if record.numbers else "no frame was done yet"
        raise
    finally:
        for number in caught:
            signal.signal(number, _stop)


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
