"""A run of thousands of frames: what must not decay or grow.

    python experiments/long_run.py [--quick] [--backend NAME ...] [--world loop corridor] [--frames 20000]
                                   [--set lag=200] [--out DIR]

Two worlds without images, with true association and a map that stays bounded:

- ``loop``: a robot goes round and round in a hall, past the same landmarks; none is ever erased. A
  map that is finished.
- ``corridor``: it walks on for ever; landmarks join as they come into view and are erased once they lie behind. A map
  that is replaced all the time, of a path that nothing ties to its beginning.

Reported at every checkpoint: CPU time of a frame, memory of the process and what of it is neither interpreter nor
trajectory, landmarks, whether the covariance has a Cholesky factor and its least eigenvalue, failed updates, position
error and NEES. At the end, time and memory of the first and the last thousand frames.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options
from experiments.tables import markdown
from slam.data import IdArray, Observations
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
_CHECKED = 100  # frames between two looks at the covariance
_POSE_BYTES = 8 + 128  # of a stamp and a pose of the trajectory


# --- the worlds ---


class Route(Protocol):
    """Where the camera is, and which landmarks are near."""

    def pose(self, stamp: float) -> Array:
        """True ``T_world_left`` (4, 4)."""
        ...

    def landmarks(self, stamp: float) -> tuple[IdArray, Array]:
        """Ids (N,) and positions (N, 3) of those that may be in view; the others may be erased."""
        ...


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
        """See `Route.pose`."""
        turn = np.array([0.02 * np.sin(1.3 * stamp), 0.1 * np.sin(0.7 * stamp), 0.02 * np.sin(stamp)])
        return se3.pose(se3.so3_exp(turn), np.array([0.3 * np.sin(0.5 * stamp), 0.0, self.speed * stamp]))

    def landmarks(self, stamp: float) -> tuple[IdArray, Array]:
        """See `Route.landmarks`."""
        first = int(self.speed * stamp)
        metres = np.arange(first + 2, first + 10)
        along = [np.random.default_rng([3, m]).random((self.density, 3)) for m in metres.tolist()]
        ids = (self.density * metres[:, None] + np.arange(self.density)).reshape(-1)
        u = np.concatenate(along)
        side = np.where(ids % 2 == 0, -2.0, 2.0)
        return ids, np.stack([side, 3 * u[:, 1] - 1.5, np.repeat(metres, self.density) + u[:, 2]], axis=1)


class Loop:
    """A camera that goes round and round in a ring-shaped hall, swaying; landmarks on both walls.

    It never sees farther than 8 m, so that the pillar in the middle hides nothing.

    Args:
        count: landmarks in all.
        radius: of the path [m]; the walls are 2 m away on either side.
        speed: [m/s].
    """

    def __init__(self, count: int = 240, radius: float = 5.0, speed: float = 1.0) -> None:
        self._radius, self._speed = radius, speed
        u, side = np.random.default_rng(3).random((count, 2)), np.where(np.arange(count) % 2 == 0, -2.0, 2.0)
        azimuth = 2 * np.pi * (np.arange(count) + u[:, 0]) / count
        across = radius + side
        self._points = np.stack([across * np.cos(azimuth), 3 * u[:, 1] - 1.5, across * np.sin(azimuth)], axis=1)

    def pose(self, stamp: float) -> Array:
        """See `Route.pose`."""
        azimuth = self._speed * stamp / self._radius
        turn = np.array([0.02 * np.sin(1.3 * stamp), 0.1 * np.sin(0.7 * stamp) - azimuth, 0.02 * np.sin(stamp)])
        radius = self._radius + 0.3 * np.sin(0.5 * stamp)
        position = np.array([radius * np.cos(azimuth), 0.0, radius * np.sin(azimuth)])
        return se3.pose(se3.so3_exp(np.array([0, turn[1], 0])) @ se3.so3_exp(turn * (1, 0, 1)), position)

    def landmarks(self, stamp: float) -> tuple[IdArray, Array]:
        """See `Route.landmarks`."""
        return np.arange(len(self._points)), self._points


WORLDS = {"loop": Loop, "corridor": Corridor}
_FAR = 8.0  # nothing is seen beyond [m]


def measured(T: Array, points: Array, ids: IdArray, rng: np.random.Generator) -> Observations:
    """What the rig sees of points (N, 3) named `ids` from the pose T (4, 4), with noise."""
    h = se3.transform(se3.inverse(T), points)
    left, right = RIG.project(h)
    seen = np.flatnonzero(RIG.left.in_image(left) & RIG.right.in_image(right) & (h[:, 2] < _FAR))
    noise = MODELS.pixel_sigma * rng.standard_normal((2, len(seen), 2))
    return Observations(ids[seen], left[seen] + noise[0], right[seen] + noise[1])


# --- the run ---


@dataclass(frozen=True)
class Checkpoint:
    """What a run has come to, over the frames since the last checkpoint.

    Attributes:
        frame: number of the frame.
        milliseconds, mean_milliseconds: median and mean CPU time of a frame.
        memory: of the process [MB].
        beyond: of that what is neither there at the start nor trajectory [MB].
        landmarks: in the map.
        observed: of them measured, on average.
        least: least eigenvalue of the correlation matrix: of the whole state where the back end has one (`ekf`), else
            of the pose.
        indefinite: looks at the covariance, so far, at which it had no Cholesky factor.
        failed: updates that failed so far.
        error: of the newest position [m].
        nees: mean of the pose's NEES (6 expected).
        inside: share of the frames whose NEES lies below the 95 % quantile.
    """

    frame: int
    milliseconds: float
    mean_milliseconds: float
    memory: float
    beyond: float
    landmarks: int
    observed: float
    least: float
    indefinite: int
    failed: int
    error: float
    nees: float
    inside: float


_NEES_95 = 12.592  # quantile of chi-square, six degrees of freedom


def run(
    name: str, frames: int, every: int = 1000, route: Route | None = None, seed: int = 0, **options: object
) -> Iterator[Checkpoint]:
    """A long run of one back end; landmarks join where they come into view and leave where the route drops them."""
    route, rng = route or Loop(), np.random.default_rng(seed)
    models = EstimatorModels(MODELS.motion, MODELS.pixel_sigma, T_world_left=tuple(map(tuple, route.pose(0.0))))
    backend = backends.create(name, RIG, models=models, **options)
    known: set[int] = set()
    times, distances, counts, failed, indefinite, before = [], [], [], 0, 0, memory()
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
        times.append(time.thread_time() - start)
        known = (known | set(seen.ids.tolist())) - gone
        failed += report.status.value == "failed"
        error = pose_residuals(np.stack([T, estimate.T_world_left]), np.stack([T, T]))[1:]
        distances.append(float(nees(error, estimate.covariance[None])[0]))
        counts.append(int(old.sum()))
        if (k + 1) % _CHECKED == 0:
            indefinite += not has_cholesky(correlation(backend))
        if (k + 1) % every == 0 or k + 1 == frames:
            now = memory()
            yield Checkpoint(
                k + 1, 1e3 * float(np.median(times)), 1e3 * float(np.mean(times)), now,
                now - before - 1e-6 * _POSE_BYTES * (k + 1), len(known), float(np.mean(counts)),
                float(np.linalg.eigvalsh(correlation(backend))[0]), indefinite, failed,
                float(np.linalg.norm(error[0, 3:])), float(np.mean(distances)),
                float(np.mean(np.array(distances) < _NEES_95)),
            )  # fmt: skip
            times, distances, counts = [], [], []


def correlation(backend: Backend) -> Array:
    """Correlation matrix of the state, or of the pose where the back end keeps no matrix of the state."""
    whole = getattr(backend, "_covariance", None)
    P: Array = whole.full() if whole is not None else backend.estimate(landmarks=False).covariance
    deviation = np.sqrt(np.diag(P))
    return np.asarray(P / np.outer(deviation, deviation))


def has_cholesky(matrix: Array) -> bool:
    """Whether a symmetric matrix is positive definite as it stands in the machine."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def memory() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


# --- what is written ---

HEADER = (
    "frame", "ms, median", "ms, mean", "memory [MB]", "beyond start and trajectory [MB]", "landmarks", "measured",
    "least eigenvalue", "no Cholesky", "failed", "error [m]", "NEES (6)", "below 95 %",
)  # fmt: skip
_FORMATS = ("{}", "{:.2f}", "{:.2f}", "{:.0f}", "{:.1f}", "{}", "{:.0f}", "{:.1e}", "{}", "{}", "{:.3f}", "{:.1f}",
            "{:.0%}")  # fmt: skip


def cells(c: Checkpoint) -> list[str]:
    """A row of the table."""
    return [form.format(value) for form, value in zip(_FORMATS, astuple(c))]


def table(done: Sequence[Checkpoint]) -> str:
    """The checkpoints, and what the last did to the first."""
    rows = list(map(cells, done))
    first, last = done[min(1, len(done) - 1)], done[-1]  # in the first thousand the map is still growing
    return (
        f"{markdown(HEADER, rows, 0)}\n\nTime of a frame, last over first {done[0].frame} frames: "
        f"{last.milliseconds / done[0].milliseconds:.2f} "
        f"(over the second: {last.milliseconds / first.milliseconds:.2f}); "
        f"memory beyond the trajectory: {last.beyond - first.beyond:+.1f} MB since frame {first.frame}; "
        f"covariance without Cholesky factor: {last.indefinite} times; failed updates: {last.failed}."
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
    parser.add_argument("--world", nargs="*", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", type=setting, default=[], metavar="KEY=VALUE", help="back-end options")
    arguments = parser.parse_args()
    frames = 200 if arguments.quick else arguments.frames
    for name in arguments.backend:
        for world in arguments.world:
            every, options = max(1, min(1000, frames // 4)), dict(arguments.set)
            done = list(run(name, frames, every, WORLDS[world](), arguments.seed, **options))
            print(f"# {name}, {world}, {frames} frames\n\n{table(done)}\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
