"""The filtered state of one rigid body, with its correlation with the filter's own state.

The error state is ``[θ, τ, δω, δv, points]`` (12 + 3p): the pose's right perturbation, angular and linear velocity in
world axes, and the body's points in body coordinates. The covariance with the filter's whole state (camera and
landmarks) is kept beside the body's own. Updates of the camera and the map correct the bodies as well; updates of a
body correct the body alone: a Schmidt-Kalman filter, in which the camera is considered and not estimated. So the body's
covariance knows how much of the camera's error is the same in all frames, and a wrong body cannot harm the map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from backends.ekf.objects_measurement import BodyPoints, moved
from slam.data import BoolArray, IdArray
from slam.objects.models import ObjectModels
from slam.se3 import Array, adjoint, hat, inverse, pose, so3_exp, so3_left_jacobian

RIGID = 12  #: size of [θ, τ, δω, δv]


@dataclass(frozen=True)
class CameraBelief:
    """The camera's pose as the filter has it.

    Attributes:
        T_world_left: pose (4, 4).
        by_state: Jacobian (6, 6) of its right perturbation by the first six numbers of the filter's state.
        columns: covariance (N, 6) of the filter's whole state with those six.
    """

    T_world_left: Array
    by_state: Array
    columns: Array

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the pose's right perturbation."""
        return self.by_state @ self.columns[:6] @ self.by_state.T

    @property
    def cross(self) -> Array:
        """Covariance (N, 6) of the filter's whole state with the pose's right perturbation."""
        return self.columns @ self.by_state.T


@dataclass(frozen=True)
class Body:
    """A body's belief.

    Attributes:
        id: of the body.
        T: pose T_world_object (4, 4).
        velocity: [ω, v] (6,) in world axes.
        ids: of its points (p,).
        points: the points (p).
        covariance: of the error state (12 + 3p, 12 + 3p).
        cross: covariance (12 + 3p, N) of it with the filter's state.
        noise: what the last step of time has added to the covariance of [θ, τ, δω, δv] (12, 12).
        failures: of each point (p,), how often running its observation was rejected.
        seen: of each point (p,), when it was last observed (number of the update).
        sights: of each point (p,), in how many updates it was used.
    """

    id: int
    T: Array
    velocity: Array
    ids: IdArray
    points: BodyPoints
    covariance: Array
    cross: Array
    noise: Array
    failures: IdArray
    seen: IdArray
    sights: IdArray


def found(number: int, T: Array, models: ObjectModels, size: int) -> Body:
    """A body at its first sight, without points yet. Its frame is put there: the pose has no error, by definition."""
    P = np.zeros((RIGID, RIGID))
    sigmas = np.repeat([models.initial_angular_velocity_sigma, models.initial_velocity_sigma], 3)
    P[6:, 6:] = np.diag(sigmas**2)
    none = np.zeros(0, np.int64)
    return Body(
        number, T, np.zeros(6), none, BodyPoints.at(T, np.zeros((0, 3))),
        P, np.zeros((RIGID, size)), np.zeros_like(P), none, none, none,
    )  # fmt: skip


def advanced(body: Body, dt: float, models: ObjectModels) -> Body:
    """After `dt` [s] of constant velocity, disturbed by an impulse at the beginning (paper B, section 2)."""
    step = so3_exp(dt * body.velocity[:3])
    R = step @ body.T[:3, :3]
    T = pose(R, body.T[:3, 3] + dt * body.velocity[3:])
    F = np.eye(RIGID)
    F[3:6, 3:6] = R.T @ body.T[:3, :3]  # a turn on the right stays what it is: exp(ω dt) R exp(θ)
    F[:3, 6:9] = dt * R.T @ so3_left_jacobian(dt * body.velocity[:3])
    F[3:6, 9:] = dt * R.T
    linear, angular = models.velocity_variance(dt)
    noise = (F[:, 6:] * np.repeat([angular, linear], 3)) @ F[:, 6:].T
    P, cross = body.covariance.copy(), body.cross.copy()
    P[:RIGID] = F @ P[:RIGID]
    P[:, :RIGID] = P[:, :RIGID] @ F.T
    P[:RIGID, :RIGID] += noise
    cross[:RIGID] = F @ cross[:RIGID]
    return replace(body, T=T, covariance=P, cross=cross, noise=noise)


def widened(body: Body, factor: float) -> Body:
    """As if the last impulse had been drawn from a distribution wider by `factor` in addition."""
    if not factor:
        return body
    P = body.covariance.copy()
    P[:RIGID, :RIGID] += factor**2 * body.noise
    return replace(body, covariance=P)


def joined(body: Body, camera: CameraBelief, ids: IdArray, h: Array, noise: Array, now: int) -> Body:
    """With new points, seen at h (M, 3) in camera coordinates with covariances `noise` (M, 3, 3)."""
    if not len(ids):
        return body
    T = inverse(body.T) @ camera.T_world_left
    points = BodyPoints.at(T, h)
    by_position = np.linalg.inv(points.derivatives())
    eye = np.broadcast_to(np.eye(3), (len(ids), 3, 3))
    by_pose = (by_position @ np.concatenate([hat(points.cartesian()), -eye], axis=2)).reshape(-1, 6)
    by_local = by_position @ T[:3, :3]
    by_camera = (by_local @ np.concatenate([-hat(h), eye], axis=2)).reshape(-1, 6)
    with_camera = body.cross[:, :6] @ camera.by_state.T  # covariance (n, 6) of the body with the camera's pose
    with_body = by_pose @ body.covariance[:6] + by_camera @ with_camera.T
    own = with_body[:, :6] @ by_pose.T + (by_pose @ with_camera[:6] + by_camera @ camera.covariance) @ by_camera.T
    for i, block in enumerate(by_local @ noise @ np.swapaxes(by_local, 1, 2)):
        own[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += block
    with_filter = by_pose @ body.cross[:6] + by_camera @ camera.cross.T
    return replace(
        body,
        ids=np.concatenate([body.ids, ids]),
        points=body.points.with_more(points),
        covariance=np.block([[body.covariance, with_body.T], [with_body, 0.5 * (own + own.T)]]),
        cross=np.concatenate([body.cross, with_filter]),
        failures=np.concatenate([body.failures, np.zeros(len(ids), np.int64)]),
        seen=np.concatenate([body.seen, np.full(len(ids), now)]),
        sights=np.concatenate([body.sights, np.ones(len(ids), np.int64)]),
    )


def without(body: Body, gone: BoolArray) -> Body:
    """Without some of its points (mask (p,))."""
    if not gone.any():
        return body
    rows = np.concatenate([np.ones(RIGID, bool), np.repeat(~gone, 3)])
    return replace(
        body,
        ids=body.ids[~gone],
        points=body.points.select(~gone),
        covariance=body.covariance[np.ix_(rows, rows)],
        cross=body.cross[rows],
        failures=body.failures[~gone],
        seen=body.seen[~gone],
        sights=body.sights[~gone],
    )


@dataclass(frozen=True)
class Gathered:
    """Covariances with ``g = [r, φ, observed points]`` of `BodyMeasurement`, camera error included.

    Attributes:
        own: of g itself (6 + 3M, 6 + 3M).
        body: of the body's error state (12 + 3p, 6 + 3M).
        filter: of the filter's state (N, 6 + 3M).
    """

    own: Array
    body: Array
    filter: Array


def gathered(body: Body, camera: CameraBelief, rows: NDArray[np.intp]) -> Gathered:
    """The covariances with g for the points `rows` (M,).

    The relative pose is off by ``[θ, τ] − Ad c``, where c is the camera's perturbation and Ad that of the camera's
    pose in the body; g has it with opposite sign, translation first.
    """
    A = adjoint(inverse(body.T) @ camera.T_world_left)[[3, 4, 5, 0, 1, 2]]
    columns = np.concatenate([[3, 4, 5, 0, 1, 2], (RIGID + 3 * rows[:, None] + np.arange(3)).reshape(-1)])
    sign = np.ones(len(columns))
    sign[:6] = -1
    with_camera = body.cross[:, :6] @ camera.by_state.T
    by_body: Array = body.covariance[:, columns] * sign
    by_body[:, :6] += with_camera @ A.T
    by_camera: Array = with_camera.T[:, columns] * sign
    by_camera[:, :6] += camera.covariance @ A.T
    by_filter = body.cross.T[:, columns] * sign
    by_filter[:, :6] += camera.cross @ A.T
    D = body.points.select(rows).derivatives()
    by_body, by_camera = _in_positions(by_body, D), _in_positions(by_camera, D)
    own = by_body[columns] * sign[:, None]
    own[:6] += A @ by_camera
    own = _in_positions(own.T, D)
    return Gathered(0.5 * (own + own.T), by_body, _in_positions(by_filter, D))


def _in_positions(columns: Array, D: Array) -> Array:
    """Columns (K, 6 + 3M) with those of the points' coordinates taken to positions by D (M, 3, 3)."""
    points = columns[:, 6:].reshape(len(columns), -1, 1, 3) @ np.swapaxes(D, 1, 2)
    return np.concatenate([columns[:, :6], points.reshape(len(columns), -1)], axis=1)


def corrected(body: Body, covariances: Gathered, s: Array, B: Array) -> Body:
    """After an update whose solution, in g, is s and B (see `backends.ekf.solve.Solution`).

    The solved shift is in the axes after the turn. What hangs on the pose (the velocity above all, which brought it
    there) was predicted to hang on the shift in the axes before: after a long step the two differ.
    """
    turn = (covariances.body[:3] @ s)[:3]
    shift = covariances.body[3:6] @ s
    off = np.zeros(len(s))
    off[:3] = shift - so3_exp(turn) @ shift  # of r = −τ
    change = covariances.body @ (s + np.linalg.solve(covariances.own, off))
    change[:6] = np.concatenate([turn, shift])
    W = covariances.body @ B
    after = replace(
        _changed(body, change),
        covariance=body.covariance - W @ W.T,
        cross=body.cross - W @ (covariances.filter @ B).T,
    )
    return _with_free_frame(body, after)


def corrected_by_map(body: Body, columns: NDArray[np.intp], s: Array, B: Array, W: Array) -> Body:
    """After an update of the filter itself, which changed its state by ``P[:, columns] s`` and its covariance P by
    ``− W Wᵀ``, ``W = P[:, columns] B``.
    """
    mine = body.cross[:, columns]
    V = mine @ B
    after = replace(
        _changed(body, mine @ s),
        covariance=body.covariance - V @ V.T,
        cross=body.cross - V @ W[: body.cross.shape[1]].T,
    )
    return _with_free_frame(body, after)


def _changed(body: Body, change: Array) -> Body:
    """With the mean changed by (12 + 3p,)."""
    return replace(
        body,
        T=moved(body.T, change[:6]),
        velocity=body.velocity + change[6:RIGID],
        points=body.points.plus(change[RIGID:].reshape(-1, 3)),
    )


def _with_free_frame(before: Body, after: Body) -> Body:
    """With covariances that know where the body's frame lies no better than before the points were changed.

    No measurement says where in the body its frame lies: a change [θ, τ] of it changes the points by ``N [θ, τ]`` and
    no prediction. N depends on the points; were the covariance kept in the coordinates of their old places, each
    update would seem to say something of it.
    """
    if not len(after.ids):
        return after
    moved_on = _by_frame(after.points) - _by_frame(before.points)
    P, cross = after.covariance.copy(), after.cross.copy()
    P[RIGID:] += moved_on @ P[:6]
    P[:, RIGID:] += P[:, :6] @ moved_on.T
    cross[RIGID:] += moved_on @ cross[:6]
    return replace(after, covariance=P, cross=cross)


def _by_frame(points: BodyPoints) -> Array:
    """Change (3p, 6) of the points' coordinates with a change [θ, τ] of the body's frame that leaves them in place."""
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    by_frame = np.concatenate([hat(points.cartesian()), -eye], axis=2)
    return np.asarray(np.linalg.solve(points.derivatives(), by_frame).reshape(-1, 6))
