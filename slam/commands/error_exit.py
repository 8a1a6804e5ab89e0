"""How the command ends where something fails: one line on standard error, and an exit status.

Where standard output or standard error cannot be written, as on a full disk, the work goes on: files matter more.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

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


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Standard output and error that take nothing from the work where they cannot be written any more.

    What was for standard output and is lost makes the exit status 2 in the end; a reader that has gone is an error.
    """
    before = sys.stdout, sys.stderr
    output, messages = (_Stream(stream or _nowhere()) for stream in before)
    sys.stdout, sys.stderr = cast("IO[str]", output), cast("IO[str]", messages)
    status: object = 0
    try:
        yield
    except SystemExit as end:
        status = end.code
        raise
    finally:
        try:
            messages.flush()
            output.flush()
        finally:
            sys.stdout, sys.stderr = (
                stream if own.failure is None and stream else _nowhere()
                for own, stream in zip((output, messages), before)
            )
        if output.failure is not None and not status:
            _end(f"slam: standard output: {reason(output.failure)}", 2)


class _Stream:
    """A standard stream; what cannot be written is dropped from then on, and the failure is kept."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, as far as it can be written."""
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered, as far as it can be written."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[[], object]) -> None:
        try:
            if self.failure is None:
                action()
        except BrokenPipeError:
            raise
        except OSError as error:
            self.failure = error


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
