"""What the checks of the contract share: a small scene, a back end on its way through it, and assertions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slam.data import BoolArray, IdArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.interfaces import Backend
from slam.models import EstimatorModels

Factory = Callable[..., Backend]

RIG = StereoRig.rectified_pair(f=400.0, u0=319.5, v0=239.5, baseline=0.2, width=640, height=480)

SIGMA = 0.5  # pixel noise [px]
MODELS = EstimatorModels(pixel_sigma=SIGMA)
DT = 0.1
_POSITION, _ROTATION = 0.05, 0.01  # largest pose errors on the scene [m], [rad]
NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera that flies slowly through points, with noisy observations of all of them that are in view."""

    poses: Array
    points: Array
    frames: tuple[Observations, ...]


def make_scene(count: int = 15) -> Scene:
    """A scene of 60 points, with so many frames."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-4, -3, 4), (4, 3, 12), (60, 3))
    step = se3.exp(DT * np.array([0.02, 0.1, -0.05, 0.2, -0.1, 0.5]))
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    frames = tuple(observe(RIG, T, points, rng) for T in poses)
    return Scene(np.array(poses), points, frames)


def observe(rig: StereoRig, T: Array, points: Array, rng: np.random.Generator) -> Observations:
    """What the rig sees of points (N, 3) from the pose T (4, 4), with noise."""
    left, right = rig.project(se3.transform(se3.inverse(T), points))
    seen = np.flatnonzero(rig.left.in_image(left) & rig.right.in_image(right))
    noise = SIGMA * rng.standard_normal((2, len(seen), 2))
    return Observations(seen.astype(np.int64), left[seen] + noise[0], right[seen] + noise[1])


def point(number: int) -> Array:
    """Position of a landmark [m] by its number."""
    return np.random.default_rng(number).uniform((-3, -2, 4), (3, 2, 12))


def cloud(ids: ArrayLike, positions: ArrayLike | None = None, variance: float = 0.01) -> tuple[IdArray, Array, Array]:
    """Landmarks at positions (N, 3) [m], else in front of the first camera, with covariances (N, 3, 3)."""
    ids = np.asarray(ids, np.int64)
    points = np.array([point(i) for i in ids.tolist()] if positions is None else positions, float).reshape(-1, 3)
    return ids, points, variance * np.tile(np.eye(3), (len(ids), 1, 1))


class Run:
    """A back end on its way through frames; it remembers which landmarks it has added."""

    def __init__(self, factory: Factory, rig: StereoRig = RIG, models: EstimatorModels = MODELS) -> None:
        self.backend: Backend = factory(rig, models=models)
        self.in_backend: set[int] = set()

    def step(
        self, k: int, seen: Observations, between: Callable[[Backend], None] | None = None
    ) -> tuple[Prediction, UpdateReport]:
        """Frame k: predict, update with what the map has, add the rest; `between` is called before the update."""
        prediction = self.backend.predict(DT * k)
        if between is not None:
            between(self.backend)
        old = self.in_map(seen)
        report = self.backend.update(seen.select(old))
        self.backend.add(seen.select(~old))
        self.in_backend.update(seen.ids.tolist())
        return prediction, report

    def in_map(self, seen: Observations) -> BoolArray:
        """Which observations (M,) are of landmarks that the map has."""
        return np.array([i in self.in_backend for i in seen.ids.tolist()], bool)


def tracked(factory: Factory, scene: Scene, models: EstimatorModels = MODELS) -> tuple[Run, list[UpdateReport]]:
    """A back end after all frames of a scene, and its reports."""
    run = Run(factory, models=models)
    return run, [run.step(k, seen)[1] for k, seen in enumerate(scene.frames)]


def all_but_the_last(factory: Factory, scene: Scene) -> tuple[Backend, Observations]:
    """A back end with the last frame predicted but not measured, and what it sees there of its map."""
    run, _ = tracked(factory, replace(scene, frames=scene.frames[:-1]))
    run.backend.predict(DT * (len(scene.frames) - 1))
    last = scene.frames[-1]
    return run.backend, last.select(run.in_map(last))


def started(factory: Factory) -> tuple[Backend, Observations]:
    """A back end that has seen one frame, and what it saw."""
    run, scene = Run(factory), make_scene(1)
    run.step(0, scene.frames[0])
    return run.backend, scene.frames[0]


def raises(error: type[Exception], call: Callable[..., Any], *args: Any, what: str, **kwargs: Any) -> None:
    """Fail unless the call raises the error."""
    try:
        call(*args, **kwargs)
    except error:
        return
    raise AssertionError(f"{what}: was accepted, {error.__name__} is expected")


def require(holds: bool | np.bool_, sentence: str) -> None:
    """Fail with a sentence unless something holds."""
    if not holds:
        raise AssertionError(sentence)


def require_status(report: UpdateReport, expected: UpdateStatus, what: str) -> None:
    """Fail unless an update ended as expected; `what` is the update's description."""
    require(report.status is expected, f"status of {what}: {report.status!s} {report.reason!r}, not {expected.value}")


def require_same(value: ArrayLike, expected: ArrayLike, what: str, tolerance: float = 0.0) -> None:
    """Fail unless two arrays have one shape and differ by no more than `tolerance`."""
    a, b = np.asarray(value), np.asarray(expected)
    require(a.shape == b.shape, f"{what}: shape {a.shape}, {b.shape} expected")
    if a.size and tolerance:
        off = float(np.abs(a - b).max())
        require(off <= tolerance, f"{what}: off by {off:.3g}, at most {tolerance:.3g} allowed")
    elif a.size:
        require(bool((a == b).all()), f"{what}: {_few(a[a != b])} where {_few(b[a != b])} is expected")


def require_equal(one: Any, other: Any, what: str) -> None:
    """Fail unless two results have the same attributes, to the last bit."""
    for name, value in vars(other).items():
        a, b = np.asarray(getattr(one, name)), np.asarray(value)
        same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        require(same, f"{what}: {name} differs")


def _few(values: Array) -> str:
    return ", ".join(f"{value:.6g}" for value in values.ravel()[:3]) + (", …" if values.size > 3 else "")


def assert_covariance(P: Array, shape: tuple[int, ...], what: str) -> None:
    """Fail unless P is finite, of that shape, symmetric and positive definite (or nearly)."""
    require(P.shape == shape, f"{what}: covariance of shape {P.shape}, {shape} expected")
    require(np.isfinite(P).all(), f"{what}: the covariance is not finite")
    scale = np.abs(P).max(initial=0.0)
    require(np.abs(P - np.swapaxes(P, -1, -2)).max(initial=0.0) <= 1e-9 * scale, f"{what}: covariance is not symmetric")
    definite = not len(P) or (np.linalg.eigvalsh(P).min() > -1e-9 * scale and P.diagonal(0, -2, -1).min() > 0)
    require(definite, f"{what}: covariance is singular, or not positive definite")


def assert_near(T: Array, truth: Array, what: str, factor: float = 1.0) -> None:
    """Fail unless a pose is near the true one."""
    error = se3.log(se3.inverse(truth) @ T)
    turned, shifted = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    near = shifted < factor * _POSITION and turned < factor * _ROTATION
    require(near, f"{what}: off by {shifted:.3g} m, {turned:.3g} rad")
