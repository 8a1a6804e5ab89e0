"""A tiny deterministic scene for the tests of back ends: a rig, a path, points, and what the rig sees of them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from slam.data import Observations, UpdateReport
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.interfaces import Backend
from slam.models import EstimatorModels, MotionModel
from tests.slam.numeric import chained

RIG = StereoRig.rectified_pair(f=400.0, u0=320.0, v0=240.0, baseline=0.3, width=641, height=481)


@dataclass(frozen=True)
class Scene:
    """Truth and measurements: `poses` (F, 4, 4) T_world_left, the first the identity; `points` (N, 3) in the world."""

    rig: StereoRig
    stamps: Array
    poses: Array
    points: Array
    observations: tuple[Observations, ...]

    def __iter__(self) -> Iterator[tuple[float, Array, Observations]]:
        return iter(zip(self.stamps, self.poses, self.observations))


def path(frames: int, dt: float, velocity: Array, rate: Array) -> Array:
    """Poses (F, 4, 4) of constant body velocity [m/s] and body rate [rad/s] from the identity."""
    return chained([se3.exp(dt * np.concatenate([rate, velocity]))] * (frames - 1))


def random_path(
    frames: int, dt: float, velocity: Array, motion: MotionModel, rng: np.random.Generator, kept: float = 1.0
) -> Array:
    """Poses (F, 4, 4) whose velocities walk randomly as `motion` says: world velocity, and body rate.

    Of the rate a share is `kept` from frame to frame.
    """
    T, v, w = np.eye(4), np.array(velocity, float), np.zeros(3)
    poses = [T]
    sigma_v, sigma_w = np.sqrt(motion.velocity_variance(dt))
    for _ in range(frames - 1):
        v, w = v + sigma_v * rng.standard_normal(3), kept * w + sigma_w * rng.standard_normal(3)
        T = se3.pose(T[:3, :3] @ se3.so3_exp(w * dt), T[:3, 3] + v * dt)
        poses.append(T)
    return np.array(poses)


def cloud(
    poses: Array, count: int, rng: np.random.Generator, near: float = 3.0, far: float = 12.0, rig: StereoRig = RIG
) -> Array:
    """`count` points (N, 3) in the world, each in view of a pose drawn from `poses`, between two depths [m]."""
    depth = rng.uniform(near, far, count)
    uv = rng.uniform((0, 0), (rig.width - 1, rig.height - 1), (count, 2))
    rays = np.concatenate([rig.left.normalise(uv), np.ones((count, 1))], axis=1) * depth[:, None]
    chosen = poses[rng.integers(len(poses), size=count)]
    return np.einsum("nij,nj->ni", chosen[:, :3, :3], rays) + chosen[:, :3, 3]


def observe(T: Array, points: Array, sigma: float, rng: np.random.Generator, limit: int = 30) -> Observations:
    """What the rig sees at pose `T` (4, 4): up to `limit` points in both images, the lowest ids, with noise [px]."""
    local = se3.transform(se3.inverse(T), points)
    left, right = RIG.project(local)
    seen = np.flatnonzero((local[:, 2] > 0.5) & RIG.left.in_image(left) & RIG.right.in_image(right))[:limit]
    noise = sigma * rng.standard_normal((2, len(seen), 2))
    return Observations(seen.astype(np.int64), left[seen] + noise[0], right[seen] + noise[1])


def scene(
    poses: Array, points: int = 200, sigma: float = 0.5, dt: float = 0.1, seed: int = 0, limit: int = 30
) -> Scene:
    """A scene along `poses` [(F, 4, 4)] with `points` points and pixel noise `sigma` [px]."""
    rng = np.random.default_rng(seed)
    world = cloud(poses, points, rng)
    observations = tuple(observe(T, world, sigma, rng, limit) for T in poses)
    return Scene(RIG, dt * np.arange(len(poses)), poses, world, observations)


def with_far_points(frames: int, speed: float) -> Scene:
    """A drive at a speed [m/s] past points at 5 to 40 m, and others at disparities below the noise of .7 px."""
    rng, poses = np.random.default_rng(0), path(frames, 0.1, np.array([0.0, 0.0, speed]), np.zeros(3))
    points = np.concatenate([cloud(poses, 900, rng, 5, 40), cloud(poses, 600, rng, 1000, 2000)])
    points = points[rng.permutation(1500)]
    return Scene(RIG, 0.1 * np.arange(frames), poses, points, tuple(observe(T, points, 0.7, rng, 60) for T in poses))


def begun_in_the_dark(seed: int) -> tuple[EstimatorModels, Array, list[Observations]]:
    """A map that begins where nobody knows how the camera is turned: two points, six seconds in the dark, then many.

    Returns the models, poses (160, 4, 4) .1 s apart, and what is seen from them.
    """
    rng, dt = np.random.default_rng(seed), 0.1
    turns = 0.3 * np.cumsum(rng.standard_normal((160, 3)), axis=0) * np.sqrt(dt)
    steps = dt * np.concatenate([0.5 * np.sin(turns), 0.3 * np.cos(turns)], axis=1)
    path = chained(se3.exp(steps[1:]))
    points = np.concatenate([cloud(path[:1], 2, rng), cloud(path[80:], 60, rng, 2.0, 6.0)])
    sights = []
    for k, T in enumerate(path):
        seen = observe(T, points, 4.0, rng, 12)
        sights.append(seen.select((seen.ids < 2) & (k < 10) if k < 70 else seen.ids >= 0))
    return EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=4.0), path, sights


def steps_off(found: list[Array], poses: Array) -> float:
    """By how much [m] motions over ten frames are off, from frame 90 on, root mean square."""
    moved = se3.inverse(np.array(found[90:-10])) @ np.array(found[100:])
    truth = se3.inverse(poses[90:-10]) @ poses[100:]
    return float(np.sqrt(((moved - truth)[:, :3, 3] ** 2).sum(axis=1).mean()))


def step(backend: Backend, stamp: float, seen: Observations, known: set[int]) -> UpdateReport:
    """One frame: predict, update with what is known, add what is new and has a depth; `known` grows."""
    backend.predict(stamp)
    old = np.array([i in known for i in seen.ids], bool)
    report = backend.update(seen.select(old))
    new = ~old & np.isfinite(RIG.triangulate(seen.uv_left, seen.uv_right)).all(axis=1)
    backend.add(seen.select(new))
    known.update(seen.ids[new].tolist())
    return report


def nees(backend: Backend, truth: Array) -> float:
    """Squared distance of the newest pose from the true one by its covariance: χ²₆ exceeds 25 once in 3000 times."""
    found = backend.estimate(landmarks=False)
    xi = se3.log(se3.inverse(found.T_world_left) @ truth)
    return float(xi @ np.linalg.solve(found.covariance, xi))


def forget(backend: Backend, known: set[int], seen: Observations) -> None:
    """Remove landmarks that are not in view; `known` shrinks."""
    gone = sorted(known - set(seen.ids.tolist()))
    backend.remove(gone)
    known.difference_update(gone)


def run(
    backend: Backend, data: Iterable[tuple[float, Array, Observations]], known: set[int] | None = None
) -> list[UpdateReport]:
    """Frames of a scene through a back end; `known` grows."""
    known = set() if known is None else known
    return [step(backend, stamp, seen, known) for stamp, _, seen in data]
