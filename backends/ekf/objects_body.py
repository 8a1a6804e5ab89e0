"""The filtered state of one rigid body, with its correlation with the filter's own state.

The error state is ``[θ, τ, δω, δv, points]`` (12 + 3p): the pose's right perturbation, angular and linear velocity in
world axes, and the body's points in body coordinates. The covariance with the filter's whole state (camera and
landmarks) is kept beside the body's own. Updates of the camera and the map correct the bodies as well; updates of a
body correct the body alone: a Schmidt-Kalman filter, in which the camera is considered and not estimated. So the body's
covariance knows how much of the camera's error is the same in all frames, and a wrong body cannot harm the map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dgemm

from backends.ekf.objects_measurement import BodyPoints, moved
from slam.data import BoolArray, IdArray
from slam.geometry.se3 import Array, adjoint, hat, inverse, pose, so3_exp, so3_left_jacobian
from slam.object_models import ObjectModels
from slam.objects.points import drift

RIGID = 12  #: fixed: size of [θ, τ, δω, δv]


@dataclass(frozen=True, eq=False)
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

    @cached_property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the pose's right perturbation."""
        return self.by_state @ self.columns[:6] @ self.by_state.T

    @cached_property
    def cross(self) -> Array:
        """Covariance (6, N) of the pose's right perturbation with the filter's whole state."""
        return np.ascontiguousarray(self.by_state @ self.columns.T)


@dataclass(frozen=True, eq=False)
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
        turned: of each point (p,), largest angle between the directions of its first sight and of later ones [rad].
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
    turned: Array


def found(number: int, T: Array, velocity: Array, sigmas: Array, size: int) -> Body:
    """A body at its first sight, without points yet. Its frame is put there: the pose has no error, by definition.

    Its [ω, v] (6,) has independent errors with standard deviations `sigmas` (6,).
    """
    P = np.zeros((RIGID, RIGID))
    P[6:, 6:] = np.diag(sigmas**2)
    none = np.zeros(0, np.int64)
    return Body(
        number, T, velocity, none, BodyPoints.at(T, np.zeros((0, 3))),
        P, np.zeros((RIGID, size)), np.zeros_like(P), none, none, none, np.zeros(0),
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


def drifted(body: Body, T_world_left: Array, density: float) -> Body:
    """With points less certain across the line of sight, where they are seen from farther round than ever before.

    Args:
        body: the body.
        T_world_left: the camera's pose (4, 4).
        density: of the random walk of a point's direction with the angle from which it is seen [rad / √rad].
    """
    Y, T = body.points.cartesian(), inverse(body.T) @ T_world_left
    turned, lateral = drift(Y, body.points.T_body_anchor[:, :3, 3], T[:3, 3], body.turned, density)
    half = body.points.by_position() @ lateral
    P, rows = body.covariance.copy(), RIGID + np.arange(3 * len(Y)).reshape(-1, 3)
    P[rows[:, :, None], rows[:, None, :]] += half @ np.swapaxes(half, 1, 2)
    return replace(body, covariance=P, turned=turned)


def joined(body: Body, camera: CameraBelief, ids: IdArray, h: Array, noise: Array, now: int) -> Body:
    """With new points, seen at h (M, 3) in camera coordinates with covariances `noise` (M, 3, 3)."""
    if not len(ids):
        return body
    T = inverse(body.T) @ camera.T_world_left
    points = BodyPoints.at(T, h)
    by_pose = points.by_frame()
    by_local = points.by_position() @ T[:3, :3]
    by_camera = np.concatenate([by_local @ hat(-h), by_local], axis=2).reshape(-1, 6)
    with_camera = body.cross[:, :6] @ camera.by_state.T  # covariance (n, 6) of the body with the camera's pose
    with_body = by_pose @ body.covariance[:6] + by_camera @ with_camera.T
    own = with_body[:, :6] @ by_pose.T + (by_pose @ with_camera[:6] + by_camera @ camera.covariance) @ by_camera.T
    for i, block in enumerate(by_local @ noise @ np.swapaxes(by_local, 1, 2)):
        own[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += block
    with_filter = by_pose @ body.cross[:6] + by_camera @ camera.cross
    return replace(
        body,
        ids=np.concatenate([body.ids, ids]),
        points=body.points.with_more(points),
        covariance=_enlarged(body.covariance, with_body, 0.5 * (own + own.T)),
        cross=np.concatenate([body.cross, with_filter]),
        failures=np.concatenate([body.failures, np.zeros(len(ids), np.int64)]),
        seen=np.concatenate([body.seen, np.full(len(ids), now)]),
        sights=np.concatenate([body.sights, np.ones(len(ids), np.int64)]),
        turned=np.concatenate([body.turned, np.zeros(len(ids))]),
    )


def _enlarged(P: Array, cross: Array, own: Array) -> Array:
    """The covariance P (n, n) with more rows and columns: `cross` (m, n) with it, `own` (m, m)."""
    n = len(P)
    out = np.empty((n + len(own), n + len(own)))
    out[:n, :n], out[n:, :n], out[:n, n:], out[n:, n:] = P, cross, cross.T, own
    return out


def without(body: Body, gone: BoolArray) -> Body:
    """Without some of its points (mask (p,))."""
    if not gone.any():
        return body
    rows = np.flatnonzero(np.concatenate([np.ones(RIGID, bool), np.repeat(~gone, 3)]))
    return replace(
        body,
        ids=body.ids[~gone],
        points=body.points.select(~gone),
        covariance=body.covariance[rows[:, None], rows],
        cross=body.cross[rows],
        failures=body.failures[~gone],
        seen=body.seen[~gone],
        sights=body.sights[~gone],
        turned=body.turned[~gone],
    )


@dataclass(frozen=True, eq=False)
class Gathered:
    """Covariances with ``g = [r, φ, observed points]`` of `BodyMeasurement`, camera error included.

    Attributes:
        own: of g itself (6 + 3M, 6 + 3M).
        body: of g with the body's error state (6 + 3M, 12 + 3p).
        rows: those (6 + 3M,) of the body's error state that g is made of.
        by_camera: derivatives (6, 6) of [r, φ] by the camera's perturbation.
        by_points: derivatives (M, 3, 3) of the points by theirs.
    """

    own: Array
    body: Array
    rows: NDArray[np.intp]
    by_camera: Array
    by_points: Array

    def backward(self, B: Array) -> tuple[Array, Array]:
        """Columns B (6 + 3M, K) of g as such of the body's error state, at `rows`, and of the camera's pose (6, K)."""
        out = np.empty(B.shape)
        np.negative(B[:6], out=out[:6])
        points = np.swapaxes(self.by_points, 1, 2) @ B[6:].reshape(-1, 3, B.shape[1])
        out[6:] = points.reshape(-1, B.shape[1])
        return out, self.by_camera.T @ B[:6]


def gathered(body: Body, camera: CameraBelief, rows: NDArray[np.intp]) -> Gathered:
    """The covariances with g for the points `rows` (M,).

    The relative pose is off by ``[θ, τ] − Ad c``, where c is the camera's perturbation and Ad that of the camera's
    pose in the body; g has it with opposite sign, translation first.
    """
    A = adjoint(inverse(body.T) @ camera.T_world_left)[[3, 4, 5, 0, 1, 2]]
    mine = np.concatenate([[3, 4, 5, 0, 1, 2], (RIGID + 3 * rows[:, None] + np.arange(3)).reshape(-1)])
    D = body.points.derivatives()[rows]
    with_camera = body.cross[:, :6] @ camera.by_state.T

    def forward(of_body: Array, of_camera: Array) -> Array:
        """Of g, from the same of the body's rows `mine` (6 + 3M, K), and of the camera (6, K)."""
        points = D @ of_body[6:].reshape(-1, 3, of_body.shape[1])
        return np.concatenate([A @ of_camera - of_body[:6], points.reshape(-1, of_body.shape[1])])

    by_body = forward(body.covariance[mine], with_camera.T)
    by_camera = forward(with_camera[mine], camera.covariance)
    own = forward(by_body.T[mine], by_camera.T)
    return Gathered(0.5 * (own + own.T), by_body, mine, A, D)


def corrected(body: Body, camera: CameraBelief, covariances: Gathered, s: Array, B: Array) -> Body:
    """After an update whose solution, in g, is s and B (see `backends.ekf.solve.Solution`).

    The solved shift is in the axes after the turn. What hangs on the pose (the velocity above all, which brought it
    there) was predicted to hang on the shift in the axes before: after a long step the two differ.
    """
    turn = s @ covariances.body[:, :3]
    shift = s @ covariances.body[:, 3:6]
    off = np.zeros(len(s))
    off[:3] = shift - so3_exp(turn) @ shift  # of r = −τ
    change = (s + np.linalg.solve(covariances.own, off)) @ covariances.body
    change[:6] = np.concatenate([turn, shift])
    W = covariances.body.T @ B
    of_body, of_camera = covariances.backward(B)
    # The filter's state has the covariance `crossᵀ of_body + camera.crossᵀ of_camera` with B.
    gain = W @ np.concatenate([of_body, of_camera]).T
    after = _learnt(body, change, W, gain, np.concatenate([body.cross[covariances.rows], camera.cross]))
    return transported(after, body.points, camera)


def corrected_by_map(body: Body, columns: NDArray[np.intp], s: Array, B: Array, W: Array, camera: CameraBelief) -> Body:
    """After an update of the filter itself, which changed its state by ``P[:, columns] s`` and its covariance P by
    ``− W Wᵀ``, ``W = P[:, columns] B``; the camera has its covariance after the update, at the pose before it.
    """
    mine = body.cross[:, columns]
    V = mine @ B
    after = _learnt(body, mine @ s, V, V, W[: body.cross.shape[1]].T)
    return transported(after, body.points, camera)


def _learnt(body: Body, change: Array, W: Array, gain: Array, rows: Array) -> Body:
    """With the mean changed by (12 + 3p,), covariance less ``W Wᵀ``, cross-covariance less ``gain @ rows``."""
    turned = rows.flags.f_contiguous  # BLAS reads both orders; scipy would copy one
    rows, cross = rows if turned else rows.T, body.cross.T.copy(order="F")
    cross = dgemm(-1.0, rows, gain.T, beta=1.0, c=cross, trans_a=turned, overwrite_c=1).T
    return replace(
        body,
        T=moved(body.T, change[:6]),
        velocity=body.velocity + change[6:RIGID],
        points=body.points.plus(change[RIGID:].reshape(-1, 3)),
        covariance=body.covariance - W @ W.T,
        cross=cross,
    )


def transported(body: Body, before: BodyPoints, camera: CameraBelief) -> Body:
    """Transport the covariance to the points as they are now, from those before, `before` (p), for which it holds.

    In place: nobody else has the covariances of a body that has just been corrected.

    No measurement says where in the body its frame lies, nor where in the world camera and body are together. If the
    pose is off by ``[θ, τ]`` and the camera by c, such a displacement changes the points by ``N η``, where ``η =
    [θ, τ] − Ad c`` (see `gathered`), and no prediction. N depends on the points; were the covariance kept in the
    coordinates of their old places, each update would seem to say something of η. So it is transported to the new N.
    """
    if not len(before):
        return body
    K = body.points.by_frame() - before.by_frame()
    A = adjoint(inverse(body.T) @ camera.T_world_left)
    by_state = A @ camera.by_state
    with_body = body.covariance[:6] - by_state @ body.cross[:, :6].T  # covariance (6, n) of η with the body
    with_filter = body.cross[:6] - A @ camera.cross  # and with the filter's state (6, N)
    own = with_body[:, :6] - with_filter[:, :6] @ by_state.T
    P = body.covariance
    P[RIGID:] += K @ with_body
    P[:, RIGID:] += with_body.T @ K.T
    P[RIGID:, RIGID:] += K @ own @ K.T
    dgemm(1.0, with_filter.T, K.T, beta=1.0, c=body.cross[RIGID:].T, overwrite_c=1)
    return body
