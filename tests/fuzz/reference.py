"""The slow and obviously right estimate: least squares over all poses and landmarks, derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from slam.data import Observations
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread

Array = np.ndarray

_STEP = 1e-5  # of the differences [rad, m]
_ITERATIONS = 20


@dataclass(frozen=True)
class Term:
    """Something that is known of some poses and landmarks.

    Attributes:
        poses, points: numbers of those that it is about.
        residuals: a function of these poses (K, 4, 4) and points (M, 3) that gives numbers of standard deviation one.
    """

    poses: tuple[int, ...]
    points: tuple[int, ...]
    residuals: Callable[[Array, Array], Array]

    def linearised(self, T: Array, X: Array) -> tuple[Array, Array]:
        """Residuals, and their derivatives by a change of its poses, then of its points."""
        T, X = T[list(self.poses)], X[list(self.points)]
        columns = [
            (self.residuals(*moved(T, X, step)) - self.residuals(*moved(T, X, -step))) / (2 * _STEP)
            for step in _STEP * np.eye(6 * len(T) + 3 * len(X))
        ]
        return self.residuals(T, X), np.array(columns).T


@dataclass
class Reference:
    """Everything that a back end was told, and what is most likely given that. For a rectified rig.

    Attributes:
        rig, models: as the back end's.
        stamps: times (F) [s].
        poses: where the search begins, T_world_left (F).
        points: the same for the landmarks (N) [m], those that have left the map included.
        known: number of the landmark of each id in the map.
        terms: all that is known.
    """

    rig: StereoRig
    models: EstimatorModels
    stamps: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    points: list[Array] = field(default_factory=list)
    known: dict[int, int] = field(default_factory=dict)
    terms: list[Term] = field(default_factory=list)

    def predict(self, stamp: float, near: Array) -> None:
        """A new pose, of constant velocity up to an impulse; the search begins at the pose `near` (4, 4)."""
        m, k = self.models, len(self.stamps)
        self.stamps.append(stamp)
        self.poses.append(near)
        if k == 0:
            start = np.repeat([m.initial_rotation_sigma, m.initial_position_sigma], 3)
            self.terms.append(Term((0,), (), lambda T, X: difference(m.initial_pose, T[0]) / start))
            return
        steps = np.diff(self.stamps[-3:])
        variance = np.array(m.motion.velocity_variance(float(steps[-1])))
        if k == 1:
            variance += np.square([m.initial_velocity_sigma, m.initial_angular_velocity_sigma])
        sigma = np.repeat(np.sqrt(variance), 3)

        def impulse(T: Array, X: Array) -> Array:
            velocities = [_velocity(*pair) for pair in zip(T, T[1:], steps)]
            return (velocities[-1] - (velocities[0] if k > 1 else 0)) / sigma

        self.terms.append(Term(tuple(range(k + 1))[-3:], (), impulse))

    def measure(self, seen: Observations) -> None:
        """Landmarks of the map, seen from the newest pose."""
        for i, z in zip(seen.ids.tolist(), np.column_stack([seen.uv_left, seen.uv_right[:, 0]])):
            self._know(i, lambda T, X, z=z: ((self._pixels(T[0], X[0]) - z) / self.models.pixel_sigma)[np.isfinite(z)])

    def add(self, seen: Observations, near: Array) -> None:
        """New landmarks, seen for the first time; the search begins at `near` (N, 3) [m]."""
        self._join(seen.ids, near)
        self.measure(seen)

    def insert(self, ids: Array, positions: Array, covariances: Array) -> None:
        """New landmarks whose positions in the world are known."""
        self._join(ids, positions)
        for i, position, L in zip(ids.tolist(), positions, np.linalg.cholesky(covariances)):
            self._know(i, lambda T, X, at=position, L=L: np.linalg.solve(L, X[0] - at))

    def place(self, ids: Array, local: Array, covariances: Array) -> None:
        """New landmarks whose positions before the newest camera are known."""
        T = self.poses[-1]
        self._join(ids, local @ T[:3, :3].T + T[:3, 3])
        for i, h, L in zip(ids.tolist(), local, np.linalg.cholesky(covariances)):
            self._know(i, lambda T, X, h=h, L=L: np.linalg.solve(L, (X[0] - T[0, :3, 3]) @ T[0, :3, :3] - h))

    def remove(self, ids: Array) -> None:
        """Landmarks leave the map; what they told about the poses stays known."""
        for i in ids.tolist():
            del self.known[i]

    @one_blas_thread
    def solve(self) -> tuple[Array, Array, Array, Array]:
        """The newest pose (4, 4) and its covariance (6, 6), and those of the map's landmarks by ascending id."""
        T, X, J = np.array(self.poses), np.array(self.points).reshape(-1, 3), np.zeros((0, 0))
        for _ in range(_ITERATIONS):
            r, J = self._linearised(T, X)
            change = -np.linalg.lstsq(J, r, rcond=None)[0]
            T, X = moved(T, X, change)
            if np.abs(change).max() < 1e-7:
                break
        self.poses, self.points = list(T), list(X)
        root = np.linalg.inv(np.linalg.qr(J, mode="r"))
        P, rows = root @ root.T, [self.known[i] for i in sorted(self.known)]
        blocks = [P[np.ix_(s, s)] for s in (list(_columns(len(T), (), (row,))) for row in rows)]
        last = list(_columns(len(T), (len(T) - 1,), ()))
        return T[-1], P[np.ix_(last, last)], X[rows], np.array(blocks).reshape(-1, 3, 3)

    def _join(self, ids: Array, near: Array) -> None:
        self.known.update(zip(ids.tolist(), range(len(self.points), len(self.points) + len(ids))))
        self.points.extend(near)

    def _know(self, i: int, residuals: Callable[[Array, Array], Array]) -> None:
        """Something about the newest pose and a landmark."""
        self.terms.append(Term((len(self.stamps) - 1,) if self.stamps else (), (self.known[i],), residuals))

    def _pixels(self, T: Array, X: Array) -> Array:
        """uL, vL and uR of a point (3,)."""
        x, y, z = (X - T[:3, 3]) @ T[:3, :3]
        c, b = self.rig.left, float(np.linalg.norm(self.rig.b))
        return np.array([c.fu * x / z + c.u0, c.fv * y / z + c.v0, c.fu * (x - b) / z + c.u0])

    def _linearised(self, T: Array, X: Array) -> tuple[Array, Array]:
        """All residuals, and their derivatives by all that is sought."""
        residuals, rows = [], []
        for term in self.terms:
            r, J = term.linearised(T, X)
            row = np.zeros((len(r), 6 * len(T) + 3 * len(X)))
            row[:, list(_columns(len(T), term.poses, term.points))] = J
            residuals.append(r)
            rows.append(row)
        return np.concatenate(residuals), np.concatenate(rows)


def _columns(frames: int, poses: Iterable[int], points: Iterable[int]) -> Iterable[int]:
    """Of these poses and points in the derivatives by everything."""
    for k in poses:
        yield from range(6 * k, 6 * k + 6)
    for i in points:
        yield from range(6 * frames + 3 * i, 6 * frames + 3 * i + 3)


def difference(T: Array, other: Array) -> Array:
    """By how much a pose differs from another, in its own axes: a turn and a way (6,)."""
    turn = Rotation.from_matrix(T[:3, :3].T @ other[:3, :3]).as_rotvec()
    return np.concatenate([turn, T[:3, :3].T @ (other[:3, 3] - T[:3, 3])])


def moved(T: Array, X: Array, change: Array) -> tuple[Array, Array]:
    """Poses and points after a change, that of a pose in its own axes."""
    by_pose, out = change[: 6 * len(T)].reshape(-1, 6), T.copy()
    out[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(by_pose[:, :3]).as_matrix()
    out[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], by_pose[:, 3:])
    return out, X + change[6 * len(T) :].reshape(-1, 3)


def _velocity(T: Array, after: Array, dt: float) -> Array:
    """Velocity in the world and rate in the body's axes (6,)."""
    return np.concatenate([after[:3, 3] - T[:3, 3], difference(T, after)[:3]]) / dt
