"""How the cost of a frame grows with landmarks, measurements, features and moving objects; for frames see `long_run`.

    python benchmarks/growth.py [--quick] [--out DIR]

Each curve stands beside its floor, what cannot be done without: for the filter the bare ``dsyrk`` of its covariance,
for the smoother gtsam's own calls, for features SURF alone; for objects, the same frames without their detector. CPU
times, medians, floors from the same run; prints a Markdown table and draws the curves.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg.blas import dsyrk
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options, timed
from experiments.long_run import DT, MODELS, RIG, measured
from experiments.tables import markdown, picture, write_json
from slam.config import SystemConfig
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.interfaces import Backend
from slam.registry import ONLINE
from slam.sequences import open_sequence
from slam.system import StereoSlam

HEADER = ("by", "what", "size", "CPU [ms]", "floor [ms]", "ratio")
LANDMARKS, MEASURED, FEATURES, OBJECTS = (
    "landmarks in the map, 30 measured", "landmarks measured, of 240", "features, 320x240", "moving cars",
)  # fmt: skip


@dataclass(frozen=True)
class Point:
    """A point of a curve."""

    by: str  # what grows
    what: str  # whose time it is
    size: int  # how much there is of it
    milliseconds: float  # of a frame, or of the part of it that the curve is about
    floor: float | None  # of what cannot be done without; None where it was not measured

    def row(self) -> list[object]:
        """As `HEADER`."""
        ratio = None if not self.floor else self.milliseconds / self.floor
        return [self.by, self.what, self.size, self.milliseconds, self.floor, ratio]


def seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.thread_time()
    call()
    return time.thread_time() - start


def mapped(
    name: str, size: int, ahead: int, rng: np.random.Generator, **options: object
) -> tuple[Backend, Array, set[int], float]:
    """A back end that has turned once around, with `size` landmarks in its map, `ahead` of them in front.

    Returns the back end, which is back where it started and still, all points (N, 3), those of the map, and the time.
    """
    direction = rng.standard_normal((8 * size + 20 * ahead, 3)) * (1, 0.4, 1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * rng.uniform(4, 12, (len(direction), 1))
    backend, known, turns = backends.create(name, RIG, models=MODELS, **options), set[int](), 40
    for k in range(turns + 5):
        T = se3.exp(np.array([0, 2 * np.pi * min(k, turns) / turns, 0, 0, 0, 0]))
        seen = measured(T, points, np.arange(len(points)), rng)
        seen = seen.select(rng.permutation(len(seen)))
        backend.predict(DT * k)
        old = np.array([i in known for i in seen.ids.tolist()])
        backend.update(seen.select(np.flatnonzero(old)[:20]))
        wanted = ahead if k == 0 else -(-(size - len(known)) // max(1, turns - 8 - k))
        new = seen.select(np.flatnonzero(~old)[: min(wanted, size - len(known))])
        backend.add(new)
        known.update(new.ids.tolist())
    assert len(known) == size
    return backend, points, known, DT * (turns + 4)


def standing(name: str, size: int, count: int, frames: int, **options: object) -> Iterator[tuple[float, float, float]]:
    """CPU seconds of predict, of update and of gtsam in both, where `count` of a map of `size` are measured."""
    rng = np.random.default_rng(0)
    backend, points, known, stamp = mapped(name, size, count + 10 + count // 10, rng, **options)
    ids = np.array(sorted(known))
    for k in range(1, frames + 1):
        seen = measured(np.eye(4), points[ids], ids, rng).select(np.arange(count))
        before = getattr(backend, "solver_seconds", 0.0)
        predict = seconds(partial(backend.predict, stamp + k * DT))
        update = seconds(partial(backend.update, seen))
        yield predict, update, getattr(backend, "solver_seconds", 0.0) - before


def bare_dsyrk(landmarks: int, count: int) -> Callable[[], object]:
    """The one thing that a filter of this size cannot do without."""
    n = 12 + 3 * landmarks
    P = np.asfortranarray(np.eye(n))
    W = np.asfortranarray(1e-3 * np.random.default_rng(0).standard_normal((n, 3 * count)))
    return lambda: dsyrk(-1.0, W, beta=1.0, c=P, lower=1, overwrite_c=1)


def by_size(by: str, name: str, landmarks: int, count: int, frames: int) -> Point:
    """Predict and update of a camera that stands still, over the bare ``dsyrk`` or over gtsam's calls."""
    predict, update, gtsam = np.array(list(standing(name, landmarks, count, frames))).T
    with threadpool_limits(1, user_api="blas"):
        bare = bare_dsyrk(landmarks, count)
        floors = {"ekf": [seconds(bare) for _ in range(frames)], "smoother": gtsam}
    size = landmarks if by == LANDMARKS else count
    floor = 1e3 * float(np.median(floors[name])) if name in floors else None
    return Point(by, name, size, 1e3 * float(np.median(predict + update)), floor)


def by_features(name: str, count: int, frames: int) -> Point:
    """Whole frames over SURF alone."""
    sequence = open_sequence(f"synthetic:desk?frames={frames}")
    config = SystemConfig.for_kind(sequence.kind).with_settings([f"frontend.features={count}"])
    system, whole, surf = StereoSlam(sequence.rig, backend=name, config=config), [], []
    for frame in sequence:
        start = time.process_time()
        features = system.frontend.extract(frame)  # type: ignore[union-attr]
        surf.append(time.process_time() - start)
        system.process_features(features)
        whole.append(time.process_time() - start)
    return Point(FEATURES, name, count, *(1e3 * float(np.median(t[frames // 3 :])) for t in (whole, surf)))


def by_objects(name: str, cars: int, frames: int) -> Point:
    """Frames without their features, over the same without the detector of moving objects."""
    sequence = open_sequence(f"synthetic:street?cars={cars}&frames={frames}")
    features, found = [sequence.observations(k) for k in range(frames)], []  # type: ignore[attr-defined]
    for mode in ("detect", "off"):
        config = SystemConfig.for_kind(sequence.kind, None).with_settings([f"objects.mode={mode}"])
        system = StereoSlam(sequence.rig, None, name, config=config)
        found.append(float(np.median(timed(system.process_features, features)[1][frames // 3 :])))
    return Point(OBJECTS, name, cars, *found)


def points(quick: bool) -> list[Point]:
    """All curves."""
    maps, counts = ((60, 120), (10, 40)) if quick else ((60, 150, 300, 600), (10, 30, 60, 120))
    features, cars = ((100, 400), (0, 2)) if quick else ((100, 200, 400, 800, 1600), (0, 1, 2, 3))
    repeats, images = (10, 6) if quick else (20, 24)
    found = []
    for name in ONLINE:
        found += [by_size(LANDMARKS, name, n, 30, repeats) for n in maps]
        found += [by_size(MEASURED, name, 240, m, repeats) for m in counts]
        found += [by_features(name, n, images) for n in features]
        found += [by_objects(name, n, images) for n in cars]
    return found


def draw(path: Path, found: list[Point]) -> None:
    """A panel for each thing that grows, floors dashed."""
    kinds = list(dict.fromkeys(p.by for p in found))
    with picture(path, 3.4 * len(kinds), 3.2, 1, len(kinds)) as panels:
        for kind, panel in zip(kinds, panels):
            for name, colour in zip(ONLINE, ("C0", "C1", "C2"), strict=True):
                mine = sorted((p for p in found if p.by == kind and p.what == name), key=lambda p: p.size)
                sizes = [p.size for p in mine]
                panel.plot(sizes, [p.milliseconds for p in mine], "o-", color=colour, label=name, markersize=3)
                if all(p.floor is not None for p in mine):
                    panel.plot(sizes, [p.floor for p in mine], "--", color=colour, label=f"{name}, floor")
            panel.set(xlabel=kind, ylim=(0, None))
        panels[0].set_ylabel("CPU time of a frame [ms]")
        panels[0].legend(fontsize=7)


def main() -> int:
    parser = script_options(__file__, __doc__, "small sizes and few frames")
    arguments = parser.parse_args()
    found = points(arguments.quick)
    curves: dict[tuple[str, str], list[Point]] = {}
    for point in found:
        curves.setdefault((point.by, point.what), []).append(point)
    ends = [p.row() for curve in curves.values() for p in (curve[0], curve[-1])]  # the others are in the picture
    print(markdown(HEADER, ends, 2))
    write_json(arguments.out / "table.json", HEADER, [p.row() for p in found])
    draw(arguments.out / "growth.png", found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
