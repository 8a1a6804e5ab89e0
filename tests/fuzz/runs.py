"""Runs whose files cannot all be written: full disks, devices, folders in use, and frames that cannot be had."""

from __future__ import annotations

import csv
import json
import os
import resource
import signal
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam.atlas.map_io import load_map
from slam.config import SystemConfig
from slam.data import StereoFeatures, StereoFrame
from slam.errors import SequenceError, SlamError
from slam.geometry.trajectory import Trajectory
from slam.run.options import RunOptions
from slam.run.outputs import FRAME_COLUMNS
from slam.run.recording import load_recording
from slam.run.runner import run
from slam.sequences.base import Sequence
from tests.fuzz.harness import Broken, Subject, require_line
from tests.fuzz.hostile import choose
from tests.fuzz.settings import scene

FRAMES = 5


class Scripted:
    """A sequence of features without images, that may end in an error or an interrupt."""

    name, format, kind = "scripted", "test", "handheld"
    ground_truth = None

    def __init__(self, error: BaseException | None, at: int) -> None:
        self.rig, self.features = scene()
        self.warnings: list[str] = []
        self._error, self._at = error, at

    def __len__(self) -> int:
        return FRAMES

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        for k in range(FRAMES):
            if self._error is not None and k == self._at:
                raise self._error
            yield StereoFrame(k, 0.0, np.zeros((0, 0), np.uint8), None)


class Features:
    """Gives the features of a frame by its number."""

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        return scene()[1][frame.index]


class Interrupted(BaseException):
    """As Ctrl-C, but of ours."""


def write_run(rng: np.random.Generator, folder: Path) -> None:
    """A run that stops somewhere, on a disk that is full somewhere, or with something in its way."""
    out = folder / "out"
    record, known = folder / "a.npz", folder / "a.map"
    if rng.random() < 0.3:
        _obstruct(rng, out, record, known)
    error = choose(rng, (None, None, None, SequenceError("a frame is missing"), Interrupted()))
    size = int(choose(rng, (0, 1, 100, 1000, 2000, 4000, 8000, 30_000, 10**6))) if rng.random() < 0.6 else None
    before = {p: _kind(p) for p in (record, known)}
    sequence: Sequence = Scripted(error, int(rng.integers(FRAMES + 1)))  # type: ignore[assignment]
    backend = choose(rng, ("ekf", "smoother"))
    options = RunOptions(backend, "none", SystemConfig(), out, record=record, save_map=known)
    raised: BaseException | None = None
    try:
        with disk_of(size):
            run(sequence, options, frontend=Features())  # type: ignore[arg-type]
    except (SlamError, Interrupted) as caught:
        raised = caught
    if isinstance(raised, SlamError):
        require_line(raised)
    if raised is None and size is not None and not (out / "summary.json").exists():
        raise Broken("a run without a summary ends well")
    for path, kind in before.items():
        if kind not in (None, stat.S_IFREG) and _kind(path) != kind:
            raise Broken("a device or a pipe was replaced")
    require_whole(folder, out)


def _obstruct(rng: np.random.Generator, out: Path, record: Path, known: Path) -> None:
    """Something where a file is to be written."""
    path = choose(rng, (record, known, out, *(out / n for n in ("trajectory.txt", "summary.json", "landmarks.csv"))))
    path.parent.mkdir(exist_ok=True)
    obstacles = (
        lambda: os.mkfifo(path), lambda: (path / "x").mkdir(parents=True), lambda: path.symlink_to("/dev/full"),
        lambda: path.symlink_to("nowhere/at/all"),
    )  # fmt: skip
    choose(rng, obstacles)()


def _kind(path: Path) -> int | None:
    try:
        return stat.S_IFMT(path.lstat().st_mode)
    except OSError:
        return None


@contextmanager
def disk_of(size: int | None) -> Iterator[None]:
    """Files can grow to `size` bytes: as on a full disk, writes fail, or are cut short."""
    if size is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def require_whole(folder: Path, out: Path) -> None:
    """Raise where a file is there in part, or something temporary is left."""
    if any(p.name.endswith(".part") for p in folder.rglob("*")):
        raise Broken("a temporary file is left")
    readers = {
        "out/summary.json": lambda path: json.loads(path.read_text()),
        "out/config.json": lambda path: json.loads(path.read_text()),
        "out/trajectory.txt": Trajectory.read_tum,
        "out/trajectory_final.txt": Trajectory.read_tum,
        "out/frames.csv": _require_whole_rows,
        "a.npz": load_recording,
        "a.map": load_map,
    }
    for name, read in readers.items():
        path = out / name.removeprefix("out/") if "/" in name else folder / name
        if path.is_file() and (path.stat().st_size or path.suffix not in (".txt", ".csv")):
            read(path)


def _require_whole_rows(path: Path) -> None:
    with path.open(newline="") as file:
        if any(len(row) != len(FRAME_COLUMNS) for row in csv.reader(file)):
            raise Broken("a row is there in part")


SUBJECTS = (Subject("files of a run", write_run, quiet=False, short=40),)
