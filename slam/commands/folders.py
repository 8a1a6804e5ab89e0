"""Where a run's files go: a folder of its own, and never over those of another run without being told."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from slam.errors import SlamError

RESULTS = Path("results")
_MARKS = ("config.json", "frames.csv", "trajectory.txt", "sweep.json")  # what runs and comparisons leave first
_LONGEST = 60  # characters of a sequence's name in a folder's


@contextmanager
def run_folder(out: Path | None, sequence: str, backend: str, overwrite: bool = False) -> Iterator[Path]:
    """The folder for a run; one that was made here is removed where nothing was written into it.

    Args:
        out: as asked for; None for ``results/<sequence>-<backend>-<n>`` with the first number that is free.
        sequence: its name.
        backend: name.
        overwrite: whether files of an earlier run in `out` may be replaced.

    Raises:
        SlamError: `out` holds another run, or a folder cannot be made.
    """
    if out is not None:
        if not overwrite:
            require_free(out)
        yield out
        return
    folder = _claimed(f"{_short(sequence)}-{_short(backend)}")
    try:
        yield folder
    finally:
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def require_free(out: Path) -> None:
    """Raise SlamError where a folder holds a run or a comparison, or one of its folders does."""
    if _holds_run(out):
        raise SlamError(f"{out}: holds a run already; give another --out, or --overwrite to replace it")
    try:
        folders = list(out.iterdir()) if out.is_dir() else []
    except OSError as error:
        raise SlamError(f"cannot read {out}: {error.strerror or error}") from error
    runs = next((folder.name for folder in folders if _holds_run(folder)), None)
    if runs is not None:
        raise SlamError(f"{out}: holds runs in folders of their own, such as {runs}; give --out {out / 'NAME'}")


def _holds_run(folder: Path) -> bool:
    return any(os.path.exists(folder / mark) for mark in _MARKS)  # noqa: PTH110 (False where it may not be read)


def _claimed(name: str) -> Path:
    """A new folder of this name and the first free number; made here, so that no other run can take it."""
    number = 1
    while True:
        folder = RESULTS / f"{name}-{number}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            if RESULTS.exists() and not RESULTS.is_dir():
                raise SlamError(f"{RESULTS}: a file where the folder of all results should be; give --out") from None
            number += 1
        except OSError as error:
            raise SlamError(f"cannot write to {folder}: {error.strerror or error}; give --out") from error


def _short(text: str) -> str:
    """A name for a folder: of a world its name alone."""
    plain = re.sub(r"[^A-Za-z0-9._]+", "_", text.partition("?")[0]).strip("_.")
    return plain[-_LONGEST:] or "run"
