"""What experiments share: their options, the recordings that are there, runs with times, the error of a path."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from frontends import create
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures
from slam.evaluation.association_truth import SurfacePoints
from slam.geometry.trajectory import Trajectory
from slam.sequences import Sequence

T = TypeVar("T")


def script_options(script: str, doc: str | None, quick: str | None = None) -> argparse.ArgumentParser:
    """A parser for a script, its file, with ``--quick``, which does `quick`, and ``--out DIR``: ``results/NAME``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--out", type=Path, default=Path("results") / Path(script).stem, metavar="DIR")
    return parser


def span(text: str) -> tuple[int, int]:
    """``A:B``: from A to before B."""
    start, stop = text.split(":")
    return int(start), int(stop)


def recordings(folders: Mapping[str, str]) -> dict[str, Path]:
    """By name, those of some folders below SLAM_DATA that are there; none where it is not set."""
    data = os.environ.get("SLAM_DATA")
    return {name: Path(data) / f for name, f in folders.items() if (Path(data) / f).is_dir()} if data else {}


def features_of(sequence: Sequence) -> list[StereoFeatures]:
    """Features of every frame: those of a world as they are simulated, of a recording those of the front end."""
    if hasattr(sequence, "observations"):
        return [sequence.observations(k) for k in range(len(sequence))]
    frontend = create("surf", sequence.rig, **SystemConfig.for_kind(sequence.kind).frontend)
    return [frontend.extract(frame) for frame in sequence]


def path_of(results: Iterable[FrameResult], measured: bool = False) -> Trajectory:
    """The poses as they were reported; of the frames that measured them alone, if so asked."""
    estimates = [r.estimate for r in results if r.status.measured or not measured]
    poses = np.array([e.T_world_left for e in estimates]).reshape(-1, 4, 4)
    return Trajectory(np.array([e.stamp for e in estimates]), poses)


def timed(step: Callable[[T], FrameResult], frames: Iterable[T]) -> tuple[list[FrameResult], np.ndarray]:
    """What a step of the system gives for each frame, and its CPU times (F,) [ms]."""
    results, times = [], []
    for frame in frames:
        start = time.process_time()
        results.append(step(frame))
        times.append(1e3 * (time.process_time() - start))
    return results, np.array(times)


class AssociationCheck:
    """Counts right associations in a rendered world."""

    def __init__(self, sequence: Any) -> None:
        self._points = SurfacePoints(sequence)
        self._right = self._known = 0

    def add(self, k: int, result: FrameResult) -> None:
        """Take in what was made of the world's frame k."""
        off = self._points.of_matches(k, result)
        self._right, self._known = self._right + int((off < 3).sum()), self._known + len(off)

    @property
    def share(self) -> float:
        """Of the associations whose truth is known, those within 3 px of it [%]."""
        return 100 * self._right / max(self._known, 1)
