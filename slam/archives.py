"""Untrusted zip archives of NumPy arrays: sizes are checked before anything is unpacked, nothing is executed."""

from __future__ import annotations

import io
import json
import math
import zipfile
from typing import Any

import numpy as np

from slam.errors import SlamError, text_of

#: Bytes that an archive may unpack to: the larger of this many, and this many times its own size.
_AT_LEAST, _TIMES = 64 * 2**20, 50

_MEMBERS = 100  # most members of an archive
_HEADER = 10_000  # bytes of an array's header
_KINDS = "biufU"  # of arrays: numbers and text, never objects
_TEXT = 2**20  # characters of a text that is read as JSON


def unpack(data: bytes, source: str, error: type[SlamError] = SlamError) -> dict[str, bytes]:
    """The members of a zip archive by name; `source` is its name, for messages.

    Raises:
        SlamError: of type `error`, if it is damaged, encrypted, compressed in an unusual way, or would unpack to far
            more than its own size.
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
            return {m.filename: file.read(m) for m in members}
    except Exception as fault:  # the libraries raise some fifteen kinds of them for damaged archives
        raise error(f"{source}: damaged, or no archive of arrays: {_text(fault)}") from fault


def array(data: bytes, name: str, source: str, error: type[SlamError] = SlamError) -> np.ndarray:
    """The array of an ``.npy`` member, whose header must agree with the data; raises `error` where it is none."""
    try:
        stream = io.BytesIO(data)
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version}")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream, max_header_size=_HEADER)
        body, count = data[stream.tell() :], math.prod(shape)
        if dtype.kind not in _KINDS:
            raise ValueError(f"of type {dtype}")
        if min(shape, default=0) < 0 or max(shape, default=0) >= 2**31 or count * dtype.itemsize != len(body):
            raise ValueError(f"{len(body)} bytes for shape {shape} of {dtype}")
        flat = np.frombuffer(body, dtype) if dtype.itemsize else np.zeros(count, dtype)
        return flat.reshape(shape, order="F" if fortran else "C").copy()
    except Exception as fault:  # likewise
        raise error(f"{source}: {name} cannot be read as an array: {_text(fault)}") from fault


def json_text(text: str | bytes, source: str, error: type[SlamError] = SlamError) -> Any:
    """Parse a JSON text; raises `error` where it is no JSON, or too long."""
    if len(text) > _TEXT:
        raise error(f"{source}: {len(text)} characters of JSON")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise error(f"{source}: no valid JSON: {_text(fault)}") from fault


def _text(fault: BaseException) -> str:
    return text_of(fault) or type(fault).__name__
