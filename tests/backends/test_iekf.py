"""What is the invariant filter's own: its motion, and that nothing is learnt of where the world is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backends.ekf.camera import predicted as motion
from backends.iekf import IekfBackend
from backends.iekf.filter import InvariantCamera
from experiments.corridor import run as corridor
from slam.geometry import se3
from tests.backends.ekf_runs import MODELS, dense, turning_drive
from tests.backends.scenes import RIG, run
from tests.slam.numeric import jacobian

RNG = np.random.default_rng(1)
CAMERA = InvariantCamera(se3.exp(RNG.standard_normal(6)), RNG.standard_normal(3), RNG.standard_normal(3))
ERROR = 0.3 * RNG.standard_normal(12)


def test_a_correction_is_the_error_of_what_was_corrected():
    after = CAMERA.moved(ERROR)
    np.testing.assert_allclose(after.minus(CAMERA), ERROR, atol=1e-12)
    np.testing.assert_allclose(after.pose[:3, :3], se3.so3_exp(ERROR[3:6]) @ CAMERA.pose[:3, :3], atol=1e-12)


def test_the_pose_by_the_error():
    def perturbation(xi):
        return se3.log(se3.inverse(CAMERA.pose) @ CAMERA.moved(np.append(xi, np.zeros(6))).pose)

    np.testing.assert_allclose(CAMERA.by_error(), jacobian(perturbation, np.zeros(6)), atol=1e-8)


def test_the_motion_and_its_derivatives():
    dt, P = 0.2, 1e-4 * np.eye(12)
    camera, J, noise = motion(CAMERA, MODELS, P, dt, False)
    T = CAMERA.pose
    np.testing.assert_allclose(camera.pose[:3, :3], T[:3, :3] @ se3.so3_exp(dt * CAMERA.rate), atol=1e-12)
    np.testing.assert_allclose(camera.pose[:3, 3], T[:3, 3] + dt * CAMERA.v, atol=1e-12)

    def moved(xi):
        return CAMERA.moved(xi).advanced(dt)[0].minus(camera)

    np.testing.assert_allclose(J, jacobian(moved, np.zeros(12)), atol=1e-8)

    def disturbed(w):  # an impulse at the beginning of the step
        start = replace(CAMERA, v=CAMERA.v + w[:3], rate=CAMERA.rate + w[3:])
        return start.advanced(dt)[0].minus(camera)

    W = jacobian(disturbed, np.zeros(6))
    Q = np.diag(np.repeat(MODELS.motion.velocity_variance(dt), 3))
    np.testing.assert_allclose(noise, W @ Q @ W.T, rtol=1e-4, atol=1e-8)


def displacement(camera: InvariantCamera) -> np.ndarray:
    """The error (12, 6) of a camera in a world that is displaced: the invariant error [ξ_p, ξ_R] at the estimate."""
    U = np.zeros((12, 6))
    U[:6] = np.linalg.inv(camera.displacement())
    U[6:9, 3:] = -se3.hat(camera.v)
    return U


@pytest.mark.parametrize("iterations", [1, 5])
def test_what_nothing_measures_stays_unknown(iterations):
    """The information on a displacement of camera and map is that of the prior after any number of updates."""
    sigma = 0.01
    models = replace(MODELS, initial_position_sigma=sigma, initial_rotation_sigma=sigma)
    backend = IekfBackend(RIG, models, iterations=iterations)
    run(backend, turning_drive())
    s = backend.state
    shift = np.concatenate([displacement(s.camera), s.landmarks.gauge.reshape(-1, 6)])
    information = sigma**2 * np.diag(shift.T @ np.linalg.solve(dense(s.covariance), shift))
    assert (information < 1.001).all()  # less than 1 where the model's impulses have loosened it


def test_a_camera_far_from_zero_loses_no_digits():
    """At map coordinates of a country."""
    drive, there = turning_drive(), se3.pose(np.eye(3), [4e5, -2e5, 5e6])
    backends = [IekfBackend(RIG, replace(MODELS, T_world_left=T)) for T in (np.eye(4), there)]
    for backend in backends:
        run(backend, drive)
    one, other = (backend.estimate(landmarks=False) for backend in backends)
    assert np.abs(se3.inverse(there) @ other.T_world_left - one.T_world_left).max() < 1e-6
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-12)


def test_nothing_of_second_order_adds_up():
    """Corrections of centimetres, frame after frame, leave landmarks where they are: the path is the other filter's."""
    one, other = (corridor(name, {}, 150, seed=0) for name in ("ekf", "iekf"))
    assert np.abs((one.errors - other.errors)[-1] / one.deviations[-1]).max() < 0.01
