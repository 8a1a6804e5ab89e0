"""A run of thousands of frames: what must not decay or grow.

    python experiments/long_run.py [--quick] [--backend NAME ...] [--frames 20000] [--set lag=200] [--out DIR]

A camera walks along a corridor for ever, with true association: landmarks join as they come into view and are erased
once they lie behind. The map is replaced all the time, and nothing ties the path to its beginning.

Reported at every checkpoint: time, memory, landmarks, failed updates, error and NEES; at the end, what has changed.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options
from experiments.tables import markdown
from slam.data import Estimate, IdArray, Observations, UpdateReport
from slam.evaluation.metrics import nees, pose_residuals
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.interfaces import Backend
from slam.models import EstimatorModels, MotionModel
from slam.registry import ONLINE

RIG = StereoRig.rectified_pair(f=400.0, u0=320.0, v0=240.0, baseline=0.3, width=641, height=481)
MODELS = EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=0.5)
DT = 0.1
_POSE_BYTES = 8 + 128  # of a stamp and a pose of the trajectory


@dataclass(frozen=True)
class Corridor:
    """A camera that walks along a corridor for ever, swaying; landmarks on both walls, drawn as it comes along."""

    density: int = 10  # landmarks per metre
    speed: float = 1.0  # [m/s]

    def pose(self, stamp: float) -> Array:
        """True ``T_world_left`` (4, 4)."""
        turn = np.array([0.02 * np.sin(1.3 * stamp), 0.1 * np.sin(0.7 * stamp), 0.02 * np.sin(stamp)])
        return se3.pose(se3.so3_exp(turn), np.array([0.3 * np.sin(0.5 * stamp), 0.0, self.speed * stamp]))

    def landmarks(self, stamp: float) -> tuple[IdArray, Array]:
        """Ids (N,) and positions (N, 3) of those that may be in view; the others may be erased."""
        first = int(self.speed * stamp)
        metres = np.arange(first + 2, first + 10)
        along = [np.random.default_rng([3, m]).random((self.density, 3)) for m in metres.tolist()]
        ids = (self.density * metres[:, None] + np.arange(self.density)).reshape(-1)
        u = np.concatenate(along)
        side = np.where(ids % 2 == 0, -2.0, 2.0)
        return ids, np.stack([side, 3 * u[:, 1] - 1.5, np.repeat(metres, self.density) + u[:, 2]], axis=1)


_FAR = 8.0  # nothing is seen beyond [m]


def measured(T: Array, points: Array, ids: IdArray, rng: np.random.Generator) -> Observations:
    """What the rig sees of points (N, 3) named `ids` from the pose T (4, 4), with noise."""
    h = se3.transform(se3.inverse(T), points)
    left, right = RIG.project(h)
    seen = np.flatnonzero(RIG.left.in_image(left) & RIG.right.in_image(right) & (h[:, 2] < _FAR))
    noise = MODELS.pixel_sigma * rng.standard_normal((2, len(seen), 2))
    return Observations(ids[seen], left[seen] + noise[0], right[seen] + noise[1])


@dataclass(frozen=True)
class Step:
    """One frame of a walk."""

    T: Array  # true pose (4, 4)
    estimate: Estimate  # of the pose alone
    report: UpdateReport
    landmarks: int  # in the map
    milliseconds: float  # CPU time


def walk(backend: Backend, frames: int, rng: np.random.Generator, route: Corridor) -> Iterator[Step]:
    """Along the corridor; landmarks join where they come into view and leave once they lie behind."""
    known: set[int] = set()
    for k in range(frames):
        stamp, T = DT * k, route.pose(DT * k)
        ids, points = route.landmarks(stamp)
        seen = measured(T, points, ids, rng)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        gone = known - set(ids.tolist())
        start = time.thread_time()
        backend.predict(stamp)
        report = backend.update(seen.select(old))
        backend.remove(sorted(gone))
        backend.add(seen.select(~old))
        estimate = backend.estimate(landmarks=False)
        took = 1e3 * (time.thread_time() - start)
        known = (known | set(seen.ids.tolist())) - gone
        yield Step(T, estimate, report, len(known), took)


@dataclass(frozen=True)
class Checkpoint:
    """What a run has come to, over the frames since the last checkpoint."""

    frame: int
    milliseconds: float  # CPU time of a frame, median
    memory: float  # of the process [MB]
    beyond: float  # of that what is neither there at the start nor trajectory [MB]
    landmarks: int  # in the map
    least: float  # eigenvalue of the pose's correlations in any frame
    failed: int  # updates, so far
    error: float  # of the newest position [m]
    nees: float  # of the pose, mean (6 expected)


def run(
    name: str, frames: int, every: int = 1000, route: Corridor | None = None, seed: int = 0, **options: object
) -> Iterator[Checkpoint]:
    """A long run of one back end."""
    route = route or Corridor()
    models = EstimatorModels(MODELS.motion, MODELS.pixel_sigma, T_world_left=tuple(map(tuple, route.pose(0.0))))
    backend = backends.create(name, RIG, models=models, **options)
    steps, failed, before = list[Step](), 0, memory()
    for k, step in enumerate(walk(backend, frames, np.random.default_rng(seed), route), start=1):
        steps.append(step)
        failed += step.report.status.value == "failed"
        if k % every == 0 or k == frames:
            errors = pose_residuals(np.array([s.T for s in steps]), np.array([s.estimate.T_world_left for s in steps]))
            P = np.array([s.estimate.covariance for s in steps])
            sigma, now = np.sqrt(np.diagonal(P, axis1=1, axis2=2)), memory()
            least = np.linalg.eigvalsh(P / (sigma[:, :, None] * sigma[:, None])).min()
            yield Checkpoint(
                k, float(np.median([s.milliseconds for s in steps])), now, now - before - 1e-6 * _POSE_BYTES * k,
                step.landmarks, float(least), failed, float(np.linalg.norm(errors[-1, 3:])),
                float(nees(errors, P).mean()),
            )  # fmt: skip
            steps = []


def memory() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


HEADER = (
    "frame", "ms, median", "memory [MB]", "beyond start and trajectory [MB]", "landmarks", "least eigenvalue", "failed",
    "error [m]", "NEES (6)",
)  # fmt: skip


def table(done: Sequence[Checkpoint]) -> str:
    """The checkpoints, and what the last did to the first."""
    first, last = done[min(1, len(done) - 1)], done[-1]  # in the first thousand the map is still growing
    return (
        f"{markdown(HEADER, [[f'{value:.4g}' for value in astuple(c)] for c in done], 0)}\n\n"
        f"Time of a frame, last over first {done[0].frame} frames: {last.milliseconds / done[0].milliseconds:.2f} "
        f"(over the second: {last.milliseconds / first.milliseconds:.2f}); "
        f"memory beyond the trajectory: {last.beyond - first.beyond:+.1f} MB since frame {first.frame}; "
        f"failed updates: {last.failed}."
    )


def setting(text: str) -> tuple[str, object]:
    """``key=value``; the value is JSON (``true``, ``50``) or a plain word, as with ``slam run --set``."""
    key, _, value = text.partition("=")
    try:
        return key, json.loads(value)
    except json.JSONDecodeError:
        return key, value


def main() -> int:
    parser = script_options(__file__, __doc__, "two hundred frames")
    parser.add_argument("--backend", nargs="*", default=list(ONLINE), help="any registered ones")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", type=setting, default=[], metavar="KEY=VALUE", help="back-end options")
    arguments = parser.parse_args()
    frames = 200 if arguments.quick else arguments.frames
    for name in arguments.backend:
        every = max(1, min(1000, frames // 4))
        done = list(run(name, frames, every, seed=arguments.seed, **dict(arguments.set)))
        print(f"# {name}, {frames} frames\n\n{table(done)}\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
