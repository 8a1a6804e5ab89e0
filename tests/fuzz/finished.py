"""Commands on what earlier commands have left: configurations, runs and comparisons, with files changed."""

from __future__ import annotations

import json
import os
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from tests.fuzz.commands import RELATIVE, call, elsewhere, require_status
from tests.fuzz.harness import Subject
from tests.fuzz.hostile import NUMBERS, VALUES, broken_bytes, broken_text, choose

SEQUENCE = "synthetic:desk?frames=3&width=96&height=72"
_JSON = (
    b"", b"[]", b"null", b"3", b'"x"', b"{}", b"[" * 100_000, b'{"a":' * 50_000, b"9" * 5000, b"\xff\xfe",
    b'{"versions": []}', b'{"versions": 1}', b'{"plan": {}, "versions": {}}', b'{"trial": null}', b"{} {}",
    b"\xef\xbb\xbf{}",
)  # fmt: skip


@lru_cache(maxsize=1)
def _left() -> dict[str, bytes]:
    """All files that a run, a comparison and a calibration leave."""
    with tempfile.TemporaryDirectory() as folder:
        with elsewhere(Path(folder)), patch("slam.commands.compare.LocalScheduler", _Here):
            for words in (
                [
                    "run",
                    SEQUENCE,
                    "--out",
                    "run",
                    "--record",
                    "a.npz",
                    "--save-map",
                    "a.map",
                    "--no-picture",
                    "--quiet",
                ],
                ["compare", SEQUENCE, "--out", "compared", "--workers", "1", "--trials", "1", "--quiet"],
            ):
                assert call(words)[0] == 0
        return {str(p.relative_to(folder)): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


def commands(rng: np.random.Generator, folder: Path) -> None:
    """One command on files that were changed."""
    for name, data in _left().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    words, files = _words(rng)
    for _ in range(int(rng.integers(3))):
        path = folder / choose(rng, files(folder))
        _change(rng, path)
    with elsewhere(folder), patch("slam.commands.compare.LocalScheduler", _Here):
        require_status(*call(words))


class _Here:
    """A scheduler in this process."""

    def __init__(self, *_: Any) -> None:
        pass

    def run(self, jobs: Any, deliver: Any) -> None:
        """All jobs, one after the other."""
        for job in jobs:
            deliver(job, job.function(*job.arguments()), None)


def _words(rng: np.random.Generator) -> tuple[list[str], Any]:
    """A command line, and which files of a folder it reads."""
    kind = int(rng.integers(6))
    if kind == 0:
        which = choose(rng, ("run", "run/config.json", "compared", "a.map", *RELATIVE))
        more = choose(rng, ([], [], ["--backend", "smoother"], [SEQUENCE], ["--set", "map.grid=[4, 3]"], ["--mono"]))
        return ["run", "--config", which, "--out", "again", "--quiet", "--no-picture", *more], _only("run/config.json")
    if kind == 1:
        out = choose(rng, ("a.png", "a.svg", "a.pdf", "a.x", "", "run", *RELATIVE))
        more = choose(
            rng, ([], ["run"], ["compared"], ["--figure", choose(rng, ("path", "map", "errors", "time", "x"))])
        )
        return ["plot", "run", "--out", out, *more], _below("run")
    if kind == 2:
        return ["view", "run", "--to", choose(rng, ("a.rrd", "", "run", *RELATIVE))], _below("run")
    if kind == 3:
        more = choose(rng, ([], [], ["--trials", "2"], ["--no-replay"], ["--backends", "ekf"], ["--frames", "0:2"],
                            ["--set", "map.grid=[4, 3]"], ["--variant", choose(rng, NUMBERS)]))  # fmt: skip
        return ["compare", SEQUENCE, "--out", "compared", "--workers", "1", "--trials", "1", "--quiet", *more], _below(
            "compared"
        )
    if kind == 4:
        given = choose(rng, ("run", "run/summary.json", "a.map", "compared", *RELATIVE))
        return ["run", SEQUENCE, "--calibration", given, "--out", "again", "--quiet", "--no-picture"], _below("run")
    option = choose(rng, ("--out", "--opencv", "--kalibr"))
    words = ["calibrate", SEQUENCE, option, choose(rng, ("run", "a.map", "run/x/y", *RELATIVE)), "--quiet"]
    more = choose(rng, ([], [SEQUENCE], ["synthetic:box?frames=3&width=96&height=72"], ["--overwrite"],
                        ["--frames", choose(rng, NUMBERS)], ["--format", "kitti"]))  # fmt: skip
    return [*words, *more], _below("run")


def _only(name: str) -> Any:
    return lambda _: [name]


def _below(name: str) -> Any:
    return lambda folder: sorted(str(p.relative_to(folder)) for p in (folder / name).rglob("*") if p.is_file())


def _change(rng: np.random.Generator, path: Path) -> None:
    """Damage a file, or put something else in its place."""
    if not path.is_file() or path.is_symlink():
        return
    data, kind = path.read_bytes(), int(rng.integers(8))
    if kind == 0:
        path.unlink()
        if rng.random() < 0.7:
            choose(rng, (os.mkfifo, os.mkdir, lambda p: p.symlink_to("/dev/zero"), lambda p: p.symlink_to(p.name)))(
                path
            )
    elif path.suffix == ".json" and kind < 6:
        tree = json.loads(data)
        path.write_bytes(choose(rng, _JSON) if kind == 1 else json.dumps(_hostile(rng, tree), default=str).encode())
    elif kind < 4:
        path.write_bytes(broken_bytes(rng, data))
    else:
        path.write_text(broken_text(rng, data.decode("latin-1")), errors="replace")


def _hostile(rng: np.random.Generator, tree: Any) -> Any:
    """A tree of JSON with one leaf or branch replaced, or one missing."""
    node, way = tree, []
    while isinstance(node, (dict, list)) and node and (not way or rng.random() < 0.85):
        key = choose(rng, list(node)) if isinstance(node, dict) else int(rng.integers(len(node)))
        way.append((node, key))
        node = node[key]
    if not way:
        return None
    parent, key = way[-1]
    if rng.random() < 0.2:
        del parent[key]
    else:
        values = [v for v in VALUES if not isinstance(v, (bytes, complex))]
        parent[key] = choose(rng, (*values, *NUMBERS, *RELATIVE))
    return tree


SUBJECTS = (
    Subject("finished work", "run, plot, view, compare and calibrate on changed files of earlier commands",
            "exit status 0, 1 and a line where no frame was tracked, or 2 and one line", commands,
            quiet=False, short=6),
)  # fmt: skip
