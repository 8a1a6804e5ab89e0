"""Where a run's files go: a folder of its own."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from slam.errors import SlamError

RESULTS = Path("results")
_LONGEST = 60  # characters of a sequence's name in a folder's


@contextmanager
def run_folder(out: Path | None, sequence: str, backend: str) -> Iterator[Path]:
    """The folder for a run; one that was made here is removed where nothing was written into it.

    Args:
        out: as asked for; None for ``results/<sequence>-<backend>-<n>`` with the first number that is free.
        sequence: its name.
        backend: name.

    Raises:
        SlamError: a folder cannot be made.
    """
    if out is not None:
        yield out
        return
    folder = _claimed(f"{_short(sequence)}-{_short(backend)}")
    try:
        yield folder
    finally:
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def _claimed(name: str) -> Path:
    """A new folder of this name and the first free number; made here, so that no other run can take it."""
    number = 1
    while True:
        folder = RESULTS / f"{name}-{number}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            if not RESULTS.is_dir():
                raise SlamError(f"{RESULTS}: a file where the folder of all results should be; give --out") from None
            number += 1
        except OSError as error:
            raise SlamError(f"cannot write to {folder}: {error.strerror or error}; give --out") from error


def _short(text: str) -> str:
    """A name for a folder: of a world its name alone."""
    plain = re.sub(r"[^A-Za-z0-9._]+", "_", text.partition("?")[0]).strip("_.")
    return plain[-_LONGEST:] or "run"
