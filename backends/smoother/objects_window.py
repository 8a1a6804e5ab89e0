"""The recent past of one body: its poses in the last frames and its points, estimated together.

A fixed-lag smoother. All that is in the window is relinearised in every frame; what leaves it (the oldest frame's
poses and measurements) is marginalised into a prior on the rest. The points stay, so a body seen for long does not
drift. The camera's poses in the window are unknowns too, with the joint covariance that the smoother's own graph has
for them as their prior; where a frame leaves, its camera pose leaves with what the later ones say of it, so that
nothing is known twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from backends.smoother import objects_kernels as kernels
from backends.smoother.objects_factors import System, VelocityPrior, add_measurements, add_motion, velocities
from backends.smoother.objects_kernels import FRAME
from slam.data import BoolArray, IdArray, IndexArray
from slam.geometry.pose_kernels import moved
from slam.geometry.se3 import Array, hat, inverse, transform
from slam.object_models import ObjectModels
from slam.objects.points import Shape, drift
from slam.window.stereo import RectifiedStereo

_EXACT = 1e-12 * np.eye(6)  # [rad², m²]
_TURN = 0.01  # a point is seen from elsewhere by no less [rad]; what is less adds up
_LINEAR = 0.01  # cost: a turn by less [rad] changes no derivative by much; the next frame relinearises in any case


@dataclass(frozen=True, eq=False)
class CameraWindow:
    """The camera's poses in the frames of a window.

    Attributes:
        poses: T_world_left (n, 4, 4).
        covariance: joint (6 n, 6 n), right perturbations.
    """

    poses: Array
    covariance: Array

    @cached_property
    def information(self) -> Array:
        """The inverse of the covariance."""
        return np.linalg.inv(self.covariance)

    def given_later(self, count: int) -> Array:
        """Information (6 n, 6 n) of the `count` oldest poses given the later ones: all poses' less the later ones' own.

        It is a Schur complement: a difference of two inverses is not positive where poses share a large error.
        """
        old, later = slice(0, 6 * count), slice(6 * count, None)
        conditional = self.information.copy()
        conditional[later, later] = conditional[later, old] @ np.linalg.solve(
            conditional[old, old], conditional[old, later]
        )
        return conditional


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of a window's unknowns besides its measurements: a quadratic about fixed values.

    Attributes:
        system: information and vector over all unknowns.
        T, X, points: where it was linearised: body poses (n, 4, 4), camera poses (n, 4, 4), points (p, 3).
    """

    system: System
    T: Array
    X: Array
    points: Array


@dataclass(frozen=True, eq=False)
class Window:
    """One body in the last n frames.

    Attributes:
        frames: of the smoother's path (n,), ascending.
        stamps: their times (n,) [s].
        T: poses T_world_object (n, 4, 4).
        scales: factors (n,) on the impulse before each.
        z: measurements (n, p, 3) of the rectified rig, NaN where there is none.
        ids: of the points (p,).
        points: in body coordinates (p, 3).
        failures: how often running each point's observation was rejected (p,).
        unseen: number of frames since each point was last observed (p,).
        sights: in how many frames each point was used (p,).
        since: frames in which each was seen first (p,), and
        first_seen_from: where in the body the camera was then (p, 3).
        turned: largest angle between that direction and later ones (p,) [rad].
        first_velocity: what was known beforehand of the velocity in the frame of the first sight; None once that has
            left the window.
        prior: of what has left.
        covariance: of all unknowns (12 n + 3 p, 12 n + 3 p) after the last solution, zero for those new since.
    """

    frames: IndexArray
    stamps: Array
    T: Array
    scales: Array
    z: Array
    ids: IdArray
    points: Array
    failures: IdArray
    unseen: IdArray
    sights: IdArray
    since: IndexArray
    first_seen_from: Array
    turned: Array
    first_velocity: VelocityPrior | None
    prior: Prior
    covariance: Array

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def first_point(self) -> int:
        """Where the points' unknowns begin."""
        return FRAME * len(self.frames)

    @cached_property
    def motion(self) -> tuple[Array, Array]:
        """Velocity [ω, v] (6,) in the newest step, and its covariance (6, 6); of a first frame what is expected."""
        if len(self) == 1 and self.first_velocity is not None:
            return self.first_velocity.mean, np.diag(self.first_velocity.sigmas**2)
        last = FRAME * (len(self) - 1)
        (velocity,), (before,), (after,) = velocities(self.T[-2:], self.stamps[-2:])
        mine = np.concatenate([np.arange(last - FRAME, last - FRAME + 6), np.arange(last, last + 6)])
        J = np.concatenate([before, after], axis=1)
        return velocity, J @ self.covariance[np.ix_(mine, mine)] @ J.T

    def point_covariances(self) -> Array:
        """Covariances (p, 3, 3) of the points."""
        rows = self.first_point + np.arange(3 * len(self.ids)).reshape(-1, 3)
        return np.asarray(self.covariance[rows[:, :, None], rows[:, None, :]])


def opened(
    frame: int, stamp: float, T: Array, X: Array, first_velocity: VelocityPrior, covariance: Array = _EXACT
) -> Window:  # fmt: skip
    """A window with one frame and no points yet.

    At its first sight the body's frame is put there: its pose has no error, by definition.
    """
    system = System.empty(FRAME)
    system.information[:6, :6] = np.linalg.inv(covariance)
    none = np.zeros(0, np.int64)
    points = np.zeros((0, 3))
    return Window(
        np.array([frame]), np.array([stamp]), T[None], np.ones(1), np.zeros((1, 0, 3)), none, points,
        none, none, none, none, points, np.zeros(0), first_velocity, Prior(system, T[None], X[None], points),
        np.zeros((FRAME, FRAME)),
    )  # fmt: skip


def with_frame(window: Window, frame: int, stamp: float, T: Array, X: Array, scale: float) -> Window:
    """With one more frame, in which nothing has been measured yet."""
    first, p = window.first_point, window.prior
    prior = Prior(_widened(p.system, first, FRAME), _append(p.T, T), _append(p.X, X), p.points)
    return replace(
        window,
        frames=np.append(window.frames, frame),
        stamps=np.append(window.stamps, stamp),
        T=_append(window.T, T),
        scales=np.append(window.scales, scale),
        z=_append(window.z, np.full(window.z.shape[1:], np.nan)),
        unseen=window.unseen + 1,
        prior=prior,
        covariance=_with_zeros(window.covariance, first, FRAME),
    )


def with_points(window: Window, ids: IdArray, points: Array, shape: Shape, z: Array) -> Window:
    """With new points (M, 3), measured z (M, 3) in the newest frame.

    Of each it is known that it belongs to the body: a Gaussian in the coordinates of the newest camera. Were it one in
    body coordinates, every new point would say where the body is, though the shape is but what the body's own points
    have shown.
    """
    if not len(ids):
        return window
    p, count, last = window.prior, len(ids), FRAME * (len(window) - 1)
    size = len(p.system.vector)
    system = _widened(p.system, size, 3 * count)
    Y = inverse(p.X[-1]) @ p.T[-1]
    R, h = Y[:3, :3], transform(Y, points)
    J = np.zeros((count, 3, FRAME + 3))
    J[:, :, :3], J[:, :, 3:6], J[:, :, 6:9] = -R @ hat(points), R, hat(h)
    J[:, :, 9:12], J[:, :, 12:] = -np.eye(3), R
    weighted = np.swapaxes(J, 1, 2) @ np.linalg.inv(shape.covariance)
    for i, (H, g) in enumerate(zip(weighted @ J, (weighted @ (shape.mean - h)[:, :, None])[:, :, 0])):
        unknowns = np.concatenate([last + np.arange(FRAME), size + 3 * i + np.arange(3)])
        system.information[np.ix_(unknowns, unknowns)] += H
        system.vector[unknowns] += g
    measured = np.full((len(window), count, 3), np.nan)
    measured[-1] = z
    return replace(
        window,
        z=np.concatenate([window.z, measured], axis=1),
        ids=np.concatenate([window.ids, ids]),
        points=np.concatenate([window.points, points]),
        failures=np.concatenate([window.failures, np.zeros(count, np.int64)]),
        unseen=np.concatenate([window.unseen, np.zeros(count, np.int64)]),
        sights=np.concatenate([window.sights, np.ones(count, np.int64)]),
        since=np.concatenate([window.since, np.full(count, window.frames[-1])]),
        first_seen_from=np.concatenate([window.first_seen_from, np.tile(inverse(Y)[:3, 3], (count, 1))]),
        turned=np.concatenate([window.turned, np.zeros(count)]),
        prior=replace(p, system=system, points=np.concatenate([p.points, points])),
        covariance=_with_zeros(window.covariance, size, 3 * count),
    )


def drifted(window: Window, T_body_left: Array, density: float) -> Window:
    """With points less certain across the line of sight, where they are seen from farther round than ever before.

    What the window itself has measured is left as it is.

    Args:
        window: with a frame for the present.
        T_body_left: the camera's pose in the body (4, 4).
        density: of the random walk of a point's direction with the angle from which it is seen [rad / √rad].
    """
    turned, lateral = drift(window.points, window.first_seen_from, T_body_left[:3, 3], window.turned, density)
    rows = np.flatnonzero((window.since < window.frames[0]) & (turned > window.turned + _TURN))
    if not (len(rows) and density):
        return window
    out = window.turned.copy()
    out[rows] = turned[rows]
    unknowns = window.first_point + (3 * rows[:, None] + np.arange(3)).reshape(-1)
    system = window.prior.system.diffused(unknowns, lateral[rows])
    return replace(window, prior=replace(window.prior, system=system), turned=out)


def without_points(window: Window, gone: BoolArray) -> Window:
    """Without some points (mask (p,)): what has left the window of them is marginalised, the rest is forgotten."""
    if not gone.any():
        return window
    is_gone = np.concatenate([np.zeros(window.first_point, bool), np.repeat(gone, 3)])
    rows, kept = np.flatnonzero(is_gone), np.flatnonzero(~is_gone)
    prior = replace(window.prior, system=window.prior.system.eliminated(rows), points=window.prior.points[~gone])
    return replace(
        window,
        z=window.z[:, ~gone],
        ids=window.ids[~gone],
        points=window.points[~gone],
        failures=window.failures[~gone],
        unseen=window.unseen[~gone],
        sights=window.sights[~gone],
        since=window.since[~gone],
        first_seen_from=window.first_seen_from[~gone],
        turned=window.turned[~gone],
        prior=prior,
        covariance=window.covariance[kept[:, None], kept],
    )


class Solver:
    """Solves windows of one rig.

    Args:
        stereo: the projection.
        sigma: pixel noise in the rectified rig [px].
        models: how bodies move.
        iterations: most linearisations.
    """

    def __init__(self, stereo: RectifiedStereo, sigma: float, models: ObjectModels, iterations: int) -> None:
        self._stereo = stereo
        self._sigma = sigma
        self._models = models
        self._iterations = iterations

    def solved(self, window: Window, camera: CameraWindow) -> Window:
        """The window at its optimum, with covariances.

        Raises:
            LinAlgError: the equations are singular, or the solution is not finite.
        """
        n = len(window)
        is_camera, C = _cameras(n), camera.information
        c, now = np.zeros(6 * n), window
        for _ in range(self._iterations):
            system = self._system(now, moved(camera.poses, c.reshape(n, 6)), n, range(n - 1))
            system.information[np.ix_(is_camera, is_camera)] += C
            system.vector[is_camera] -= C @ c
            L, failed = dpotrf(
                system.information.T, lower=1, overwrite_a=1
            )  # symmetric, and transposed in the order LAPACK wants
            if failed:
                raise np.linalg.LinAlgError("the window's equations are singular")
            step = dpotrs(L, system.vector, lower=1)[0]
            frames = step[: FRAME * n].reshape(n, 2, 6)
            c = c + frames[:, 1].reshape(-1)
            points = now.points + step[FRAME * n :].reshape(-1, 3)
            now = replace(now, T=moved(now.T, frames[:, 0].copy()), points=points)
            if np.abs(frames[:, 0, :3]).max() < _LINEAR:
                break
        lower = dpotri(L, lower=1)[0]
        covariance = lower + lower.T  # above the diagonal of `lower` stand zeros
        covariance.reshape(-1)[:: len(covariance) + 1] *= 0.5
        if not (np.isfinite(now.T).all() and (covariance.diagonal() > 0).all()):
            raise np.linalg.LinAlgError("the window has no usable solution")
        return replace(now, covariance=covariance)

    def with_measured(self, window: Window, camera: CameraWindow, points: BoolArray) -> Window:
        """All that the window has measured of some points (mask (p,)) taken into the prior.

        So they may go without loss.
        """
        if not np.isfinite(window.z[:, points]).any():
            return window
        taken = replace(window, z=np.where(points[:, None], window.z, np.nan))
        system = self._system(taken, camera.poses, len(window), range(0))
        return replace(
            window,
            z=np.where(points[:, None], np.nan, window.z),
            prior=Prior(system, window.T, camera.poses, window.points),
        )

    def without_oldest(self, window: Window, camera: CameraWindow, count: int) -> Window:
        """Without the `count` oldest frames, which are marginalised; the window must be solved."""
        n = len(window)
        is_camera = _cameras(n)
        system = self._system(window, camera.poses, count, range(min(count + 1, n - 1)))
        system.information[np.ix_(is_camera, is_camera)] += camera.given_later(count)
        gone = np.arange(FRAME * count)
        prior = Prior(system.eliminated(gone), window.T[count:], camera.poses[count:], window.points)
        return replace(
            window,
            frames=window.frames[count:],
            stamps=window.stamps[count:],
            T=window.T[count:],
            scales=window.scales[count:],
            z=window.z[count:],
            first_velocity=None,
            prior=prior,
            covariance=window.covariance[len(gone) :, len(gone) :],
        )

    def _system(self, window: Window, X: Array, measured: int, steps: range) -> System:
        """All factors, but for the cameras' own prior, linearised at the window's poses and points and cameras X.

        Of the measurements only those of the first frames are taken, `measured` in number, and of the steps of motion
        only `steps`.
        """
        system = _prior_at(window, X)
        Y = inverse(X[:measured]) @ window.T[:measured]
        add_measurements(system, self._stereo, self._sigma, window.z[:measured], Y, window.points, window.first_point)
        add_motion(system, self._models, window.T, window.stamps, window.scales, window.first_velocity, steps)
        return system


def _prior_at(window: Window, X: Array) -> System:
    """The prior for changes of the window's poses and points and of cameras X, instead of where it was linearised.

    No measurement says where in the body its frame lies: a change [θ, τ] of it, which moves all body poses alike,
    changes the points by ``N [θ, τ]`` and no prediction. N depends on the points. So that the prior does not hold on
    to the N of their old places, and with every marginalisation seem to say something of the frame, it is taken to be
    one on the body's poses and on where the points are beside the oldest of them.
    """
    p = window.prior
    return System(*kernels.relinearised(
        p.system.information, p.system.vector, p.T, p.X, p.points, window.T, X, window.points
    ))  # fmt: skip


def _cameras(n: int) -> IndexArray:
    """Unknowns of the cameras."""
    return (FRAME * np.arange(n)[:, None] + 6 + np.arange(6)).reshape(-1)


def _widened(system: System, at: int, count: int) -> System:
    """The same system with `count` more unknowns at the place `at`, of which nothing is known."""
    old = system.vector
    vector = np.concatenate([old[:at], np.zeros(count), old[at:]])
    return System(_with_zeros(system.information, at, count), vector)


def _with_zeros(matrix: Array, at: int, count: int) -> Array:
    """The matrix with `count` more rows and columns at the place `at`."""
    size = len(matrix) + count
    out = np.zeros((size, size))
    out[:at, :at], out[:at, at + count :] = matrix[:at, :at], matrix[:at, at:]
    out[at + count :, :at], out[at + count :, at + count :] = matrix[at:, :at], matrix[at:, at:]
    return out


def _append(array: Array, row: Array) -> Array:
    return np.concatenate([array, row[None]])
