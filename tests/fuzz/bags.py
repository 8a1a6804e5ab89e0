"""ROS recordings that are damaged: cut, overwritten, with wrong numbers in their index, or of another file."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from tests import bags
from tests.fuzz.harness import Subject
from tests.fuzz.hostile import broken_bytes, choose
from tests.fuzz.readers import consume

KINDS = ("walk.bag", "walk.bag CHUNKS", *(f"walk{e}{p}" for e in (".mcap", "") for p in ("", " FILE", " MESSAGE")))

Files = dict[str, bytes]


@cache
def _written(kind: str) -> Files:
    """The files of a small recording of a kind."""
    with tempfile.TemporaryDirectory() as folder:
        name, _, packed = kind.partition(" ")
        version = 1 if name.endswith(".bag") else 2
        bags.write(Path(folder) / name, bags.stereo(bags.STORES[version], 5), version, packed)
        return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(Path(folder).rglob("*")) if p.is_file()}


def wrong_numbers(rng: np.random.Generator, data: bytes) -> bytes:
    """Data with other numbers in some places, as in an index: lengths, offsets, counts and times."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        size = int(choose(rng, (1, 4, 8)))
        if len(out) > size:
            # Beginnings and ends hold the index; what is between is mostly pixels.
            reach = min(len(out) - size, 2000)
            places = rng.integers(reach), len(out) - size - rng.integers(reach), rng.integers(len(out) - size)
            at = int(choose(rng, places))
            value = choose(rng, (b"\0" * size, b"\xff" * size, b"\x7f" * size, rng.bytes(size)))
            out[at : at + size] = value
    return bytes(out)


def read_bag(rng: np.random.Generator, folder: Path) -> None:
    """Write a damaged recording and read it to its end."""
    files = dict(_written(choose(rng, KINDS)))
    name = choose(rng, sorted(files))
    kind = int(rng.integers(8))
    if kind == 0:
        del files[name]
    elif kind == 1:
        files[name] = choose(rng, sorted(_written(choose(rng, KINDS)).values()))
    elif kind == 2:
        files[name] = files[name][: int(rng.integers(len(files[name])))]
    elif kind < 6:
        files[name] = wrong_numbers(rng, files[name])
    else:
        files[name] = broken_bytes(rng, files[name])
    for path, data in files.items():
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_bytes(data)
    whole = folder / ("walk.bag" if "walk.bag" in files else "walk")
    alone = sorted(path for path in whole.glob("*") if path.suffix != ".yaml") or [whole]
    consume(str(whole if rng.random() < 0.6 else alone[0]))


SUBJECTS = (Subject("bags", read_bag, quiet=False),)
