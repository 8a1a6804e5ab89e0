"""Hostile values, and files changed by somebody or something: by their ending, what is done to their contents."""

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

Files = dict[str, bytes]
Rng = np.random.Generator

#: Texts where a number is expected.
NUMBERS = (
    "0", "-1", "nan", "inf", "1e308", "-1e308", "1e-308", "1e400", "9" * 23, "9" * 400, "9" * 5000, "1_000",
    str(2**31), str(2**63), "٣", "0x10", "", "null", "true", "x", "--1", ".", "1:59:59",
)  # fmt: skip

#: Texts where a path or a name is expected.
PATHS = (
    "", ".", "..", "/", "~nobody_of_this_name", "/proc", "/proc/self/fd", "/dev/null", "/dev/full", "a\0b", "x" * 300,
    "/".join(["y" * 200] * 30), "new\nline", "\udc80", "?", "?fps=", "a?b?c", "?left=a%00b&right=c", "\x1b[31mred",
    "synthetic:", "synthetic:desk?frames=1e9", "synthetic:desk?frames=3&drop=0:" + "9" * 30, "synthetic:\0",
)  # fmt: skip

#: Leaves of JSON of other types than expected, or far out of their range.
LEAVES: tuple[Any, ...] = (
    None, True, -1, 2**31, 2**63, 10**400, 1e308, 5e-324, float("nan"), float("inf"), "", "x", "0", [], [1, 2],
    [1e308, 1e308], ["x", None], {}, {"a": 1},
)  # fmt: skip

BOMBS = (
    "a: &a [1,1,1,1,1,1,1,1]\n" + "\n".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}' if i else '*a'] * 8)}]"
                                            for i in range(12)) + "\nT_BS: *a11\n",
    "x: &x [*x]\n", "x: " + "[" * 20_000, "x: " + "{a: " * 20_000, "x: [" + "1.5, " * 100_000 + "2]\n",
    "x: !!bool maybe\n", "x: !!python/object/apply:os.getcwd []\n", "%YAML:1.0\n%TAG ! x\n", "\t",
    "x: " + ":".join(["59"] * 3000), "- 1\n", "resolution: [9" + "9" * 400 + ", 1]\n",
    '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9))
    + "]><opencv_storage>&j;</opencv_storage>",
    "<a>" * 50_000, '<?xml version="1.0" encoding="x"?><a/>',
    "<opencv_storage><K1><rows>3</rows><data>" + "1 " * 200_000 + "</data></K1></opencv_storage>",
)  # fmt: skip


def choose(rng: Rng, options: Any) -> Any:
    """One of a sequence."""
    return options[int(rng.integers(len(options)))]


def mutate(rng: Rng, files: Files) -> None:
    """Take a file away, give it another name or the contents of another one, or change it."""
    name, kind = choose(rng, sorted(files)), int(rng.integers(10))
    if kind == 0:
        del files[name]
        files.setdefault("x", b"")
    elif kind == 1:
        old = Path(name)
        files[f"{old.parent}/{choose(rng, NUMBERS)[:200]}{old.suffix}".removeprefix("./")] = files.pop(name)
    elif kind == 2:
        files[name] = choose(rng, sorted(files.values()))
    else:
        files[name] = changed(rng, name, files[name])


def changed(rng: Rng, name: str, data: bytes) -> bytes:
    """Other contents of a file."""
    ways = (damaged,) if rng.random() < 0.15 else WAYS.get(Path(name).suffix, (words,))
    return choose(rng, ways)(rng, data)


def damaged(rng: Rng, data: bytes) -> bytes:
    """Bytes cut, put in, doubled, replaced, or changed."""
    at, out = int(rng.integers(len(data) + 1)), bytearray(data)
    for place in rng.integers(len(out), size=5) if out else ():
        out[place] = int(rng.integers(256))
    more = rng.bytes(int(rng.integers(1, 40)))
    return choose(rng, (data[:at], data[:at] + more + data[at:], data[:at] + data, b"", more, bytes(out), bytes(out)))


def words(rng: Rng, data: bytes) -> bytes:
    """A text with a line left out, put in, or with one of its words replaced in one line or in all."""
    lines, kind = data.decode("utf-8", "replace").splitlines(), int(rng.integers(5))
    if not lines or kind == 0:
        return damaged(rng, data)
    at = int(rng.integers(len(lines)))
    if kind == 1:
        del lines[at]
    elif kind == 2:
        lines.insert(at, choose(rng, (lines[-1], *NUMBERS, "# x", "\ufeff", "a: b", ",,,", "\0")))
    for row in range(len(lines)) if kind == 3 else [at] if kind == 4 else []:
        separator = "," if "," in lines[row] else " "
        cells = lines[row].split(separator)
        cells[int(rng.integers(len(cells)))] = choose(rng, NUMBERS)
        lines[row] = separator.join(cells)
    return ("\n".join(lines) + "\n").encode("utf-8", "replace")


def bomb(rng: Rng, data: bytes) -> bytes:
    """What unpacks without end, alone or behind the contents."""
    text = choose(rng, BOMBS).encode("utf-8", "replace")
    return choose(rng, (text, data + text))


def tree(rng: Rng, data: bytes) -> bytes:
    """JSON with one leaf or branch replaced."""
    whole = json.loads(data)
    node, parent, key = whole, None, None
    while isinstance(node, (dict, list)) and len(node) and (parent is None or rng.random() < 0.8):
        parent = node
        key = choose(rng, list(node)) if isinstance(node, dict) else int(rng.integers(len(node)))
        node = node[key]
    if parent is None:
        return json.dumps(choose(rng, LEAVES)).encode()
    parent[key] = choose(rng, LEAVES)
    return json.dumps(whole).encode()


def index(rng: Rng, data: bytes) -> bytes:
    """Other lengths, offsets, counts and times in some places: beginnings and ends hold the index of a recording."""
    out = bytearray(data)
    for size in choose(rng, ((4,), (8, 1), (4, 8, 8))):
        if len(out) > size:
            reach = min(len(out) - size, 2000)
            places = rng.integers(reach), len(out) - size - rng.integers(reach), rng.integers(len(out) - size)
            at = int(choose(rng, places))
            out[at : at + size] = choose(rng, (b"\0" * size, b"\xff" * size, b"\x7f" * size, rng.bytes(size)))
    return bytes(out)


def picture(rng: Rng, data: bytes) -> bytes:
    """An image with a false header, of another kind, or damaged."""
    other = _image(choose(rng, (".jpg", ".bmp", ".tiff", ".webp", ".pgm", ".jp2")))
    size = choose(rng, ((30_000, 30_000), (2**31 - 1, 1), (0, 0), (64, 60_000), (1, 1)))
    head = choose(rng, (b"P5\n60000 60000\n255\n", b"P5 64 48 255\n", b"BM" + rng.bytes(60)))
    return choose(rng, (damaged(rng, data), damaged(rng, other), other, head, png(size, choose(rng, (b"", data)))))


@cache
def _image(ending: str) -> bytes:
    return cv2.imencode(ending, recordings.picture(1))[1].tobytes()


def png(size: tuple[int, int], pixels: bytes) -> bytes:
    """A PNG with right checksums, whatever its header says."""
    chunks = (b"IHDR", struct.pack(">IIBBBBB", *size, 8, 0, 0, 0, 0)), (b"IDAT", pixels), (b"IEND", b"")
    parts = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def archive(rng: Rng, data: bytes) -> bytes:
    """An archive with a member missing, damaged, with a false header, or with hostile values; oddly packed."""
    packed = data.split(b"\n", 2)[2] if data.startswith(b"surf") else data  # a map is signed: see who uses it
    with zipfile.ZipFile(io.BytesIO(packed)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    name, kind = choose(rng, sorted(members)), int(rng.integers(6))
    if kind == 0:
        members["x.npy"] = members.pop(name)
    elif kind == 1:
        members[name] = damaged(rng, members[name])
    elif kind == 2:
        members[name] = _header(rng)
    else:
        members[name] = (_array if name.endswith(".npy") else tree)(rng, members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", choose(rng, (0, 0, 0, 8, 8, zipfile.ZIP_LZMA))) as file:
        for member, content in members.items():
            file.writestr(member, content)
        if rng.random() < 0.02:
            file.writestr("bomb.npy", bytes(300_000_000), zipfile.ZIP_DEFLATED)
    return out.getvalue()


def _array(rng: Rng, data: bytes) -> bytes:
    """An array with hostile numbers, of another type or shape; texts of JSON with hostile leaves."""
    before, out, kind = np.load(io.BytesIO(data)), io.BytesIO(), int(rng.integers(4))
    if before.dtype.kind == "U":
        found = np.array(tree(rng, str(before).encode()).decode() if str(before).startswith("{") else "x")
    elif kind == 0:
        found = choose(rng, (before[..., None], before.ravel(), np.array(-1), before[:1] if before.ndim else before))
    elif kind == 1:
        found = before.astype(choose(rng, (np.float64, np.int64, np.uint8, ">f8", np.complex64, "U5", "?")))
    else:
        found = np.array(before)
        rows = rng.random(found.shape) < choose(rng, (0.01, 0.5, 1.0))
        with np.errstate(all="ignore"):
            value = np.array(choose(rng, (0, -1, 2.0**31, 1e308, 1e-308, np.nan, np.inf)))
            found[rows] = value.astype(found.dtype)
    np.lib.format.write_array(out, found, allow_pickle=False)
    return out.getvalue()


def _header(rng: Rng) -> bytes:
    """An array whose header says what is not so."""
    shape = choose(rng, ("(1000000000000,)", "(-1,)", "()", "(2,3)", "(" * 3000, "None"))
    descr = choose(rng, ("'<f8'", "'|O'", "'<U1000000000'", "[('a', '<f8')]", "'x'", "None", "'|S0'"))
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode() + b" " * 10 + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(text), 65_535)) + text + bytes(int(rng.integers(100)))


#: By a file's ending: what may be done to its contents.
WAYS: dict[str, tuple[Callable[[Rng, bytes], Any], ...]] = {
    ".png": (picture,), ".avi": (damaged,), ".csv": (words,), ".txt": (words,),
    ".yaml": (words, words, bomb), ".xml": (words, words, bomb), ".json": (words, tree, tree, bomb),
    ".npz": (archive,), ".map": (archive,),
    **dict.fromkeys((".bag", ".mcap", ".db3", ".zstd"), (index, index, index, damaged)),
}  # fmt: skip
