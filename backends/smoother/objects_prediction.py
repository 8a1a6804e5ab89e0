"""What is expected of a body in a new frame, and which of its observations fit it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.smoother import pose_only
from backends.smoother.objects_factors import FRAME, first_sigmas, impulse_sigmas, velocities
from backends.smoother.objects_window import CameraWindow, Window
from backends.smoother.records import IndexArray
from backends.smoother.stereo import RectifiedStereo
from slam.data import BoolArray
from slam.gating import chi_square_limits
from slam.objects.models import ObjectModels
from slam.se3 import Array, adjoint, inverse, log, pose, so3_exp, so3_left_jacobian

#: By how much an impulse may exceed its standard deviation where most observations say so.
_SURPRISES = (0.0, 3.0, 10.0)
_ENOUGH = 4  # observations that can be judged to agree with each other


@dataclass(frozen=True)
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
    velocity, by_unknowns = np.zeros(6), np.zeros((6, size))
    sigmas = first_sigmas(models, dt, 1.0)
    if len(window) > 1:
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
    L = np.zeros((6 + size - window.first_point, size))
    L[:6] = A @ by_unknowns
    L[:6, last + 6 : last + FRAME] += F
    L[np.arange(6, len(L)), np.arange(window.first_point, size)] = 1
    own = L @ window.covariance @ L.T
    own[:6, :6] += W[6:, 6:] - F @ W[:6, 6:]
    by_velocity = A @ by_velocity
    return PredictedBody(T, X, own, (by_velocity * sigmas**2) @ by_velocity.T)


@dataclass(frozen=True)
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
    most = max(_ENOUGH, (len(rows) + 1) // 2)
    limit = float(chi_square_limits(np.array([6]), probability)[0])
    starts = [expected.T_body_left] + ([] if guess is None else [inverse(guess) @ expected.X])
    first = None
    for factor in _SURPRISES:
        problem = _problem(expected, stereo, sigma, probability, points, rows, z, factor)
        for start in starts:
            Y, used = pose_only.solve(problem, start)
            off = log(inverse(problem.predicted) @ Y)
            tried = Agreement(expected.X @ inverse(Y), used, float(np.hypot(1.0, factor)))
            first = first or tried
            if len(rows) < most or (used.sum() >= most and off @ problem.information @ off < limit):
                return tried
    assert first is not None
    return first


def _problem(
    expected: PredictedBody,
    stereo: RectifiedStereo,
    sigma: float,
    probability: float,
    points: Array,
    rows: IndexArray,
    z: Array,
    factor: float,
) -> pose_only.PoseProblem:
    """The camera's pose in the body, with the points held where they are.

    What pose and points have in common (where the body's frame lies in the world) matters to neither; so the pose is
    taken as known given the points, and each point given the pose.
    """
    mine = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).reshape(-1)])
    P = expected.own[np.ix_(mine, mine)]
    P[:6, :6] += (1 + factor**2) * expected.impulse
    cross = P[6:, :6]
    given_points = P[:6, :6] - cross.T @ np.linalg.solve(P[6:, 6:], cross)
    given_pose = P[6:, 6:] - cross @ np.linalg.solve(P[:6, :6], cross.T)
    own = np.arange(3 * len(rows)).reshape(-1, 3)
    covariances = given_pose[own[:, :, None], own[:, None, :]]
    T = expected.T_body_left
    _, J = stereo.project((points[rows] - T[:3, 3]) @ T[:3, :3])
    J = J @ T[:3, :3].T
    noise = J @ covariances @ np.swapaxes(J, 1, 2) + sigma**2 * np.eye(3)
    return pose_only.PoseProblem(stereo, points[rows], z, noise, T, np.linalg.inv(given_points), probability)
