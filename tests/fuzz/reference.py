"""The slow and obviously right estimate: least squares over all poses and landmarks, derivatives by differences."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam.data import Observations
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread

Array = np.ndarray

_STEP = 1e-5  # of the differences [rad, m]
_ITERATIONS = 20


class Reference:
    """Everything that a back end was told, and what is most likely given that. For a rectified rig.

    Pixels are rows of a pose's number, a landmark's number, and uL, vL, uR; places are rows of a pose's number (-1 for
    one in the world), a landmark's number, a position (3), and the inverse of the root of its covariance (9).
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels) -> None:
        self.rig, self.models = rig, models
        self.stamps: list[float] = []
        self.poses: list[Array] = []  # where the search begins, T_world_left
        self.points: list[Array] = []  # the same for the landmarks, those that have left the map included
        self.known: dict[int, int] = {}  # number of the landmark of each id in the map
        self.pixels: list[Array] = []
        self.places: list[Array] = []

    def predict(self, stamp: float, near: Array) -> None:
        """A new pose, of constant velocity up to an impulse; the search begins at the pose `near` (4, 4)."""
        self.stamps.append(stamp)
        self.poses.append(near)

    def measure(self, seen: Observations) -> None:
        """Landmarks of the map, seen from the newest pose."""
        for i, left, right in zip(seen.ids.tolist(), seen.uv_left, seen.uv_right):
            self.pixels.append(np.array([len(self.poses) - 1, self.known[i], *left, right[0]]))

    def add(self, seen: Observations, near: Array) -> None:
        """New landmarks, seen for the first time; the search begins at `near` (N, 3) [m]."""
        self._join(seen.ids, near)
        self.measure(seen)

    def insert(self, ids: Array, positions: Array, covariances: Array) -> None:
        """New landmarks whose positions in the world are known."""
        self._join(ids, positions)
        self._place(-1, ids, positions, covariances)

    def place(self, ids: Array, local: Array, covariances: Array) -> None:
        """New landmarks whose positions before the newest camera are known."""
        T = self.poses[-1]
        self._join(ids, local @ T[:3, :3].T + T[:3, 3])
        self._place(len(self.poses) - 1, ids, local, covariances)

    def remove(self, ids: Array) -> None:
        """Landmarks leave the map; what they told about the poses stays known."""
        for i in ids.tolist():
            del self.known[i]

    @one_blas_thread
    def solve(self) -> tuple[Array, Array, Array, Array]:
        """The newest pose (4, 4) and its covariance (6, 6), and those of the map's landmarks by ascending id."""
        T, X, J = np.array(self.poses), np.array(self.points).reshape(-1, 3), np.zeros((0, 0))
        n = 6 * len(T)
        for _ in range(_ITERATIONS):
            steps = _STEP * np.eye(n + X.size)
            J = np.array([(self._residuals(*moved(T, X, d)) - self._residuals(*moved(T, X, -d))) for d in steps]).T
            J /= 2 * _STEP
            change = -np.linalg.lstsq(J, self._residuals(T, X), rcond=None)[0]
            T, X = moved(T, X, change)
            if np.abs(change).max() < 1e-7:
                break
        self.poses, self.points = list(T), list(X)
        root = np.linalg.inv(np.linalg.qr(J, mode="r"))
        P, rows = root @ root.T, [self.known[i] for i in sorted(self.known)]
        blocks = [P[n + 3 * row : n + 3 * row + 3, n + 3 * row : n + 3 * row + 3] for row in rows]
        return T[-1], P[n - 6 : n, n - 6 : n], X[rows], np.array(blocks).reshape(-1, 3, 3)

    def _join(self, ids: Array, near: Array) -> None:
        self.known.update(zip(ids.tolist(), range(len(self.points), len(self.points) + len(ids))))
        self.points.extend(near)

    def _place(self, pose: int, ids: Array, positions: Array, covariances: Array) -> None:
        roots = np.linalg.inv(np.linalg.cholesky(covariances))
        for i, position, root in zip(ids.tolist(), positions, roots):
            self.places.append(np.array([pose, self.known[i], *position, *root.ravel()]))

    def _residuals(self, T: Array, X: Array) -> Array:
        """Of everything that is known, in numbers of standard deviation one."""
        m, dt = self.models, np.diff(self.stamps)
        start = np.repeat([m.initial_rotation_sigma, m.initial_position_sigma], 3)
        variances = np.array([m.motion.velocity_variance(float(d)) for d in dt]).reshape(-1, 2)
        variances[:1] += np.square([m.initial_velocity_sigma, m.initial_angular_velocity_sigma])
        ways = np.concatenate([T[1:, :3, 3] - T[:-1, :3, 3], difference(T[:-1], T[1:])[:, :3]], axis=1)
        velocities = ways / dt[:, None]  # in the world, and the rate in the body's axes
        impulses = np.diff(velocities, axis=0, prepend=0) / np.sqrt(variances).repeat(3, axis=1)
        z = np.array(self.pixels).reshape(-1, 5)
        x, y, depth = _before(T[z[:, 0].astype(int)], X[z[:, 1].astype(int)]).T
        c, b = self.rig.left, self.rig.baseline
        uv = np.stack([c.fu * x / depth + c.u0, c.fv * y / depth + c.v0, c.fu * (x - b) / depth + c.u0], axis=1)
        off = ((uv - z[:, 2:]) / m.pixel_sigma)[np.isfinite(z[:, 2:])]
        p = np.array(self.places).reshape(-1, 14)
        of, at = p[:, :2].astype(int).T
        local = np.where(of[:, None] < 0, X[at], _before(T[of], X[at])) - p[:, 2:5]
        placed = np.einsum("nij,nj->ni", p[:, 5:].reshape(-1, 3, 3), local)
        parts = difference(m.initial_pose, T[0]) / start, impulses, off, placed
        return np.concatenate([part.ravel() for part in parts])


def difference(T: Array, other: Array) -> Array:
    """By how much poses (..., 4, 4) differ from others, in their own axes: turns and ways (..., 6)."""
    back = np.swapaxes(T[..., :3, :3], -1, -2)
    turns = Rotation.from_matrix(np.reshape(back @ other[..., :3, :3], (-1, 3, 3))).as_rotvec()
    ways = np.einsum("...ij,...j->...i", back, other[..., :3, 3] - T[..., :3, 3])
    return np.concatenate([turns.reshape(ways.shape), ways], axis=-1)


def moved(T: Array, X: Array, change: Array) -> tuple[Array, Array]:
    """Poses and points after a change, that of a pose in its own axes."""
    by_pose, out = change[: 6 * len(T)].reshape(-1, 6), T.copy()
    out[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(by_pose[:, :3]).as_matrix()
    out[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], by_pose[:, 3:])
    return out, X + change[6 * len(T) :].reshape(-1, 3)


def _before(T: Array, X: Array) -> Array:
    """Points (N, 3) in the camera coordinates of a pose each (N, 4, 4)."""
    return np.einsum("nji,nj->ni", T[:, :3, :3], X - T[:, :3, 3])
