"""What the EKF's predict and update cost over the bare ``dsyrk``.

    python benchmarks/backends.py [--quick] [--out DIR]

Times are CPU times, medians of one run; compare ratios, not milliseconds. How cost grows: `benchmarks/growth.py`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg.blas import dsyrk
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options
from experiments.long_run import DT, MODELS, RIG, measured
from experiments.tables import markdown, write_json
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.interfaces import Backend

HEADER = ("landmarks' coordinates", "landmarks", "measured", "dsyrk [ms]", "predict [ms]", "update [ms]", "ratio",
          "turning, ratio")  # fmt: skip


def seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.thread_time()
    call()
    return time.thread_time() - start


# --- a map all around, of which so many landmarks are measured ---


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


def turning(name: str, size: int, count: int, frames: int, **options: object) -> Iterator[tuple[float, float, float]]:
    """As `standing`, but the camera turns right around once, so that what is measured changes all the time."""
    rng = np.random.default_rng(0)
    backend, points, known, stamp = mapped(name, size, count + 10 + count // 10, rng, **options)
    ids = np.array(sorted(known))
    for k in range(1, frames + 1):
        T = se3.exp(np.array([0, 2 * np.pi * k / frames, 0, 0, 0, 0]))
        seen = measured(T, points[ids], ids, rng)
        seen = seen.select(np.arange(min(count, len(seen))))
        yield (
            seconds(partial(backend.predict, stamp + k * DT)),
            seconds(partial(backend.update, seen)),
            0.0,
        )


def bare_dsyrk(landmarks: int, count: int) -> Callable[[], object]:
    """The one thing that a filter of this size cannot do without."""
    n = 12 + 3 * landmarks
    P = np.asfortranarray(np.eye(n))
    W = np.asfortranarray(1e-3 * np.random.default_rng(0).standard_normal((n, 3 * count)))
    return lambda: dsyrk(-1.0, W, beta=1.0, c=P, lower=1, overwrite_c=1)


def ratios(sizes: Sequence[tuple[int, int]], frames: int) -> Iterator[list[object]]:
    """The EKF's time over that of the bare ``dsyrk``, as `HEADER`.

    By medians for a camera that stands still; by means for one that turns around, so that the frames count in which the
    filter stores its whole covariance.
    """
    for landmarks, count in sizes:
        for coordinates in ("inverse_depth", "euclidean"):
            bare = bare_dsyrk(landmarks, count)
            still, moving = (
                1e3
                * np.array(
                    [
                        (seconds(bare), *times[:2])
                        for times in drive("ekf", landmarks, count, frames, landmarks=coordinates)
                    ]
                )
                for drive in (standing, turning)
            )
            floor, predict, update = map(float, np.median(still, axis=0))
            mean = moving.mean(axis=0)
            ratio = float(mean[1] + mean[2]) / float(mean[0])
            yield [coordinates, landmarks, count, floor, predict, update, (predict + update) / floor, ratio]


def main() -> int:
    parser = script_options(__file__, __doc__, "two sizes and few frames")
    arguments = parser.parse_args()
    sizes = [(60, 20), (318, 30)] if arguments.quick else [(50, 30), (150, 30), (318, 30), (318, 60), (1000, 30)]
    with threadpool_limits(1, user_api="blas"):
        table = list(ratios(sizes, 20 if arguments.quick else 100))
    print(markdown(HEADER, table))
    write_json(arguments.out / "table.json", HEADER, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
