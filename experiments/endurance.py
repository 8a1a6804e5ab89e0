"""The whole system for hours: memory, open files and time, and a camera that stops giving frames and comes back.

    python experiments/endurance.py [--quick] [--backend NAME ...] [--frames 20000] [--images 20000] [--out DIR]
                                    [--page docs/robustness.md]

Two runs of each back end:

- ``observations``: features without images of a hall that the camera goes round and round in.
- ``images``: rendered images of a desk, forwards and backwards again and again, through SURF.

After a quarter of the frames the camera gives none for an hour, and after half of them nothing is to be seen in fifty.
A row for every twentieth part: CPU time of a frame, memory of the process and its open files, landmarks, keyframes and
loops, and frames that were not tracked. ``--page`` puts the table of all runs in DIR, also earlier ones, on a page.
"""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.common import script_options
from experiments.long_run import DT, MODELS, RIG, Loop, measured, memory
from experiments.tables import markdown
from slam.config import SystemConfig
from slam.data import FrameResult, FrameStatus, StereoFeatures, StereoFrame
from slam.registry import ONLINE
from slam.system import StereoSlam

_HOUR = 3600.0
_DARK = 50  # frames in which nothing is to be seen
_RENDERED = 90  # images of the desk, forwards and backwards
_PARTS = 20
BEGIN, END = "<!-- endurance: written by experiments/endurance.py --page -->", "<!-- end of endurance -->"
_WORLD = f"synthetic:desk?frames={_RENDERED}&width=320&height=240"


@dataclass(frozen=True)
class Part:
    """One part of a run.

    Attributes:
        frame: number of frames so far.
        median, mean: CPU time of a step, extraction included [ms].
        memory: of the process [MB].
        files: that are open.
        landmarks: in the map.
        keyframes: in the atlas.
        loops: closed so far.
        untracked: frames in this part that were not tracked, but for those in which nothing was to be seen.
    """

    frame: int
    median: float
    mean: float
    memory: float
    files: int
    landmarks: int
    keyframes: int
    loops: int
    untracked: int


def features(seed: int = 0) -> Iterator[StereoFeatures]:
    """What a camera sees that goes round and round in a hall, frame by frame, without end."""
    rng, route, k = np.random.default_rng(seed), Loop(), 0
    ids, points = route.landmarks(0.0)
    looks = rng.normal(size=(len(ids), 32))
    looks = (looks / np.linalg.norm(looks, axis=1, keepdims=True)).astype(np.float32)
    sign = np.where(rng.random(len(ids)) < 0.5, -1, 1).astype(np.int8)
    while True:
        seen = measured(route.pose(DT * k), points, ids, rng)
        n = len(seen)
        uv_right = np.column_stack([seen.uv_right[:, 0], seen.uv_left[:, 1]])
        yield StereoFeatures(
            DT * k, seen.uv_left, uv_right, np.full(n, 12.0), np.zeros(n), 1.0 + sign[seen.ids] * 0.1,
            sign[seen.ids], looks[seen.ids],
        )  # fmt: skip
        k += 1


def images() -> Iterator[StereoFrame]:
    """Rendered images of a desk, forwards and backwards, without end."""
    frames = list(slam.open_sequence(_WORLD))
    k, there_and_back = 0, [*range(_RENDERED), *range(_RENDERED - 2, 0, -1)]
    while True:
        yield replace(frames[there_and_back[k % len(there_and_back)]], index=k, stamp=k / 30)
        k += 1


def run(backend: str, kind: str, frames: int) -> Iterator[Part]:
    """A run with a gap of an hour and a dark stretch."""
    rig = RIG if kind == "observations" else slam.open_sequence(_WORLD).rig
    config = SystemConfig(models=MODELS) if kind == "observations" else None
    system = StereoSlam(rig, None if kind == "observations" else "surf", backend, config=config)
    every, untracked, spent = max(frames // _PARTS, 1), 0, []
    source: Iterator[Any] = features() if kind == "observations" else images()
    for k, given in zip(range(frames), source):
        dark = frames // 2 <= k < frames // 2 + min(_DARK, frames // 10)
        item = replace(given, stamp=given.stamp + (_HOUR if k >= frames // 4 else 0.0))
        start = time.process_time()
        result = _step(system, _darkened(item) if dark else item)
        spent.append(1e3 * (time.process_time() - start))
        untracked += not dark and result.status is not FrameStatus.TRACKED
        if (k + 1) % every == 0:
            files = len(list(Path("/proc/self/fd").iterdir()))
            median, mean = float(np.median(spent)), float(np.mean(spent))
            atlas, size = system.atlas.summary(), result.map_size
            yield Part(
                k + 1, median, mean, memory(), files, size, atlas["keyframes"], atlas["closed"], untracked
            )  # fmt: skip
            untracked, spent = 0, []


def _step(system: StereoSlam, item: StereoFrame | StereoFeatures) -> FrameResult:
    return system.process(item) if isinstance(item, StereoFrame) else system.process_features(item)


def _darkened(item: StereoFrame | StereoFeatures) -> StereoFrame | StereoFeatures:
    """The same with nothing to be seen."""
    if isinstance(item, StereoFeatures):
        return StereoFeatures.empty(item.stamp, item.descriptors.shape[1])
    return replace(item, left=np.zeros_like(item.left), right=np.zeros_like(item.left))


def table(runs: dict[str, list[Part]]) -> str:
    """Some parts of every run."""
    header = (
        "run", "frames", "median [CPU ms]", "mean [CPU ms]", "memory [MB]", "open files", "landmarks", "keyframes",
        "loops", "not tracked, so far",
    )  # fmt: skip
    rows = []
    for name, parts in runs.items():
        for i in sorted({0, 1, len(parts) // 2, len(parts) - 1}):
            p, lost = parts[i], sum(q.untracked for q in parts[: i + 1])
            rows.append((
                name, p.frame, f"{p.median:.1f}", f"{p.mean:.1f}", f"{p.memory:.0f}", p.files, p.landmarks, p.keyframes,
                p.loops, lost,
            ))  # fmt: skip
    return markdown(header, rows)


def write_page(page: Path, text: str) -> None:
    """Replace the table on a page, which is between two marks."""
    before, after = page.read_text(encoding="utf-8").split(BEGIN)
    page.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after.split(END)[1]}", encoding="utf-8")


def read_csv(path: Path) -> list[Part]:
    """What `write_csv` wrote."""
    with path.open(newline="") as file:
        return [Part(**{name: json.loads(value) for name, value in row.items()}) for row in csv.DictReader(file)]


def write_csv(path: Path, parts: list[Part]) -> None:
    """A row per part."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(Part)])
        writer.writerows(map(astuple, parts))


def main() -> int:
    parser = script_options(__file__, __doc__, "two hundred frames of each")
    parser.add_argument("--backend", nargs="*", default=list(ONLINE))
    parser.add_argument("--frames", type=int, default=20_000, help="of observations; 0 for none")
    parser.add_argument("--images", type=int, default=20_000, help="frames of images; 0 for none")
    parser.add_argument("--page", type=Path, help="a page for the table")
    arguments = parser.parse_args()
    counts = {"observations": arguments.frames, "images": arguments.images}
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs: dict[str, list[Part]] = {}
    for kind, frames in counts.items():
        for backend in arguments.backend if frames else ():
            parts = runs[f"{backend}, {kind}"] = []
            for part in run(backend, kind, 200 if arguments.quick else frames):
                parts.append(part)
                print(f"{backend} {kind} {part}", file=sys.stderr, flush=True)
                write_csv(arguments.out / f"{backend}_{kind}.csv", parts)
    print(table(runs))
    if arguments.page is not None:
        done = sorted(arguments.out.glob("*_*.csv"), key=lambda path: path.stem.split("_")[::-1], reverse=True)
        write_page(arguments.page, table({path.stem.replace("_", ", "): read_csv(path) for path in done}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
