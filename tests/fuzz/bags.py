"""ROS recordings that are damaged: cut, overwritten, with wrong numbers in their index, or of another file."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from tests import bags
from tests.fuzz.files import Files, mutate
from tests.fuzz.harness import Subject
from tests.fuzz.hostile import choose
from tests.fuzz.readers import consume, write

KINDS = ("walk.bag", "walk.bag CHUNKS", *(f"walk{e}{p}" for e in (".mcap", "") for p in ("", " FILE", " MESSAGE")))


@cache
def _written(kind: str) -> Files:
    """The files of a small recording of a kind."""
    with tempfile.TemporaryDirectory() as folder:
        name, _, packed = kind.partition(" ")
        version = 1 if name.endswith(".bag") else 2
        bags.write(Path(folder) / name, bags.stereo(bags.STORES[version], 5), version, packed)
        return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(Path(folder).rglob("*")) if p.is_file()}


def read_bag(rng: np.random.Generator, folder: Path) -> None:
    """Write a damaged recording and read it to its end."""
    files = dict(_written(choose(rng, KINDS)))
    whole = folder / Path(min(files)).parts[0]
    mutate(rng, files)
    write(files, folder)
    alone = sorted(path for path in whole.glob("*") if path.suffix != ".yaml") or [whole]
    consume(str(whole if rng.random() < 0.6 else alone[0]))


SUBJECTS = (Subject("bags", read_bag, quiet=False),)
