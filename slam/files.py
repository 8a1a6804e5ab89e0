"""Safe reading of untrusted files and atomic writing; every reader and writer uses this module.

Only regular files are read, never a pipe or a device that would block, and never more than a limit. Files are written
under a temporary name and then moved: after a full disk or a kill there is the old file or the new one, never a part.
Of zip archives of NumPy arrays, sizes are checked before anything is unpacked, and nothing is executed.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import stat
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from slam.errors import SequenceError, SlamError, text_of

_MEBI = 2**20

#: Most bytes of a text file: tables of stamps and poses, calibrations.
TEXT_LIMIT = 128 * _MEBI
_JSON_LIMIT = 16 * _MEBI

#: Bytes that an archive may unpack to: the larger of this many, and this many times its own size.
_AT_LEAST, _TIMES = 64 * 2**20, 50

_MEMBERS = 100  # most members of an archive
_KINDS = "biufU"  # of arrays: numbers and text, never objects

_inputs: ContextVar[list[Path] | None] = ContextVar("inputs", default=None)


@contextmanager
def noting_inputs() -> Iterator[list[Path]]:
    """A list of what is read meanwhile: files, and folders of which all is an input."""
    noted: list[Path] = []
    token = _inputs.set(noted)
    try:
        yield noted
    finally:
        _inputs.reset(token)


def note_input(path: str | Path) -> None:
    """Say that a file, or what is in a folder, is read."""
    noted = _inputs.get()
    if noted is not None:
        noted.append(Path(path).absolute())


def _status(path: str | Path, error: type[SlamError], expected: str = "") -> os.stat_result:
    """That of a regular file that is read now; raises `error` where there is none."""
    try:
        status = Path(path).stat()
    except OSError as fault:
        raise error(f"{path}: {reason(fault)}") from fault
    except (ValueError, TypeError) as fault:  # a NUL or a lone surrogate in the name; no name at all
        raise error(f"{path}: no possible file name") from fault
    if not stat.S_ISREG(status.st_mode):  # a pipe or a device would block
        raise error(f"{path}: not a regular file{expected and f'; expected is {expected}'}")
    note_input(path)
    return status


def read_bytes(path: str | Path, limit: int, error: type[SlamError] = SequenceError, expected: str = "") -> bytes:
    """The content of a regular file; raises `error` where it is missing, unreadable or larger than `limit`.

    `expected` says which file is meant, where it is none.
    """
    size = _status(path, error, expected).st_size
    if size > limit:
        raise error(f"{path}: the file is larger than {limit / _MEBI:.3g} MiB")
    try:
        with Path(path).open("rb") as file:
            return file.read(size)  # no more: files in /proc state none, may be endless, and may block
    except OSError as fault:
        raise error(f"{path}: {reason(fault)}") from fault


def read_text(path: str | Path, limit: int = TEXT_LIMIT, error: type[SlamError] = SequenceError) -> str:
    """The text of a regular file in UTF-8, or UTF-16 with its mark, other bytes replaced; raises as `read_bytes`."""
    data = read_bytes(path, limit, error)
    return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", errors="replace")


def read_object(path: str | Path) -> dict[str, Any]:
    """The object in a JSON file; raises SlamError where it cannot be read, or holds something else."""
    tree = json_text(read_text(path, _JSON_LIMIT, SlamError), str(path))
    if not isinstance(tree, dict):
        raise SlamError(f"{path}: must hold an object, not {type(tree).__name__}")
    return tree


def unpack(data: bytes, source: str, needed: Iterable[str] = (), error: type[SlamError] = SlamError) -> dict[str, Any]:
    """The members of a zip archive: arrays by their names without ``.npy``, others as bytes; `source` is for messages.

    Raises `error` where it is damaged, encrypted, compressed in an unusual way, would unpack to far more than its size,
    lacks a member that is `needed`, or has an array of anything but numbers or text.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            members = file.infolist()
            total, names = sum(m.file_size for m in members), {m.filename for m in members}
            if not len(names) == len(members) <= _MEMBERS:
                raise ValueError(f"an archive of {len(members)} members")
            if total > max(_AT_LEAST, _TIMES * len(data)):
                raise ValueError(f"{len(data)} bytes that would unpack to {total}")
            for m in members:
                if m.flag_bits & 1 or m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{m.filename} is encrypted, or packed in a way that is not known")
            if lacking := {*needed} - {name.removesuffix(".npy") for name in names}:
                raise ValueError(f"it lacks {min(lacking)}")
            contents = {m.filename: file.read(m) for m in members}
            return {n.removesuffix(".npy"): _array(d, n) if n.endswith(".npy") else d for n, d in contents.items()}
    except Exception as fault:  # the libraries raise some fifteen kinds of them for damaged archives
        raise error(f"{source}: damaged, or no archive of arrays: {_text(fault)}") from fault


def _array(data: bytes, name: str) -> np.ndarray:
    """The array of numbers or text in an ``.npy`` member; raises ValueError, among others, where it is none."""
    found = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    if found.dtype.kind not in _KINDS or not found.dtype.itemsize:
        raise ValueError(f"{name} is of type {found.dtype}")
    return np.asarray(found, order="C")


class Kind(NamedTuple):
    """What an array of a file must be."""

    dtype: type  # of its entries
    shape: str  # a letter for each size that other arrays share, a figure for each that is fixed
    least: float  # bounds of its entries
    most: float
    what: str = ""  # "unknown" where entries may be NaN; else for whoever reads the file
    field: str = ""  # likewise: the attribute that it holds


def require_arrays(
    arrays: Mapping[str, Any], kinds: Mapping[str, Kind], source: str, error: type[SlamError] = SlamError
) -> None:
    """Raise `error` where an array is not of its kind, or sizes that should be equal are not."""
    sizes: dict[str, int] = {}
    for name, kind in kinds.items():
        a = arrays[name]
        if not isinstance(a, np.ndarray) or a.dtype != kind.dtype or a.ndim != len(kind.shape):
            raise error(f"{source}: {name} must be of {np.dtype(kind.dtype)}, with {len(kind.shape)} dimensions")
        fits = [sizes.setdefault(c, n) == n if c.isalpha() else int(c) == n for c, n in zip(kind.shape, a.shape)]
        if not (fits[0] if not len(a) else all(fits)):  # of no rows the others may be anything
            raise error(f"{source}: {name} has the shape {a.shape}, which does not fit the other arrays")
        good = (kind.least <= a) & (a <= kind.most)
        if not (good | np.isnan(a) if kind.what == "unknown" else good).all():
            raise error(f"{source}: {name} holds an impossible number")


def json_text(text: str | bytes, source: str, error: type[SlamError] = SlamError) -> Any:
    """Parse a JSON text; raises `error` where it is no JSON, or too long."""
    if len(text) > _JSON_LIMIT:
        raise error(f"{source}: {len(text)} characters of JSON")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise error(f"{source}: no valid JSON: {_text(fault)}") from fault


def _text(fault: BaseException) -> str:
    return text_of(fault) or type(fault).__name__


def require_content(path: Path) -> None:
    """Raise SequenceError where a path, for a library that opens it by itself, is no regular file with content."""
    if not _status(path, SequenceError).st_size:
        raise SequenceError(f"{path}: the file is empty")
    require_utf8(path, SequenceError)


def require_utf8(path: Path, error: type[SlamError] = SlamError) -> None:
    """Raise `error` where the name of a file is no UTF-8: OpenCV and other libraries crash on such a name."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise error(f"{path}: the name is not in UTF-8") from None


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image as PNG, whatever the file is called; a link that is there is replaced, not followed.

    Raises OSError where it cannot be written; no part of it is left.
    """
    import cv2

    content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()
    try:
        remove_file(path)
        path.write_bytes(content)
    except OSError:
        with suppress(OSError):
            if path.is_file():
                path.unlink()
        raise


def expanded(text: str | Path, error: type[SlamError] = SequenceError) -> Path:
    """A path as the user gave it, with ``~`` expanded; raises `error` where there is no such home, or it is no path."""
    if "\0" in str(text) or not isinstance(text, (str, os.PathLike)):
        raise error(f"{text}: no possible file name")
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise error(f"{text}: there is no such home folder") from None


def reason(fault: OSError) -> str:
    """The operating system's message of a failure, without its number; the usual one in our words."""
    if isinstance(fault, FileNotFoundError):
        return "there is no such file or folder"
    return fault.strerror or str(fault)


def remove_file(path: Path) -> None:
    """Remove a file or a link if there is one; anything else stays, and raises OSError where it is written to."""
    if path.is_symlink() or path.is_file():
        path.unlink()


def _require_target(path: Path, error: type[SlamError]) -> None:
    """Raise `error` where there is something else at a file's place: a device, a pipe."""
    if "\0" in str(path):
        raise error(f"{path}: no possible file name")
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(path.stat().st_mode):  # raises for links in a circle
            raise error(f"{path}: cannot be written: there is something that is not a regular file")


@contextmanager
def whole_file(path: str | Path, error: type[SlamError] = SlamError) -> Iterator[BinaryIO]:
    """A file to write to, which replaces the old one only when it is complete and on the disk; its folder is made.

    Raises `error` where it cannot be written; nothing is left of it then.
    """
    place, temporary = Path(path), None
    try:
        _require_target(place, error)
        place = place.resolve()  # a link stays a link
        place.parent.mkdir(parents=True, exist_ok=True)
        beside = place.with_name(f".{secrets.token_hex(8)}.part")
        with beside.open("xb") as file:
            temporary = beside
            yield file
            file.flush()
            os.fsync(file.fileno())
        if place.exists():
            temporary.chmod(stat.S_IMODE(place.stat().st_mode))
        temporary.replace(place)
        temporary = None
    except OSError as fault:
        raise error(f"{path}: cannot be written: {reason(fault)}") from fault
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Write a text in UTF-8, completely or not at all; raises SlamError where it cannot be written."""
    with whole_file(path) as file:
        file.write(text.encode("utf-8", "backslashreplace"))


class RowFile:
    """A text file that grows by whole rows: rows that cannot be written completely are removed again.

    Rows are handed to the operating system before `write` returns, so that a kill loses none. An old file is removed,
    what a link points to is left alone. Raises OSError where it cannot be opened, or what is there is not a regular
    file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.exists() and not path.is_file():
            raise OSError(f"{path.name} is there already and not a regular file")
        remove_file(path)
        self._file = path.open("xb", buffering=0)
        self._length = 0

    def write(self, text: str) -> None:
        """Append rows; raises OSError where they cannot be written, and keeps the earlier ones."""
        rest = memoryview(text.encode("utf-8", "backslashreplace"))
        length = self._length + len(rest)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):
                self._file.seek(self._length)
                self._file.truncate(self._length)
            raise
        self._length = length

    def close(self) -> None:
        """Close the file; everything was written before."""
        self._file.close()
