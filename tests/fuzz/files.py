"""Files changed by somebody or something: by their ending, what is done to their contents."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests import recordings
from tests.fuzz.hostile import NUMBERS, VALUES, XML_BOMBS, YAML_BOMBS, broken_bytes, broken_text, choose

Files = dict[str, bytes]
Rng = np.random.Generator

_NUMBERS = (0, -1, 1, 2**31, 2**62, -(2**63), 1e308, -1e308, 1e-308, 1e30, 1e10, np.nan, np.inf, -np.inf, 0.5)


def mutate(rng: Rng, files: Files) -> None:
    """Take a file away, give it another name or the contents of another one, or change it."""
    name = choose(rng, sorted(files))
    kind = int(rng.integers(10))
    if kind == 0:
        del files[name]
        if not files:
            files["x"] = b""
    elif kind == 1:
        stem = choose(rng, (*NUMBERS, "0" * 200 + "7", "9999999999", "9" * 19, "x", "1e3", "١٢"))
        old = Path(name)
        files[f"{old.parent}/{stem[:200]}{old.suffix}".removeprefix("./")] = files.pop(name)
    elif kind == 2:
        files[name] = choose(rng, sorted(files.values()))
    else:
        files[name] = changed(rng, name, files[name])


def changed(rng: Rng, name: str, data: bytes) -> bytes:
    """Other contents of a file."""
    ways = (broken_bytes,) if rng.random() < 0.15 else WAYS.get(Path(name).suffix, (words,))
    return choose(rng, ways)(rng, data)


def words(rng: Rng, data: bytes) -> bytes:
    """A text with lines or words changed."""
    return broken_text(rng, data.decode("utf-8", "replace")).encode("utf-8", "replace")


def numbers(rng: Rng, data: bytes) -> bytes:
    """A table whose numbers are all zero, all turned around, all huge, or in another order."""
    change = choose(rng, (
        lambda row: ["0"] * len(row), lambda row: [f"-{w}" for w in row], lambda row: row[::-1],
        lambda row: [w.replace("1", "1e308") for w in row],
    ))  # fmt: skip
    rows = []
    for line in data.decode("utf-8", "replace").splitlines():
        separator, keep = (",", 1) if "," in line else (" ", 0)
        row = line.split(separator)
        rows.append(separator.join([*row[:keep], *change(row[keep:])]))
    return ("\n".join(rows) + "\n").encode("utf-8", "replace")


def bomb(rng: Rng, data: bytes) -> bytes:
    """What unpacks without end, alone or behind the contents."""
    text = choose(rng, (*YAML_BOMBS, *XML_BOMBS)).encode("utf-8", "replace")
    return choose(rng, (text, data + text))


def tree(rng: Rng, data: bytes) -> bytes:
    """JSON with one leaf or branch replaced."""
    whole = json.loads(data)
    node, parent, key = whole, None, None
    while isinstance(node, (dict, list)) and len(node) and (parent is None or rng.random() < 0.8):
        parent = node
        key = choose(rng, list(node)) if isinstance(node, dict) else int(rng.integers(len(node)))
        node = node[key]
    value = choose(rng, [v for v in VALUES if not isinstance(v, (bytes, complex))])
    if parent is None:
        return json.dumps(value).encode()
    parent[key] = value
    return json.dumps(whole).encode()


def index(rng: Rng, data: bytes) -> bytes:
    """Other lengths, offsets, counts and times in some places: beginnings and ends hold the index of a recording."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        size = int(choose(rng, (1, 4, 8)))
        if len(out) > size:
            reach = min(len(out) - size, 2000)
            places = rng.integers(reach), len(out) - size - rng.integers(reach), rng.integers(len(out) - size)
            at = int(choose(rng, places))
            out[at : at + size] = choose(rng, (b"\0" * size, b"\xff" * size, b"\x7f" * size, rng.bytes(size)))
    return bytes(out)


# --- images ---


@cache
def image(seed: int, ending: str = ".png") -> bytes:
    """A small image file."""
    return cv2.imencode(ending, recordings.picture(seed))[1].tobytes()


def picture(rng: Rng, data: bytes) -> bytes:
    """An image with a false header, odd chunks, of another kind, or damaged."""
    kind = int(rng.integers(5))
    if kind == 0:
        size = choose(rng, ((30_000, 30_000), (2**31 - 1, 1), (0, 0), (64, 60_000), (64, 48), (1, 1)))
        return png(size, choose(rng, (b"", rng.bytes(50), zlib.compress(bytes(64 * 48)))), int(choose(rng, (8, 16, 3))))
    if kind == 1:
        names = (b"iCCP", b"gAMA", b"tEXt", b"zTXt", b"sRGB", b"PLTE", b"IDAT", b"tRNS")
        return data[:33] + chunk(choose(rng, names), rng.bytes(20)) + data[33:]
    if kind == 2:
        other = image(1, choose(rng, (".jpg", ".bmp", ".tiff", ".webp", ".pgm", ".jp2")))
        return broken_bytes(rng, other) if rng.random() < 0.8 else other
    heads = (b"P5\n60000 60000\n255\n", b"P5 64 48 255\n", b"P2 64 48 65535\n1 2", b"BM" + rng.bytes(60))
    return choose(rng, heads) if kind == 3 else broken_bytes(rng, data)


def png(size: tuple[int, int], pixels: bytes, depth: int = 8) -> bytes:
    """A PNG with right checksums, whatever its header says."""
    header = struct.pack(">IIBBBBB", *size, depth, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


# --- archives of arrays ---


def archive(rng: Rng, data: bytes) -> bytes:
    """An archive with a member missing, damaged, with a false header, or with hostile values; oddly packed."""
    packed = data.split(b"\n", 2)[2] if data.startswith(b"surf") else data  # a map is signed: see who uses it
    with zipfile.ZipFile(io.BytesIO(packed)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    name, kind = choose(rng, sorted(members)), int(rng.integers(6))
    if kind == 0:
        del members[name]
        members.setdefault("x.npy", b"")
    elif kind == 1:
        members[name] = broken_bytes(rng, members[name])
    elif kind == 2:
        members[name] = header(rng)
    else:
        members[name] = (array if name.endswith(".npy") else tree)(rng, members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", choose(rng, (0, 0, 0, 0, 8, 8, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))) as file:
        for member, content in members.items():
            file.writestr(member, content)
        if rng.random() < 0.02:
            file.writestr("bomb.npy", bytes(300_000_000), zipfile.ZIP_DEFLATED)
    found = out.getvalue()
    if rng.random() < 0.1:  # marked as encrypted
        found = found.replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00")
    return found


def array(rng: Rng, data: bytes) -> bytes:
    """An array with hostile numbers, of another type or shape; texts of JSON with hostile leaves."""
    before, out = np.load(io.BytesIO(data)), io.BytesIO()
    np.lib.format.write_array(out, _other_array(rng, before), allow_pickle=False)
    return out.getvalue()


def _other_array(rng: Rng, before: np.ndarray) -> np.ndarray:
    kind = int(rng.integers(6))
    if before.dtype.kind == "U":
        if str(before).startswith("{"):
            return np.array(tree(rng, str(before).encode()).decode())
        return np.array(choose(rng, ("", "x", "a\nb", "y" * 100_000, 1.5, 10**10, None, "[" * 5000))).astype("U")
    if kind == 0:
        return before[..., None] if rng.random() < 0.5 else before.ravel()
    if kind == 1:
        return before.astype(choose(rng, (np.float64, np.int64, np.float32, np.uint8, ">f8", np.complex64, "U5", "?")))
    if kind == 2:
        return np.array(choose(rng, (1.5, 2, -1, "1", True)))
    if kind == 3:
        return before[: int(rng.integers(len(before) + 1))] if before.ndim else before
    out, value = np.array(before), choose(rng, _NUMBERS)
    if out.size:
        rows = rng.random(out.shape) < choose(rng, (0.01, 0.5, 1.0))
        rows.flat[int(rng.integers(out.size))] = True
        if out.dtype.kind in "iu":
            limits = np.iinfo(out.dtype)
            value = int(min(max(value, limits.min), limits.max)) if np.isfinite(value) else 0
        with np.errstate(all="ignore"):
            out[rows] = value
    return out


def header(rng: Rng) -> bytes:
    """An array whose header says what is not so."""
    shape = choose(rng, ("(10**12,)", "(1000000000000,)", "(-1,)", "()", "(2,3)", "(" * 3000, "(1,)" * 100, "None"))
    descr = choose(rng, ("'<f8'", "'|O'", "'<U1000000000'", "[('a', '<f8')]", "'<i8'", "'x'", "None", "'|S0'", "'<U0'"))
    order = choose(rng, ("False", "True", "3"))
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}".encode() + b" " * 10 + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(text), 65_535)) + text + bytes(int(rng.integers(100)))


#: By a file's ending: what may be done to its contents.
WAYS: dict[str, tuple[Callable[[Rng, bytes], Any], ...]] = {
    ".png": (picture,), ".avi": (broken_bytes,),
    ".csv": (words, words, numbers), ".txt": (words, words, numbers),
    ".yaml": (words, words, bomb), ".xml": (words, words, bomb), ".json": (words, tree, tree, bomb),
    ".npz": (archive,), ".map": (archive,),
    **dict.fromkeys((".bag", ".mcap", ".db3", ".zstd"), (index, index, index, broken_bytes)),
}  # fmt: skip
