"""Simulated rigid bodies before a moving camera, for the tests of their estimator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

import backends
from slam.bodies.belief import BodyBelief
from slam.bodies.estimator import FRAMES, BodyEstimator
from slam.data import Observations
from slam.evaluation.metrics import PathErrors, error_sizes, nees
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import EstimatorModels, MotionModel, models_for
from slam.object_data import ObjectEstimate, ObjectObservations
from slam.third_party import OnlinePose, recent_of
from tests.backends.scenes import cloud, random_path

SIGMA = 0.7
HANDHELD = StereoRig.rectified_pair(260.0, 159.5, 119.5, 0.12, 320, 240)
KITTI = StereoRig.rectified_pair(718.856, 607.19, 185.22, 0.54, 1241, 376)


@dataclass(frozen=True)
class BodyScene:
    """Truth of a drive past one body.

    Attributes:
        rig: the cameras.
        models: assumed by the estimators.
        dt: time between frames [s].
        camera: poses T_world_left (F, 4, 4), the first the identity.
        body: motion of the body (F, 4, 4) since frame 0, in world coordinates, the first the identity.
        points: of the body at frame 0, in world coordinates (P, 3).
        landmarks: of the still world (N, 3).
    """

    rig: StereoRig
    models: EstimatorModels
    dt: float
    camera: Array
    body: Array
    points: Array
    landmarks: Array

    @property
    def stamps(self) -> Array:
        """Times (F,) [s]."""
        return self.dt * np.arange(len(self.camera))

    def background(self, k: int, rng: np.random.Generator, limit: int = 60) -> Observations:
        """Landmarks in frame k."""
        uv, seen = self._seen(k, self.landmarks, rng)
        rows = np.flatnonzero(seen)[:limit]
        return Observations(rows.astype(np.int64), uv[rows, :2], uv[rows, 2:])

    def observations(self, k: int, rng: np.random.Generator, outliers: float = 0.0) -> ObjectObservations:
        """The body in frame k; a share of its points is measured elsewhere on it, or with a wrong right pixel."""
        points = se3.transform(self.body[k], self.points)
        uv, seen = self._seen(k, points, rng)
        bad = rng.random(len(uv)) < outliers
        offsets = rng.uniform(5, 30, (len(uv), 3)) * rng.choice([-1, 1], (len(uv), 3))
        uv[bad] += offsets[bad][:, [0, 1, 2, 1]]
        rows = np.flatnonzero(seen)
        T = se3.pose(np.eye(3), points.mean(axis=0))
        return ObjectObservations(7, rows + 1000, uv[rows, :2], uv[rows, 2:], T)

    def _seen(self, k: int, points: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Noisy (uL, vL, uR, vR) of points in frame k; on the right the row has the noise of the left one."""
        local = se3.transform(se3.inverse(self.camera[k]), points)
        left, right = self.rig.project(local)
        noise = SIGMA * rng.standard_normal((len(local), 3))
        seen = (local[:, 2] > 0.3) & self.rig.left.in_image(left) & self.rig.right.in_image(right)
        return np.concatenate([left, right], axis=1) + noise[:, [0, 1, 2, 1]], seen


def random_motion(
    frames: int, dt: float, start: Array, densities: tuple[float, float], rng: np.random.Generator, origin: Array
) -> Array:
    """Motion (F, 4, 4) in world coordinates of a body about its `origin`, whose velocities [ω, v] walk randomly."""
    T, velocity = se3.pose(np.eye(3), origin), np.array(start, float)
    back, out = se3.inverse(T), [np.eye(4)]
    sigma = np.sqrt(dt) * np.repeat([densities[1], densities[0]], 3)
    for _ in range(frames - 1):
        velocity = velocity + sigma * rng.standard_normal(6)
        T = se3.pose(se3.so3_exp(dt * velocity[:3]) @ T[:3, :3], T[:3, 3] + dt * velocity[3:])
        out.append(T @ back)
    return np.array(out)


def box_points(count: int, size: Array, centre: Array, rng: np.random.Generator) -> Array:
    """Points (P, 3) on the faces of a box."""
    unit = rng.uniform(-0.5, 0.5, (count, 3))
    face = rng.integers(3, size=count)
    unit[np.arange(count), face] = np.where(rng.random(count) < 0.5, -0.5, 0.5)
    return centre + unit * size


def box_scene(
    seed: int = 0, frames: int = 30, moving: bool = True, distance: float = 1.0, points: int = 25,
    body: Array | None = None, still: bool = False,
) -> BodyScene:  # fmt: skip
    """A box of 0.3 m before a hand-held camera at 30 Hz."""
    rng = np.random.default_rng([seed, 5])
    models, dt, centre = replace(models_for("handheld"), pixel_sigma=SIGMA), 1 / 30, np.array([0.0, 0.0, distance])
    motion = MotionModel(0.1, 0.1)
    camera = (
        random_path(frames, dt, np.array([0.1, 0.02, 0.0]), motion, rng, 0.9)
        if moving
        else np.tile(np.eye(4), (frames, 1, 1))
    )
    o = models.objects
    start = np.concatenate([0.3 * rng.standard_normal(3), 0.1 * rng.standard_normal(3)])
    if body is None:
        body = random_motion(frames, dt, start, (0.3 * o.acceleration, 0.3 * o.angular_acceleration), rng, centre)
    if still:
        body = np.tile(np.eye(4), (frames, 1, 1))
    shape = box_points(points, np.full(3, 0.3), centre, rng)
    return BodyScene(HANDHELD, models, dt, camera, body, shape, cloud(camera, 120, rng, 1.0, 4.0, HANDHELD))


def car_scene(seed: int = 0, frames: int = 30, distance: float = 15.0, points: int = 30) -> BodyScene:
    """A car ahead of a driving one at 10 Hz, both at 8 m/s or so."""
    rng = np.random.default_rng([seed, 6])
    models, dt, centre = replace(models_for("driving"), pixel_sigma=SIGMA), 0.1, np.array([1.0, 0.5, distance])
    camera = random_path(frames, dt, np.array([0, 0, 8.0]), MotionModel(0.5, 0.05), rng, 0.9)
    o = models.objects
    start = np.array([0, 0, 0, 0, 0, 8.0])
    body = random_motion(frames, dt, start, (o.acceleration, o.angular_acceleration), rng, centre)
    shape = box_points(points, np.array([1.7, 1.4, 4.0]), centre, rng)
    return BodyScene(KITTI, models, dt, camera, body, shape, cloud(camera, 250, rng, 5.0, 50.0, KITTI))


Rule = Callable[[int, ObjectObservations], "ObjectObservations | None"]


def follow(
    name: str, scene: BodyScene, seed: int = 0, rule: Rule | None = None, outliers: float = 0.0
) -> Iterator[tuple[int, BodyBelief, Array]]:
    """Run a scene through a back end, and the body's estimator beside it; frame, belief and camera's estimated pose.

    `rule` may change what is observed of the body in a frame, or take it away (None).
    """
    backend, estimator = backends.create(name, scene.rig, models=scene.models), BodyEstimator(scene.rig, scene.models)
    rng, known, belief, path = np.random.default_rng([seed, 7]), set(), None, []
    for k, stamp in enumerate(scene.stamps):
        backend.predict(float(stamp))
        seen = scene.background(k, rng)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        backend.update(seen.select(old))
        local = scene.rig.triangulate(seen.uv_left, seen.uv_right)
        deep, e = np.isfinite(local).all(axis=1), backend.estimate(landmarks=False)
        path = [*path[-FRAMES:], OnlinePose(scene.rig, SIGMA, e, local[old & deep])]
        given = scene.observations(k, rng, outliers if k else 0.0)
        given = given if rule is None else rule(k, given)
        belief = estimator.updated(belief, 7, given, recent_of(backend, path))
        if belief is not None:
            yield k, belief, e.T_world_left
        backend.add(seen.select(~old & deep))
        known.update(seen.ids[~old & deep].tolist())


@dataclass(frozen=True)
class Outcome:
    """A body's estimates against the truth, a row a frame after the first.

    Attributes:
        pose: error of the pose; its frame was put before the true camera at first sight.
        motion: error of the motion since the frame before (ME).
        pose_nees, velocity_nees: (F,).
        estimates: all of them.
    """

    pose: PathErrors
    motion: PathErrors
    pose_nees: Array
    velocity_nees: Array
    estimates: list[ObjectEstimate]


def score(scene: BodyScene, found: list[tuple[int, BodyBelief, Array]]) -> Outcome:
    """Judge the estimates of one body, the first of which is that of its first sight."""
    frames, estimates = [k for k, _, _ in found], [belief.estimate for _, belief, _ in found]
    own = np.array([e.T_world_object for e in estimates])
    body, camera = scene.body[frames], scene.camera[frames[0]]
    true = body @ se3.inverse(body[0]) @ camera @ se3.inverse(found[0][2]) @ own[0]
    rates = np.array([e.velocity for e in estimates[1:]])
    E, steps = se3.inverse(own[1:]) @ true[1:], [se3.inverse(T[:-1]) @ T[1:] for T in (own, true)]
    turns = se3.so3_log(true[1:, :3, :3] @ np.swapaxes(true[:-1, :3, :3], 1, 2))
    moved = np.concatenate([turns, np.diff(true[:, :3, 3], axis=0)], axis=1)
    velocities = moved / np.diff(scene.stamps[frames])[:, None]
    return Outcome(
        error_sizes(E), error_sizes(se3.inverse(steps[0]) @ steps[1]),
        nees(se3.log(E), np.array([e.covariance for e in estimates[1:]])),
        nees(velocities - rates, np.array([e.velocity_covariance for e in estimates[1:]])),
        estimates,
    )  # fmt: skip
