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
from pathlib import Path

from slam.errors import SlamError
from slam.files import reason

_OURS = (("config.json", "frames.csv"), ("sweep.json",))  # what folders of a run and of a comparison hold


@dataclass(frozen=True)
class Output:
    """A file to be written, or a folder with the files that are written into it; folders above are made."""

    path: Path  # of the file or folder
    option: str  # that names it on the command line, for messages
    # of a folder, what is written into it: names or patterns (``*.png``), with a ``/`` at the end those of folders;
    # None for a file
    names: Sequence[str] | None = None

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
        if self.names is None:
            return [self.path] if self.path.exists() else []
        return sorted(path for path in self.path.iterdir() if self.writes(path.name)) if self.path.is_dir() else []


def require_outputs(outputs: Sequence[Output], inputs: Iterable[Path] = (), overwrite: bool | None = False) -> None:
    """Raise SlamError where an output could not be written, or would replace what is there.

    `inputs` are files that the command reads, and folders whose files it reads: these are never replaced, others if
    `overwrite` is true, which is None for a command without such an option.
    """
    if nul := next((output.path for output in outputs if "\0" in str(output.path)), None):
        raise SlamError(f"{nul}: no possible file name")
    read = [Path(os.path.realpath(path)) for path in inputs]
    for output in outputs:
        try:
            _require_place(output)
            filled = output.names is not None and output.path.is_dir() and any(output.path.iterdir())
            for path in [*output.present, *([output.path] if filled else [])]:
                if any(_is_input(path, file) for file in read):
                    raise SlamError(f"{path}: is an input, or in a folder of inputs; give another {output.option}")
            for path in output.present:
                if not overwrite:
                    allow = "" if overwrite is None else ", or --overwrite to replace it"
                    raise SlamError(f"{path}: is there already; give another {output.option}{allow}")
                if output.names is not None:
                    _require_kind(path, path.name not in output.names and f"{path.name}/" in output.names)
        except OSError as fault:
            raise SlamError(f"{output.path}: cannot be written: {reason(fault)}") from fault
        for one in outputs:
            inside = one.names is not None and output.real.parent == one.real and one.writes(output.real.name)
            if one is not output and (inside or one.real == output.real):
                raise SlamError(f"{output.path}: {one.option} and {output.option} cannot write to the same place")


def _require_kind(path: Path, folder: bool) -> None:
    """Raise where what is there is not a folder, or not a regular file."""
    if not (path.is_dir() if folder else path.is_file()):
        kind = "folder" if folder else "regular file"
        raise SlamError(f"{path}: cannot be written: there is something that is not a {kind}")


def _require_place(output: Output) -> None:
    """Raise where there is something else, or nothing can be written."""
    path, exists = output.path, os.path.lexists(output.path)
    if exists:
        path.stat()  # raises for a link to nothing, or in a circle
        _require_kind(path, output.names is not None)
        if not os.access(path, os.W_OK):
            raise PermissionError(13, "Permission denied")
    place = path if output.names is not None and exists else output.real.parent
    above = next(folder for folder in (place, *place.absolute().parents) if os.path.lexists(folder))
    with tempfile.TemporaryFile(dir=above):  # permissions alone do not say it
        pass


def _is_input(path: Path, file: Path) -> bool:
    """Whether a path that exists is an input, or lies in one; a run's folder in a folder of inputs does not count."""
    real = Path(os.path.realpath(path))
    if real == file or (path.exists() and file.exists() and path.samefile(file)):
        return True
    if not (file.is_dir() and real.is_relative_to(file)):
        return False
    between = [folder for folder in (real, *real.parents) if folder != file and folder.is_relative_to(file)]
    return not any(all((f / name).is_file() for name in names) for f in between for names in _OURS)
