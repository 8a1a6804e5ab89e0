"""What is the invariant filter's own: its error, its motion, and that nothing is learnt of where the world is."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import chi2

from backends.ekf.landmarks import InverseDepth
from backends.ekf.measurement import Measurement
from backends.ekf.solve import Problem, gate, solve
from backends.ekf.state import State
from backends.iekf import IekfBackend
from backends.iekf.camera import InvariantCamera
from experiments.corridor import run as corridor
from slam.errors import ConfigurationError
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from tests.backends.ekf_runs import FORWARD, MODELS, STILL, YAW, errors, nees, turning_drive
from tests.backends.scenes import RIG, cloud, observe, path, run, scene, step
from tests.slam.numeric import assert_equal_to_rounding, jacobian

RNG = np.random.default_rng(1)
CAMERA = InvariantCamera(
    se3.exp(RNG.standard_normal(6)), RNG.standard_normal(3), RNG.standard_normal(3), RNG.standard_normal(3)
)


def error_of(camera: InvariantCamera, of: InvariantCamera) -> np.ndarray:
    """The error ξ (12,) of `of` whose correction makes it `camera`."""
    turn = camera.pose[:3, :3] @ of.pose[:3, :3].T
    shift = turn.T @ (camera.pose[:3, 3] - of.origin) - (of.pose[:3, 3] - of.origin)
    return np.concatenate([shift, se3.so3_log(turn), turn.T @ camera.v - of.v, camera.rate - of.rate])


def test_a_correction_is_a_displacement_of_the_world():
    xi = 0.3 * RNG.standard_normal(12)
    after = CAMERA.moved(xi)
    np.testing.assert_allclose(error_of(after, CAMERA), xi, atol=1e-12)
    np.testing.assert_allclose(after.pose[:3, :3], se3.so3_exp(xi[3:6]) @ CAMERA.pose[:3, :3], atol=1e-12)


def test_the_errors_derivatives():
    def perturbation(xi):
        return se3.log(se3.inverse(CAMERA.pose) @ CAMERA.moved(np.append(xi, np.zeros(6))).pose)

    np.testing.assert_allclose(CAMERA.by_error(), jacobian(perturbation, np.zeros(6)), atol=1e-8)

    def plain(x):  # of position, attitude, velocity and rate, each by itself
        T = se3.pose(se3.so3_exp(x[3:6]) @ CAMERA.pose[:3, :3], CAMERA.pose[:3, 3] + x[:3])
        return error_of(replace(CAMERA, pose=T, v=CAMERA.v + x[6:9], rate=CAMERA.rate + x[9:]), CAMERA)

    np.testing.assert_allclose(CAMERA.plain(), jacobian(plain, np.zeros(12)), atol=1e-8)


def test_the_motion_and_its_derivatives():
    dt, P = 0.2, 1e-4 * np.eye(12)
    found = CAMERA.advanced(MODELS, P, dt)
    T = CAMERA.pose
    np.testing.assert_allclose(found.camera.pose[:3, :3], T[:3, :3] @ se3.so3_exp(dt * CAMERA.rate), atol=1e-12)
    np.testing.assert_allclose(found.camera.pose[:3, 3], T[:3, 3] + dt * CAMERA.v, atol=1e-12)

    def moved(xi):
        return error_of(CAMERA.moved(xi).advanced(MODELS, P, dt).camera, found.camera)

    np.testing.assert_allclose(found.J, jacobian(moved, np.zeros(12)), atol=1e-8)

    def disturbed(w):  # an impulse at the beginning of the step
        start = replace(CAMERA, v=CAMERA.v + w[:3], rate=CAMERA.rate + w[3:])
        return error_of(start.advanced(MODELS, P, dt).camera, found.camera)

    W = jacobian(disturbed, np.zeros(6))
    Q = np.diag(np.repeat(MODELS.motion.velocity_variance(dt), 3))
    np.testing.assert_allclose(found.noise, W @ Q @ W.T, rtol=1e-4, atol=1e-8)


def test_a_displacement_of_the_world_stays_one():
    """The transition leaves the error of a displaced world as it is, exactly."""
    J = CAMERA.advanced(MODELS, 1e-4 * np.eye(12), 0.2).J
    U = np.eye(12, 6)
    assert_equal_to_rounding(J @ U, U)


def known(seed: int = 5) -> tuple[IekfBackend, np.ndarray]:
    """A filter with landmarks, and their coordinates' predicted measurements."""
    backend, known = IekfBackend(RIG, MODELS), set()
    for stamp, _, seen in list(turning_drive())[:6]:
        step(backend, stamp, seen, known)
    backend.predict(0.6)
    return backend, np.random.default_rng(seed)


def test_the_update_is_the_joseph_form_along_measured_columns_alone():
    backend, rng = known()
    s: State = backend.state
    rows = np.flatnonzero(RIG.left.in_view(se3.transform(se3.inverse(s.pose), s.landmarks.points)))[:15]
    model, c = Measurement(RIG, InverseDepth(), s.landmarks.anchors[rows]), s.landmarks.c[rows]
    measured = model.predict(s.pose, c) + 0.5 * rng.standard_normal((len(rows), 3))
    problem = Problem(partial(s.view, rows), c, 12 + 3 * rows, measured, 0.5, model, 1, 1 - 1e-12)
    solution, P = solve(problem, gate(problem)), s.covariance.dense
    H = np.zeros((3 * len(rows), len(P)))
    for i, row in enumerate(rows):
        own = jacobian(lambda x, i=i: model.predict(s.pose, c + np.eye(len(rows))[i][:, None] * x)[i], np.zeros(3))
        H[3 * i : 3 * i + 3, 12 + 3 * row : 15 + 3 * row] = own
    S = H @ P @ H.T + 0.25 * np.eye(len(H))
    K = np.linalg.solve(S, H @ P).T
    change = K @ (measured - model.predict(s.pose, c)).reshape(-1)
    np.testing.assert_allclose(solution.change, change, rtol=1e-4, atol=1e-7)
    after = s.corrected(model.coordinates, solution, rows)
    J, deviation = np.eye(len(P)) - K @ H, np.sqrt(np.diag(P))
    joseph = J @ P @ J.T + 0.25 * K @ K.T
    assert np.abs((after.covariance.dense - joseph) / np.outer(deviation, deviation)).max() < 1e-5
    np.testing.assert_allclose(after.camera.pose, s.camera.moved(change[:12]).pose, atol=1e-6)


@pytest.mark.parametrize("iterations", [1, 5])
def test_what_nothing_measures_stays_unknown(iterations):
    """The information on a displacement of camera and map is that of the prior after any number of updates."""
    sigma = 0.01
    models = replace(MODELS, initial_position_sigma=sigma, initial_rotation_sigma=sigma)
    backend = IekfBackend(RIG, models, iterations=iterations)
    run(backend, turning_drive())
    P = backend.state.covariance.dense
    shift = np.eye(len(P), 6)  # about the first position
    information = sigma**2 * np.diag(shift.T @ np.linalg.solve(P, shift))
    assert (information < 1.001).all()  # less than 1 where the model's impulses have loosened it


def test_landmarks_leave_and_come_back_as_they_were():
    """An error in the world and the invariant one are two ways to say the same, also after a step."""
    backend, _ = known()
    s, dt = backend.state, 0.1
    count, some = s.covariance.count, np.arange(0, s.covariance.count, 2)
    nothing, all_ = np.zeros(0, np.intp), np.arange(count)

    def on(state: State) -> State:
        return state.advanced(state.stamp + dt, state.camera.advanced(MODELS, state.covariance.dense[:12, :12], dt))

    def whole(state: State) -> np.ndarray:
        P, order = state.covariance.dense, np.argsort(state.landmarks.ids)
        rows = np.concatenate([np.arange(12), (12 + 3 * order[:, None] + np.arange(3)).reshape(-1)])
        deviation = np.sqrt(np.diag(P))
        return (P / np.outer(deviation, deviation))[np.ix_(rows, rows)]

    away = s._rearranged(np.setdiff1d(all_, some), some, nothing)
    for before, after in ((s, away), (on(s), on(away))):
        np.testing.assert_allclose(whole(after._rearranged(all_, nothing, nothing)), whole(before), atol=1e-12)
        one, other = before.landmark_covariances(all_), after.landmark_covariances(all_)
        same = np.argsort(before.landmarks.ids), np.argsort(after.landmarks.ids)
        assert_equal_to_rounding(one[same[0]], other[same[1]])


def test_nees_of_runs_as_assumed():
    runs, motion = 12, MotionModel(0.3, 0.15)
    models = EstimatorModels(motion, pixel_sigma=0.5, initial_angular_velocity_sigma=0.2)
    found = []
    for seed in range(runs):
        data = scene(path(40, 0.1, 0.5 * FORWARD, 0.1 * YAW), points=200, seed=seed, limit=25)
        backend = IekfBackend(RIG, models)
        run(backend, data)
        found.append(nees(backend, data.poses[-1]))
    assert np.mean(found) < chi2.ppf(0.9995, 6 * runs) / runs


def test_a_camera_far_from_zero_loses_no_digits():
    """At map coordinates of a country the turn of the world is about the camera's start."""
    drive, there = turning_drive(), se3.pose(np.eye(3), [4e5, -2e5, 5e6])
    backends = [IekfBackend(RIG, replace(MODELS, T_world_left=T)) for T in (np.eye(4), there)]
    for backend in backends:
        run(backend, drive)
    one, other = (backend.estimate(landmarks=False) for backend in backends)
    assert np.abs(se3.inverse(there) @ other.T_world_left - one.T_world_left).max() < 1e-6
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-12)


def test_it_finds_itself_among_known_landmarks():
    before, after = path(15, 0.1, 0.3 * FORWARD, STILL), path(20, 0.1, 0.3 * FORWARD, 0.1 * YAW)
    poses = np.concatenate([before, before[-1] @ se3.exp(np.array([0.05, 0.3, -0.1, 1.5, -0.5, 1.0])) @ after])
    rng = np.random.default_rng(2)
    points = cloud(poses[:1], 60, rng, 6.0, 12.0)
    backend, seen = IekfBackend(RIG, EstimatorModels(MotionModel(0.02, 0.02), pixel_sigma=0.5)), set()
    for k, T in enumerate(before):
        step(backend, 0.1 * k, observe(T, points, 0.5, rng, 60), seen)
    for k, T in enumerate(poses[15:]):
        backend.predict(1.7 + 0.1 * k)
        now = observe(T, points, 0.5, rng, 60)
        backend.update(now.select(np.array([i in seen for i in now.ids.tolist()])))
    assert np.linalg.norm(backend.trajectory().poses[-1][:3, 3] - poses[-1][:3, 3]) < 0.05
    assert nees(backend, poses[-1]) < chi2.ppf(0.9999, 6)


def test_it_has_one_option():
    with pytest.raises(ConfigurationError, match="iekf: unknown option 'papers'; known: iterations"):
        IekfBackend(RIG, papers=True)
    with pytest.raises(ConfigurationError, match="iekf"):
        IekfBackend(RIG, iterations=0)
    data = turning_drive()
    backend = IekfBackend(RIG, MODELS, iterations=1)
    run(backend, data)
    assert errors(backend, data.poses).max() < 0.04


def test_nothing_of_second_order_adds_up():
    """Corrections of centimetres, frame after frame, leave landmarks where they are: the path is the other filter's."""
    one, other = (corridor(name, {}, 150, seed=0) for name in ("ekf", "iekf"))
    assert np.abs((one.errors - other.errors)[-1] / one.deviations[-1]).max() < 0.01
