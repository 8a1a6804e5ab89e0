"""What the back ends cost: against the bare arithmetic, against the size of the problem, and over a long run.

    python benchmarks/backends.py [--quick]              all sections but the long run, and the figure
    python benchmarks/backends.py --only ratios          the EKF's predict and update over the bare ``dsyrk``
    python benchmarks/backends.py --only growth          cost with landmarks, observations and frames
    python benchmarks/backends.py --only long [--frames 20000] [--backends ekf]

Times are CPU times, medians of one run; compare ratios, not milliseconds.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg.blas import dsyrk
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from slam import se3
from slam.data import Observations
from slam.interfaces import Backend
from slam.metrics import nees, pose_residuals
from slam.models import EstimatorModels, MotionModel
from slam.rig import StereoRig
from slam.se3 import Array

RIG = StereoRig.rectified_pair(f=400.0, u0=320.0, v0=240.0, baseline=0.3, width=641, height=481)
MODELS = EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=0.5)
DT = 0.1


def seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.thread_time()
    call()
    return time.thread_time() - start


def measured(T: Array, points: Array, ids: np.ndarray, rng: np.random.Generator) -> Observations:
    """What the rig sees of points (N, 3) named `ids` from the pose T (4, 4), with noise."""
    left, right = RIG.project(se3.transform(se3.inverse(T), points))
    seen = np.flatnonzero(RIG.left.in_image(left) & RIG.right.in_image(right))
    noise = MODELS.pixel_sigma * rng.standard_normal((2, len(seen), 2))
    return Observations(ids[seen], left[seen] + noise[0], right[seen] + noise[1])


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


def standing(name: str, size: int, count: int, frames: int, **options: object) -> Iterator[tuple[float, float]]:
    """CPU seconds of predict and update, frame by frame, where `count` of a map of `size` are measured."""
    rng = np.random.default_rng(0)
    backend, points, known, stamp = mapped(name, size, count + 10 + count // 10, rng, **options)
    ids = np.array(sorted(known))
    for k in range(1, frames + 1):
        seen = measured(np.eye(4), points[ids], ids, rng).select(np.arange(count))
        yield (
            seconds(partial(backend.predict, stamp + k * DT)),
            seconds(partial(backend.update, seen)),
        )


def bare_dsyrk(landmarks: int, count: int) -> Callable[[], object]:
    """The one thing that a filter of this size cannot do without."""
    n = 12 + 3 * landmarks
    P = np.asfortranarray(np.eye(n))
    W = np.asfortranarray(1e-3 * np.random.default_rng(0).standard_normal((n, 3 * count)))
    return lambda: dsyrk(-1.0, W, beta=1.0, c=P, lower=1, overwrite_c=1)


def ratios(sizes: Sequence[tuple[int, int]], frames: int) -> None:
    """Prints the EKF's time over that of the bare ``dsyrk``."""
    print("| landmarks | measured | landmarks' coordinates | dsyrk [ms] | predict | update | ratio |")
    print("| ---: | ---: | --- | ---: | ---: | ---: | ---: |")
    with threadpool_limits(1, user_api="blas"):
        for landmarks, count in sizes:
            for coordinates in ("inverse_depth", "euclidean"):
                bare, times = bare_dsyrk(landmarks, count), []
                for predict, update in standing("ekf", landmarks, count, frames, landmarks=coordinates):
                    times.append((seconds(bare), predict, update))
                floor, predict, update = 1e3 * np.median(times, axis=0)
                print(
                    f"| {landmarks} | {count} | {coordinates} | {floor:.2f} | {predict:.2f} | {update:.2f} "
                    f"| {(predict + update) / floor:.2f} |",
                    flush=True,
                )


# --- a corridor without end: landmarks come and go ---


@dataclass(frozen=True)
class Corridor:
    """A camera that walks along a corridor for ever, swaying; landmarks on both walls, drawn as it comes along.

    Attributes:
        density: landmarks per metre.
        speed: [m/s].
    """

    density: int = 10
    speed: float = 1.0

    def pose(self, stamp: float) -> Array:
        """True ``T_world_left`` (4, 4)."""
        turn = np.array([0.02 * np.sin(1.3 * stamp), 0.1 * np.sin(0.7 * stamp), 0.02 * np.sin(stamp)])
        return se3.pose(se3.so3_exp(turn), np.array([0.3 * np.sin(0.5 * stamp), 0.0, self.speed * stamp]))

    def landmarks(self, stamp: float) -> tuple[np.ndarray, Array]:
        """Ids (N,) and positions (N, 3) of those that may be in view."""
        first = int(self.speed * stamp)
        metres = np.arange(first + 2, first + 10)
        along = [np.random.default_rng([3, m]).random((self.density, 3)) for m in metres.tolist()]
        ids = (self.density * metres[:, None] + np.arange(self.density)).reshape(-1)
        u = np.concatenate(along)
        side = np.where(ids % 2 == 0, -2.0, 2.0)
        return ids, np.stack([side, 3 * u[:, 1] - 1.5, np.repeat(metres, self.density) + u[:, 2]], axis=1)


@dataclass(frozen=True)
class Checkpoint:
    """What a long run has come to.

    Attributes:
        frame: number of the frame.
        milliseconds: median CPU time of a frame since the last checkpoint.
        memory: of the process [MB].
        landmarks: in the map.
        least: least eigenvalue of the correlation matrix: of the whole state where the back end has one (`ekf`), else
            of the pose.
        failed: updates that failed so far.
        drift: error of the newest position [m].
        step_nees: mean NEES of the pose; of a path without known landmarks it says how honest the drift is.
    """

    frame: int
    milliseconds: float
    memory: float
    landmarks: int
    least: float
    failed: int
    drift: float
    step_nees: float


def walk(
    name: str, frames: int, checkpoints: int = 10, corridor: Corridor = Corridor(), seed: int = 0
) -> Iterator[Checkpoint]:
    """A long run: landmarks join where they come into view and leave the map once out of it."""
    rng, backend = np.random.default_rng(seed), backends.create(name, RIG, models=MODELS)
    known: set[int] = set()
    times, surprises, failed = [], [], 0
    for k in range(frames):
        stamp = DT * k
        T = corridor.pose(stamp)
        ids, points = corridor.landmarks(stamp)
        seen = measured(T, points, ids, rng)
        start = time.thread_time()
        backend.predict(stamp)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        failed += backend.update(seen.select(old)).status.value == "failed"
        gone = known - set(ids.tolist())
        backend.remove(sorted(gone))
        backend.add(seen.select(~old))
        estimate = backend.estimate(landmarks=False)
        times.append(time.thread_time() - start)
        known = (known | set(seen.ids.tolist())) - gone
        error = pose_residuals(estimate.T_world_left[None], T[None] if k else estimate.T_world_left[None])
        surprises.append(nees(error, estimate.covariance[None])[0])
        if (k + 1) % max(1, frames // checkpoints) == 0:
            yield Checkpoint(
                k + 1, 1e3 * float(np.median(times)), memory(), len(known), least_eigenvalue(backend), failed,
                float(np.linalg.norm(error[0, 3:])), float(np.mean(surprises)),
            )  # fmt: skip
            times, surprises = [], []


def least_eigenvalue(backend: Backend) -> float:
    """Of the correlation matrix of the state, or of the pose where the back end keeps no matrix of the state."""
    whole = getattr(backend, "_covariance", None)
    P = whole.full() if whole is not None else backend.estimate(landmarks=False).covariance
    deviation = np.sqrt(np.diag(P))
    return float(np.linalg.eigvalsh(P / np.outer(deviation, deviation))[0])


def memory() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def long_run(name: str, frames: int) -> None:
    """Prints what must not decay."""
    print(f"\n{name}, {frames} frames\n")
    print("| frame | ms | memory [MB] | landmarks | least eigenvalue | failed | drift [m] | NEES |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for c in walk(name, frames):
        print(
            f"| {c.frame} | {c.milliseconds:.2f} | {c.memory:.0f} | {c.landmarks} | {c.least:.1e} | {c.failed} "
            f"| {c.drift:.2f} | {c.step_nees:.1f} |",
            flush=True,
        )


# --- how cost grows ---


def growth(names: Sequence[str], quick: bool, out: Path) -> None:
    """Prints and draws milliseconds a frame against landmarks, observations and frames."""
    maps, counts = ((60, 120), (10, 40)) if quick else ((60, 150, 300, 600), (10, 30, 60, 120))
    repeats, frames = (10, 60) if quick else (30, 400)
    curves: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    for name in names:
        by_map = [per_frame(name, n, 30, repeats) for n in maps]
        by_count = [per_frame(name, 2 * max(counts), m, repeats) for m in counts]
        along = list(walk(name, frames))
        curves[name] = {
            "landmarks in the map (30 measured)": (list(maps), by_map),
            f"landmarks measured (of {2 * max(counts)})": (list(counts), by_count),
            "frame of a walk along a corridor": ([c.frame for c in along], [c.milliseconds for c in along]),
        }
        for what, (x, y) in curves[name].items():
            print(f"{name}, ms by {what}: " + ", ".join(f"{a}: {b:.2f}" for a, b in zip(x, y)), flush=True)
    draw(out, curves)


def per_frame(name: str, landmarks: int, count: int, frames: int) -> float:
    """Median milliseconds of predict and update."""
    return 1e3 * float(np.median([sum(pair) for pair in standing(name, landmarks, count, frames)]))


def draw(path: Path, curves: dict[str, dict[str, tuple[list[float], list[float]]]]) -> None:
    """A panel each for landmarks, observations and frames."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    titles = list(next(iter(curves.values())))
    figure, axes = plt.subplots(1, len(titles), figsize=(4 * len(titles), 3.2))
    for title, panel in zip(titles, axes):
        for name, lines in curves.items():
            panel.plot(*lines[title], "o-", label=name)
        panel.set(xlabel=title, ylim=(0, None))
    axes[0].set_ylabel("CPU time of a frame [ms]")
    axes[0].legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes and few frames")
    parser.add_argument("--only", choices=("ratios", "growth", "long"))
    parser.add_argument("--backends", nargs="*", default=("ekf", "smoother"))
    parser.add_argument("--frames", type=int, default=20_000, help="of the long run")
    parser.add_argument("--out", type=Path, default=Path("results/backends"))
    arguments = parser.parse_args()
    if arguments.only in (None, "ratios"):
        sizes = [(60, 20), (318, 30)] if arguments.quick else [(50, 30), (150, 30), (318, 30), (318, 60), (1000, 30)]
        ratios(sizes, 20 if arguments.quick else 100)
    if arguments.only in (None, "growth"):
        growth(arguments.backends, arguments.quick, arguments.out / "cost.png")
    if arguments.only == "long":
        for name in arguments.backends:
            long_run(name, 200 if arguments.quick else arguments.frames)


if __name__ == "__main__":
    main()
