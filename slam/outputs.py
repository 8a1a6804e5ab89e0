"""What a command will write, checked before any work is done for it.

Nothing that is there already is replaced without being asked for; an input is never replaced; no two outputs of one
command are the same file.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import permutations
from pathlib import Path

from slam.errors import SlamError
from slam.files import reason

_OURS = (("config.json", "frames.csv"), ("sweep.json",))  # what folders of a run and of a comparison hold


@dataclass(frozen=True)
class Output:
    """A file to be written, or a folder with the files that are written into it."""

    path: Path  # of the file or folder
    option: str  # that names it on the command line, for messages
    # of a folder, what is written into it: names or patterns (``*.png``), with a ``/`` at the end those of folders;
    # None for a file
    names: Sequence[str] | None = None
    makes_folder: bool = False  # the folders above a file are made where they are missing; those of a folder always are

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder."""
        return self.names is not None

    @property
    def real(self) -> Path:
        """The path with all links followed."""
        return Path(os.path.realpath(self.path))

    def writes(self, name: str) -> bool:
        """Whether something of this name is written into the folder."""
        return any(fnmatchcase(name, pattern.rstrip("/")) for pattern in self.names or ())

    @property
    def present(self) -> list[Path]:
        """What of it is there already."""
        if not self.is_folder:
            return [self.path] if self.path.exists() else []
        return sorted(path for path in self.path.iterdir() if self.writes(path.name)) if self.path.is_dir() else []


def require_outputs(outputs: Sequence[Output], inputs: Iterable[Path] = (), overwrite: bool | None = False) -> None:
    """Raise SlamError where an output could not be written, or would replace what is there.

    `inputs` are files that the command reads, and folders whose files it reads: these are never replaced, others if
    `overwrite` is true, which is None for a command without such an option.
    """
    for output in outputs:
        if "\0" in str(output.path):
            raise SlamError(f"{output.path}: no possible file name")
    read = [Path(os.path.realpath(path)) for path in inputs]
    made = {output.real for output in outputs if output.is_folder}
    for output in outputs:
        try:
            if fault := _impossible(output, made):
                raise SlamError(f"{output.path}: cannot be written: {fault}")
            filled = output.is_folder and output.path.is_dir() and next(output.path.iterdir(), None) is not None
            for path in [*output.present, *([output.path] if filled else [])]:
                if any(_is_input(path, file) for file in read):
                    raise SlamError(f"{path}: is an input, or in a folder of inputs; give another {output.option}")
            for path in output.present:
                if not overwrite:
                    allow = "" if overwrite is None else ", or --overwrite to replace it"
                    raise SlamError(f"{path}: is there already; give another {output.option}{allow}")
                if output.names is not None and path.exists():
                    _require_kind(path, path.name not in output.names and f"{path.name}/" in output.names)
        except OSError as fault:
            raise SlamError(f"{output.path}: cannot be written: {reason(fault)}") from fault
    for one, other in permutations(outputs, 2):
        if _clash(one, other):
            raise SlamError(f"{one.path}: {one.option} and {other.option} cannot write to the same place")


def _require_kind(path: Path, folder: bool) -> None:
    """Raise where what is there is not a folder, or not a regular file."""
    if not (path.is_dir() if folder else path.is_file()):
        kind = "folder" if folder else "regular file"
        raise SlamError(f"{path}: cannot be written: there is something that is not a {kind}")


def _impossible(output: Output, made: set[Path]) -> str:
    """Why an output cannot be written; empty where it can. `made` are folders that other outputs make."""
    path, exists = output.path, False
    try:
        exists = bool(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        if output.is_folder and path.is_symlink():
            return "a link to a folder that is not there"
    if exists:
        _require_kind(path, output.is_folder)
        if not os.access(path, os.W_OK):
            return "Permission denied"
    place = path if output.is_folder and exists else output.real.parent
    near = next(folder for folder in path.absolute().parents if os.path.lexists(folder))
    above = next(folder for folder in (place, *place.absolute().parents) if os.path.lexists(folder))
    for folder in (near, above):
        if not folder.is_dir():  # such as a link to nothing
            return f"{folder} is not a folder"
    if above != place and not output.is_folder and not output.makes_folder and place not in made:
        return f"there is no folder {path.parent}"
    with tempfile.TemporaryFile(dir=above):  # permissions alone do not say it
        return ""


def _is_input(path: Path, file: Path) -> bool:
    """Whether a path that exists is an input, or lies in one; a run's folder in a folder of inputs does not count."""
    real = Path(os.path.realpath(path))
    if real == file or (path.exists() and file.exists() and path.samefile(file)):
        return True
    if not (file.is_dir() and real.is_relative_to(file)):
        return False
    between = [folder for folder in (real, *real.parents) if folder != file and folder.is_relative_to(file)]
    return not any(all((f / name).is_file() for name in names) for f in between for names in _OURS)


def _clash(one: Output, other: Output) -> bool:
    """Whether the first output would be one of the other's files, or lie in a file or folder of the other's."""
    inner, outer = one.real, other.real
    same = inner == outer or (one.path.exists() and other.path.exists() and one.path.samefile(other.path))
    if same and one.names is not None and other.is_folder:
        return any(other.writes(name.rstrip("/")) for name in one.names)
    if same or not other.is_folder:
        return same or inner.is_relative_to(outer)
    return inner.is_relative_to(outer) and other.writes(inner.relative_to(outer).parts[0])
