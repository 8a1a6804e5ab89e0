"""For runs whose files cannot all be written: a sequence that breaks, a full disk, and whether files are whole."""

from __future__ import annotations

import csv
import json
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam.atlas.map_io import load_map
from slam.data import StereoFeatures, StereoFrame
from slam.geometry.trajectory import Trajectory
from slam.run.outputs import FRAME_COLUMNS
from slam.run.recording import load_recording
from tests.fuzz.harness import Broken, scene

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
