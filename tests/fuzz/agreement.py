"""Sequences of calls that make sense, given to a back end and to a slow estimator that is obviously right."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import backends
from slam.data import Observations, UpdateStatus
from slam.errors import SlamError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import pose
from slam.models import EstimatorModels, MotionModel
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.mutations import choose
from tests.fuzz.reference import Array, Reference, difference

RIG = StereoRig.rectified_pair(400, 319.5, 239.5, 0.3, 640, 480)
MODELS = EstimatorModels(
    MotionModel(acceleration=0.2, angular_acceleration=0.05),
    pixel_sigma=0.3,
    initial_velocity_sigma=0.1,
    initial_angular_velocity_sigma=0.03,
)

#: By how much an estimate may differ from the reference's: in the reference's standard deviations, for each of the
#: numbers of a pose or a point, and by a factor of the variance in any direction. A filter linearises once. The
#: smoother is none of them: landmarks that are first seen in a frame without a measurement, which is no pose of its
#: graph, count for less there (`tests/backends/test_all_backends.py` compares it where every frame is measured).
TOLERANCES = {"ekf": (0.5, 1.4), "window": (0.05, 1.4), "batch": (0.05, 1.4)}


class Play:
    """A camera among points, a back end, and the reference beside it."""

    def __init__(self, rng: np.random.Generator, backend: Any) -> None:
        self.rng, self.backend = rng, backend
        self.reference = Reference(RIG, MODELS)
        self.points = np.column_stack([rng.uniform(-2, 2, 24), rng.uniform(-1.5, 1.5, 24), rng.uniform(2.5, 6, 24)])
        self.of: dict[int, int] = {}  # which point each landmark of the map is
        self.T, self.velocity = np.eye(4), np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, 0.03, 3)])
        self.stamp = 0.0
        self.next_id = 0

    def predict(self) -> None:
        """The camera moves on, and the back end hears when."""
        first = not self.reference.stamps
        dt = float(choose(self.rng, (0.05, 0.1, 0.1, 0.2)))
        if not first:
            sigma = np.sqrt(MODELS.motion.velocity_variance(dt)).repeat(3)
            self.velocity = self.velocity + sigma * self.rng.standard_normal(6)
            turn = Rotation.from_rotvec(self.velocity[3:] * dt).as_matrix()
            self.T = pose(self.T[:3, :3] @ turn, self.T[:3, 3] + self.velocity[:3] * dt)
            self.stamp += dt
        prediction = self.backend.predict(self.stamp)
        self.reference.predict(self.stamp, self.T)
        if not set(prediction.ids.tolist()) <= set(self.of):
            raise Broken("a prediction has landmarks that are not in the map")

    def update(self) -> None:
        """Some landmarks are seen; to ask for the path before must not change anything."""
        if self.rng.random() < 0.3:
            self.backend.trajectory()
        ids = self._some(sorted(self.of), least=8)
        seen = self._see(ids, [self.of[i] for i in ids.tolist()], one_eyed=0.2)
        report = self.backend.update(seen)
        if set(report.used) & set(report.rejected) or set(report.used) | set(report.rejected) != set(seen.ids):
            raise Broken("what was used and what was rejected is not what was seen")
        expected = UpdateStatus.OK if len(report.used) else UpdateStatus.EMPTY
        if report.status is not expected:
            raise Broken(f"an update of {len(seen)} landmarks is {report.status}, not {expected}")
        rows = np.isin(seen.ids, report.used)
        if len(seen) - rows.sum() > 1 + 0.1 * len(seen):
            raise Broken(f"{len(seen) - rows.sum()} of {len(seen)} good observations are rejected")
        self.reference.measure(seen.select(rows))

    def add(self, least: int = 0) -> None:
        """Points that are none yet become landmarks, some under an id that another one had before."""
        points = self._some(sorted(set(range(len(self.points))) - set(self.of.values())), least + 8, least)
        ids = self._new_ids(len(points))
        seen = self._see(ids, points.tolist())
        rows = np.flatnonzero(np.isin(ids, seen.ids))
        self.backend.add(seen)
        self.reference.add(seen, self.points[points[rows]])
        self.of.update(zip(seen.ids.tolist(), points[rows].tolist()))

    def insert(self, local: bool = False) -> None:
        """Landmarks whose place is known from elsewhere, in the world or before the camera."""
        points = self._some(sorted(set(range(len(self.points))) - set(self.of.values())), 3)
        ids = self._new_ids(len(points))
        roots = 0.02 * self.rng.standard_normal((len(points), 3, 3)) + 0.03 * np.eye(3)
        covariances = roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)
        noise = np.linalg.cholesky(covariances) @ self.rng.standard_normal((len(points), 3, 1))
        at = (self.points[points] - self.T[:3, 3]) @ self.T[:3, :3] if local else self.points[points]
        for one in (self.backend, self.reference):
            (one.place if local else one.insert)(ids, at + noise[..., 0], covariances)
        self.of.update(zip(ids.tolist(), points.tolist()))

    def remove(self) -> None:
        """Some landmarks leave."""
        ids = self._some(sorted(self.of), max(0, min(4, len(self.of) - 8)))
        for one in (self.backend, self.reference):
            one.remove(ids)
        self.of = {i: point for i, point in self.of.items() if i not in ids}

    def count(self) -> None:
        """What the map holds, exactly."""
        path = self.backend.trajectory()
        estimate = self.backend.estimate()
        ids = np.array(sorted(self.of), np.int64)
        shapes = [estimate.positions.shape, estimate.covariances.shape, estimate.covariance.shape]
        if not np.array_equal(estimate.ids, ids) or shapes != [(len(ids), 3), (len(ids), 3, 3), (6, 6)]:
            raise Broken(f"the map has {shapes[0][0]} landmarks, {len(ids)} were given")
        if estimate.stamp != self.stamp or not np.array_equal(path.stamps, self.reference.stamps):
            raise Broken("the stamps are not those that were given")
        shuffled = self.rng.permutation(ids)
        if not np.array_equal(
            self.backend.positions(shuffled), self.backend.positions(ids)[np.searchsorted(ids, shuffled)]
        ):
            raise Broken("positions are not in the order of their ids")

    def compare(self, deviations: float, ratio: float) -> None:
        """The estimate and its covariance with the reference's."""
        estimate = self.backend.estimate()
        T, P, X, covariances = self.reference.solve()
        _alike("the pose", difference(T, estimate.T_world_left), estimate.covariance, P, deviations, ratio)
        for row, i in enumerate(estimate.ids.tolist()):
            change = estimate.positions[row] - X[row]
            _alike(f"landmark {i}", change, estimate.covariances[row], covariances[row], deviations, ratio)

    def _some(self, pool: list[int], most: int = 20, least: int = 0) -> Array:
        low, high = min(len(pool), least), min(len(pool), most)
        count = int(self.rng.integers(low, high + 1))
        return np.sort(self.rng.permutation(np.array(pool, np.int64))[:count])

    def _new_ids(self, count: int) -> Array:
        gone = np.array(sorted(set(range(self.next_id)) - set(self.of)), np.int64)
        again = self.rng.permutation(gone)[: int(self.rng.integers(count + 1))] if len(gone) else gone
        fresh = np.arange(self.next_id, self.next_id + count - len(again))
        self.next_id += len(fresh)
        return np.concatenate([again, fresh])

    def _see(self, ids: Array, points: list[int], one_eyed: float = 0.0) -> Observations:
        """What is in both images, with noise; some without a right pixel."""
        left, right = RIG.project((self.points[points].reshape(-1, 3) - self.T[:3, 3]) @ self.T[:3, :3])
        rows = np.flatnonzero(RIG.left.in_image(left) & RIG.right.in_image(right))
        noise = MODELS.pixel_sigma * self.rng.standard_normal((len(rows), 3))
        left, right = left[rows] + noise[:, :2], right[rows] + noise[:, [2, 1]]
        right[self.rng.random(len(rows)) < one_eyed] = np.nan
        return Observations(ids[rows], left, right)


def _alike(what: str, change: Array, P: Array, expected: Array, deviations: float, ratio: float) -> None:
    """Raise where an estimate differs from the reference's by more than linearisation permits."""
    off = float(np.sqrt(change @ np.linalg.solve(expected, change)))
    if not off <= deviations * np.sqrt(len(change)):
        raise Broken(f"{what} is {off:.3f} standard deviations from the most likely one")
    L = np.linalg.cholesky(expected)
    ratios = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, P).T))
    if ratios[0] < 1 / ratio or ratios[-1] > ratio:
        raise Broken(f"the covariance of {what} is {ratios[0]:.3f} to {ratios[-1]:.3f} of the right one")


def agree(rng: np.random.Generator, backend: Any, tolerance: tuple[float, float]) -> None:
    """A sequence of calls, counted after each and compared twice; none of them may be refused."""
    play = Play(rng, backend)
    calls = int(rng.integers(4, 14))
    half = int(rng.integers(2, calls))
    try:
        play.predict()
        play.add(least=10)
        for number in range(calls):
            kind = int(rng.integers(12))
            if kind <= 7:
                play.predict()
            if kind < 7:
                play.update()
            if kind < 7 or kind == 8:
                play.add()
            elif kind == 9:
                play.remove()
            elif kind > 9:
                play.insert(local=kind == 10)
            play.count()
            if number == half:
                play.compare(*tolerance)
        play.compare(*tolerance)
    except SlamError as error:
        raise Broken(f"good data are refused: {error}") from error


def answers(name: str, rng: np.random.Generator, folder: Path) -> None:
    """Those of a back end: ids, counts and stamps exact; pose, landmarks and covariances of dense least squares."""
    agree(rng, backends.create(name, RIG, models=MODELS), TOLERANCES[name])


SUBJECTS = tuple(Subject(f"answers of {name}", partial(answers, name), short=2) for name in TOLERANCES)
