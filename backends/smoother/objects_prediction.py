"""What is expected of a body in a new frame, and which of its observations fit it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.smoother.objects_factors import first_sigmas, impulse_sigmas, velocities
from backends.smoother.objects_kernels import FRAME
from backends.smoother.objects_window import CameraWindow, Window
from slam.chi_square import chi_square_limit, chi_square_limits
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array, adjoint, exp, inverse, log, pose, so3_exp, so3_left_jacobian
from slam.object_models import ObjectModels
from slam.objects.points import MIN_POINTS
from slam.window import pose_only
from slam.window.agreement import INFLATION
from slam.window.stereo import RectifiedStereo


@dataclass(frozen=True, eq=False)
class PredictedBody:
    """A body's pose in a new frame, before it is measured.

    Attributes:
        T: T_world_object (4, 4).
        X: the camera's pose T_world_left (4, 4).
        own: covariance (6 + 3p, 6 + 3p) of [camera in body, points], but for the impulse.
        impulse: what the impulse adds to that of the camera's pose in the body (6, 6).
    """

    T: Array
    X: Array
    own: Array
    impulse: Array

    @property
    def T_body_left(self) -> Array:
        """The camera's pose (4, 4) in the body."""
        return inverse(self.T) @ self.X


def predicted(window: Window, camera: CameraWindow, stamp: float, models: ObjectModels) -> PredictedBody:
    """The body at `stamp` at the velocity of its last step; the last of the camera's poses is that of the new frame."""
    last, dt = FRAME * (len(window) - 1), stamp - window.stamps[-1]
    T, size = window.T[-1], len(window.covariance)
    by_unknowns = np.zeros((6, size))
    if window.first_velocity is not None and len(window) == 1:
        velocity, sigmas = window.first_velocity.mean, first_sigmas(window.first_velocity, models, dt, 1.0)
    else:
        (velocity,), (before,), (after,) = velocities(window.T[-2:], window.stamps[-2:])
        by_unknowns[:, last - FRAME : last - FRAME + 6], by_unknowns[:, last : last + 6] = before, after
        sigmas = impulse_sigmas(models, dt, 1.0)
    R = so3_exp(dt * velocity[:3]) @ T[:3, :3]
    by_velocity = np.zeros((6, 6))
    by_velocity[:3, :3], by_velocity[3:, 3:] = dt * R.T @ so3_left_jacobian(dt * velocity[:3]), dt * R.T
    by_unknowns = by_velocity @ by_unknowns
    by_unknowns[:3, last : last + 3] += np.eye(3)
    by_unknowns[3:, last + 3 : last + 6] += R.T @ T[:3, :3]
    T = pose(R, T[:3, 3] + dt * velocity[3:])
    X = camera.poses[-1]
    A = -adjoint(inverse(X) @ T)
    W = camera.covariance[-12:, -12:]
    F = W[6:, :6] @ np.linalg.inv(W[:6, :6])
    L = A @ by_unknowns
    L[:, last + 6 : last + FRAME] += F
    with_all, first = L @ window.covariance, window.first_point
    own = np.zeros((6 + size - first, 6 + size - first))
    own[:6, :6] = with_all @ L.T + W[6:, 6:] - F @ W[:6, 6:]
    own[:6, 6:] = with_all[:, first:]
    own[6:, :6] = own[:6, 6:].T
    own[6:, 6:] = window.covariance[first:, first:]
    by_velocity = A @ by_velocity
    return PredictedBody(T, X, own, (by_velocity * sigmas**2) @ by_velocity.T)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where a body seems to be, and which observations (M,) say so.

    Attributes:
        T: T_world_object (4, 4).
        used: which observations agree.
        scale: factor on the impulse's standard deviation without which most would not.
    """

    T: Array
    used: BoolArray
    scale: float


def agreement(
    expected: PredictedBody,
    stereo: RectifiedStereo,
    sigma: float,
    probability: float,
    points: Array,
    rows: IndexArray,
    z: Array,
    guess: Array | None,
) -> Agreement:
    """Find the pose on which most observations agree, without tearing it further from the prediction than needed.

    Args:
        expected: the prediction.
        stereo: the projection.
        sigma: its noise [px].
        probability: share of good observations that the gate shall let pass.
        points: of the body (p, 3).
        rows: the points observed (M,).
        z: the observations (M, 3).
        guess: T_world_object (4, 4) to start from, or None.
    """
    most = max(MIN_POINTS, (len(rows) + 1) // 2)
    limit = chi_square_limit(6, probability)
    starts = [expected.T_body_left] + ([] if guess is None else [inverse(guess) @ expected.X])
    first = None
    for factor in (0.0, *INFLATION):
        belief = _belief(expected, rows, factor)
        problem = _problem(expected, stereo, sigma, probability, points, rows, z, belief)
        for start in starts:
            Y, used = pose_only.solve(problem, start)
            off = log(inverse(problem.predicted) @ Y)
            Y, used = _without_contradicted(problem, belief, sigma, Y, used)
            tried = Agreement(expected.X @ inverse(Y), used, float(np.hypot(1.0, factor)))
            first = first or tried
            if len(rows) < most or (used.sum() >= most and off @ problem.information @ off < limit):
                return tried
    assert first is not None
    return first


def _belief(expected: PredictedBody, rows: IndexArray, factor: float) -> Array:
    """Covariance (6 + 3M, 6 + 3M) of the camera's pose in the body and of the points `rows`."""
    mine = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).reshape(-1)])
    P: Array = expected.own[np.ix_(mine, mine)]
    P[:6, :6] += (1 + factor**2) * expected.impulse
    return P


def _without_contradicted(
    problem: pose_only.PoseProblem, belief: Array, sigma: float, Y: Array, used: BoolArray
) -> tuple[Array, BoolArray]:
    """Without the observations that what all others say contradicts, the worst first; with the pose that remains.

    An observation with leverage draws the pose to itself, and then agrees with it: so each is tested by the others.
    For its rows j, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``; given the others its innovation is off by ``Q_j⁻¹ y_j``,
    with covariance ``Q_j⁻¹``.
    """
    count, used = len(problem.points), used.copy()
    own = np.arange(3 * count).reshape(-1, 3)
    limits = chi_square_limits(np.isfinite(problem.z).sum(axis=1), problem.probability)
    while used.any():
        r, by_pose = pose_only.residuals(problem, Y)
        _, J = problem.stereo.project((problem.points - Y[:3, 3]) @ Y[:3, :3])
        by_all = np.zeros((count, 3, 6 + 3 * count))
        by_all[:, :, :6] = by_pose
        by_all[np.arange(count)[:, None], :, 6 + own] = np.swapaxes(J @ Y[:3, :3].T, 1, 2)
        missing = ~(np.isfinite(r) & used[:, None])
        r[missing], by_all[missing] = 0, 0
        H = by_all.reshape(3 * count, -1)
        nu = r.reshape(-1) + H[:, :6] @ log(inverse(problem.predicted) @ Y)
        # The inverse's own blocks are needed below, one for each observation.
        Q = np.linalg.inv(H @ belief @ H.T + sigma**2 * np.eye(len(H)))
        y = Q @ nu
        Y = problem.predicted @ exp(belief[:6] @ (H.T @ y))
        off = y.reshape(-1, 3, 1)
        blocks = Q[own[:, :, None], own[:, None, :]]
        excess = (off * np.linalg.solve(blocks, off)).sum(axis=(1, 2)) / limits
        worst = excess.max()
        if worst <= 1:
            break
        used &= excess <= max(1.0, 0.5 * worst)
    return Y, used


def _problem(
    expected: PredictedBody,
    stereo: RectifiedStereo,
    sigma: float,
    probability: float,
    points: Array,
    rows: IndexArray,
    z: Array,
    belief: Array,
) -> pose_only.PoseProblem:
    """The camera's pose in the body, with the points held where they are.

    What pose and points have in common (where the body's frame lies in the world) matters to neither; so the pose is
    taken as known given the points, and each point given the pose.
    """
    P, cross = belief, belief[6:, :6]
    given_points = P[:6, :6] - cross.T @ np.linalg.solve(P[6:, 6:], cross)
    given_pose = P[6:, 6:] - cross @ np.linalg.solve(P[:6, :6], cross.T)
    own = np.arange(3 * len(rows)).reshape(-1, 3)
    covariances = given_pose[own[:, :, None], own[:, None, :]]
    T = expected.T_body_left
    _, J = stereo.project((points[rows] - T[:3, 3]) @ T[:3, :3])
    J = J @ T[:3, :3].T
    noise = J @ covariances @ np.swapaxes(J, 1, 2) + sigma**2 * np.eye(3)
    return pose_only.PoseProblem(stereo, points[rows], z, noise, T, np.linalg.inv(given_points), probability)
