"""The command with hostile options: an exit status of 0, of 1 where nothing was tracked, or of 2 with one line."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from slam.commands.cli import main
from tests.fuzz.files import mutate
from tests.fuzz.harness import LONGEST_LINE, Broken, Subject
from tests.fuzz.hostile import NUMBERS, PATHS, choose
from tests.fuzz.readers import some_format, write
from tests.fuzz.settings import TEXTS

_RANGES = (
    *NUMBERS, "0:1", ":", "-" + "9" * 30 + ":", ":" + "9" * 30, "9" * 30 + ":" + "9" * 31, "1:0", "-1:", "0:-1",
    "1:2:3", "9" * 5000 + ":", "٣:", "0.5:", " 0 : 1 ",
)  # fmt: skip

#: Paths that lead nowhere outside of the folder that a case works in.
RELATIVE = tuple(path for path in PATHS if not path.startswith(("/", "~", "..")))


def command(rng: np.random.Generator, folder: Path) -> None:
    """One command line."""
    arguments = _arguments(rng, folder)
    with elsewhere(folder):
        require_status(*call(arguments))


def require_status(status: int, printed: str) -> None:
    """Raise where a command ended with anything but an exit status of 0, or 2 and one line."""
    if status == 0:
        return
    lines = printed.strip().splitlines()
    if status == 1 and lines and lines[-1].startswith("slam: no frame was tracked"):
        return
    if status != 2:
        raise Broken(f"exit status {status}")
    if lines and lines[0].strip().startswith("Usage:"):
        return
    ours = [line for line in lines if not line.startswith("WARNING: ")]
    if len(ours) != 1 or len(ours[0]) > LONGEST_LINE:
        raise Broken(f"{len(ours)} lines for exit status 2")


def _arguments(rng: np.random.Generator, folder: Path) -> list[str]:
    """A command line with one or two hostile options."""
    sequence = "synthetic:desk?frames=2&width=96&height=72"
    if rng.random() < 0.3:
        files, sequence = some_format(rng)
        mutate(rng, files)
        write(files, folder / "tree")
        sequence = str(folder / "tree" / sequence)
    name = choose(rng, ("run", "run", "run", "run", "replay", "render", "view", "nothing"))
    out = str(folder / "out")
    if name == "replay":
        return ["replay", choose(rng, (sequence, *PATHS)), "--out", out, "--quiet"]
    if name == "view":
        return ["view", choose(rng, (out, *PATHS)), "--to", str(folder / "a.rrd")]
    if name == "nothing":
        return [choose(rng, (*PATHS, "--x", "list"))]
    values: dict[str, Any] = {"--frames": (*_RANGES,), "--out": (out, *RELATIVE)}
    if name == "run":
        (folder / "device").symlink_to("/dev/full")  # never a device itself: a fault would replace it
        paths = (*RELATIVE, str(folder / "device"), str(folder), str(folder / ("x" * 250)))
        key = choose(rng, ("map.grid", "models.pixel_sigma", "frontend.features", "backend.iterations"))
        values |= dict.fromkeys(("--record", "--save-map", "--map"), paths)
        values |= dict.fromkeys(("--kind", "--format"), PATHS)
        values |= {"--backend": (*PATHS, "ekf", "smoother"), "--frontend": (*PATHS, "surf")}
        values |= {"--draw": (str(folder / "device"), "a\0b", "/proc/x", "x" * 300)}
        values |= {"--set": tuple(f"{key}={text}" for text in TEXTS)}
    chosen = {choose(rng, list(values)) for _ in range(int(rng.integers(1, 3)))}
    options = [part for key in sorted(chosen - {"--out"}) for part in (key, choose(rng, values[key]))]
    place = choose(rng, values["--out"]) if "--out" in chosen else out
    sequence = choose(rng, PATHS) if rng.random() < 0.1 else sequence
    return [name, sequence, "--out", place, "--quiet", *options]


def call(arguments: list[str]) -> tuple[int, str]:
    """Exit status and what was printed on standard error; signals are left as they were."""
    printed, shown = io.StringIO(), io.StringIO()
    with patch.object(sys, "argv", ["slam", *arguments]), redirect_stderr(printed), redirect_stdout(shown):
        try:
            main()
        except SystemExit as end:
            return (0 if end.code is None else int(end.code)), printed.getvalue()
    return 0, printed.getvalue()


@contextmanager
def elsewhere(folder: Path) -> Iterator[None]:
    """Work in a case's folder, so that relative paths lead nowhere else, and leave signals as they were."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {n: signal.getsignal(n) for n in numbers}
    place = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(place)
        for n, handler in before.items():
            signal.signal(n, handler)


SUBJECTS = (Subject("command", command, quiet=False, short=15),)
