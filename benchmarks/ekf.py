"""The EKF's arithmetic: predict and update against the bare ``dsyrk`` of the same size, and a long run.

``python benchmarks/ekf.py``            ratios at several sizes (CPU time, medians of one run)
``python benchmarks/ekf.py --long N``   N updates along a loop: definiteness, accuracy, time and memory
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg.blas import dsyrk
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from backends.ekf import EkfBackend
from slam import se3
from slam.data import Observations
from slam.models import EstimatorModels, MotionModel
from slam.rig import StereoRig

RIG = StereoRig.rectified_pair(f=400.0, u0=320.0, v0=240.0, baseline=0.3, width=641, height=481)
MODELS = EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=0.5)
DT = 0.1


def points_around(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) on all sides of the origin, 4 to 12 m away."""
    direction = rng.standard_normal((count, 3)) * (1, 0.4, 1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(4, 12, (count, 1))


def observe(T: np.ndarray, points: np.ndarray, rng: np.random.Generator, limit: int) -> Observations:
    """What the rig sees of the points from the pose T (4, 4): up to `limit` of them, at random, with noise."""
    left, right = RIG.project(se3.transform(se3.inverse(T), points))
    seen = rng.permutation(np.flatnonzero(RIG.left.in_image(left) & RIG.right.in_image(right)))[:limit]
    noise = MODELS.pixel_sigma * rng.standard_normal((2, len(seen), 2))
    return Observations(seen.astype(np.int64), left[seen] + noise[0], right[seen] + noise[1])


def mapped(
    landmarks: int, ahead: int, rng: np.random.Generator, **options: int
) -> tuple[EkfBackend, np.ndarray, float]:
    """A filter that has turned once around, with `landmarks` in its map, `ahead` of them in front; points (N, 3), time.

    It is back where it started, and still.
    """
    points = points_around(8 * landmarks + 20 * ahead, rng)
    backend, known, turns = EkfBackend(RIG, MODELS, **options), set[int](), 40
    for k in range(turns + 5):
        T = se3.exp(np.array([0, 2 * np.pi * min(k, turns) / turns, 0, 0, 0, 0]))
        seen = observe(T, points, rng, len(points))
        backend.predict(DT * k)
        old = np.array([i in known for i in seen.ids.tolist()])
        backend.update(seen.select(np.flatnonzero(old)[:20]))
        wanted = ahead if k == 0 else -(-(landmarks - len(known)) // max(1, turns - 8 - k))
        new = seen.select(np.flatnonzero(~old)[: min(wanted, landmarks - len(known))])
        backend.add(new)
        known.update(new.ids.tolist())
    assert len(known) == landmarks
    return backend, points, DT * (turns + 4)


def seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.thread_time()
    call()
    return time.thread_time() - start


def ratios(landmarks: int, measured: int, frames: int, **options: int) -> dict[str, float]:
    """Milliseconds of predict, update and the bare ``dsyrk``, and the ratio of the medians."""
    rng = np.random.default_rng(0)
    backend, points, stamp = mapped(landmarks, measured + 10, rng, **options)
    n = 12 + 3 * landmarks
    P = np.asfortranarray(np.eye(n))
    W = np.asfortranarray(1e-3 * rng.standard_normal((n, 3 * measured)))
    times: dict[str, list[float]] = {"dsyrk": [], "predict": [], "update": []}
    known = backend.estimate().ids
    with threadpool_limits(1, user_api="blas"):
        for k in range(1, frames + 1):
            now, seen = stamp + k * DT, observe(np.eye(4), points, rng, len(points))
            seen = seen.select(np.flatnonzero(np.isin(seen.ids, known))[:measured])
            assert len(seen) == measured
            times["dsyrk"].append(seconds(lambda: dsyrk(-1.0, W, beta=1.0, c=P, lower=1, overwrite_c=1)))
            times["predict"].append(seconds(partial(backend.predict, now)))
            times["update"].append(seconds(partial(backend.update, seen)))
    medians = {name: 1e3 * float(np.median(values)) for name, values in times.items()}
    return medians | {"ratio": (medians["predict"] + medians["update"]) / medians["dsyrk"]}


def long_run(updates: int, landmarks: int = 60, measured: int = 8) -> None:
    """A camera turning round and round for many updates; prints what must not decay."""
    rng = np.random.default_rng(0)
    backend, points, stamp = mapped(landmarks, landmarks // 12, rng)
    known, spent, counted, start = backend.estimate().ids, 0.0, 0, stamp
    print("  updates  least eigenvalue*  largest    error [m]  [rad]    ms/frame  memory [MB]  failed")
    failed = 0
    for k in range(1, updates + 1):
        stamp += DT
        T = se3.exp(np.array([0, 0.5 * stamp, 0, 0, 0, 0]))
        seen = observe(T, points, rng, len(points))
        seen = seen.select(np.flatnonzero(np.isin(seen.ids, known))[:measured])
        begin = time.thread_time()
        backend.predict(stamp)
        failed += backend.update(seen).status.value == "failed"
        spent, counted = spent + time.thread_time() - begin, counted + 1
        if k in {100, 1000, 10_000} or k % max(1, updates // 10) == 0:
            P = backend._covariance.full()
            d = np.sqrt(np.diag(P))
            values = np.linalg.eigvalsh(P / np.outer(d, d))
            xi = se3.log(se3.inverse(T) @ backend.estimate(landmarks=False).T_world_left)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"{k:9d}  {values[0]:16.3e}  {values[-1]:8.2f}  {np.linalg.norm(xi[3:]):9.5f}  "
                f"{np.linalg.norm(xi[:3]):.5f}  {1e3 * spent / counted:8.2f}  {memory:10.0f}  {failed:6d}",
                flush=True,
            )
            spent, counted = 0.0, 0
    print(f"* of the correlation matrix; {stamp - start:.0f} s simulated")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", type=int, metavar="N", help="a long run of N updates instead of the ratios")
    parser.add_argument("--quick", action="store_true", help="few frames and sizes")
    arguments = parser.parse_args()
    if arguments.long:
        long_run(arguments.long)
        return
    sizes = [(60, 20), (318, 30)] if arguments.quick else [(50, 30), (150, 30), (318, 30), (318, 60), (1000, 30)]
    print("landmarks  measured  iterations  dsyrk [ms]  predict  update   ratio")
    for landmarks, measured in sizes:
        for iterations in (5, 1):
            row = ratios(landmarks, measured, 20 if arguments.quick else 100, iterations=iterations)
            print(
                f"{landmarks:9d}  {measured:8d}  {iterations:10d}  {row['dsyrk']:10.2f}  {row['predict']:7.2f}  "
                f"{row['update']:6.2f}  {row['ratio']:6.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
