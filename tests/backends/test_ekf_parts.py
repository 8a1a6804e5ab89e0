"""The filter's arithmetic, each part against the plain dense formula or finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from backends.ekf.angles import (
    CANONICAL,
    anchor,
    attitude,
    body_rate_derivative,
    pose_jacobian,
    reanchor,
)
from backends.ekf.jacobian import Displacement, Jacobian
from backends.ekf.landmarks import Euclidean, InverseDepth, Landmarks
from backends.ekf.measurement import StereoMeasurement, innovation_covariances
from backends.ekf.solve import Problem, UnsolvableError, _iterate, gate, solve
from slam.errors import MeasurementError
from slam.geometry import se3
from slam.geometry.euler import angles, body_rate_matrix, rotation
from slam.testing import GENERAL_RIG
from tests.backends.scenes import RIG
from tests.slam.numeric import jacobian, positive

ATTITUDES = [np.array(phi) for phi in ([0.0, 0, 0], [0.3, -0.7, 2.0], [1.5, 1.2, -3.0], [-2.0, -1.4, 0.5])]


# --- the angles' world ---


def test_the_camera_starts_level_in_the_angles_world():
    R = se3.so3_exp(np.array([0.4, -0.8, 2.0]))
    R_world_angles, phi = anchor(R)
    np.testing.assert_allclose(attitude(R_world_angles, phi), R, atol=1e-12)
    np.testing.assert_allclose(phi, [np.pi / 2, 0, np.pi / 2], atol=1e-12)


@pytest.mark.parametrize("axis, changes", [(1, 2), (0, 0), (2, 1)])  # heading: φz; up and down: φx; roll: φy
def test_turning_about_one_camera_axis_changes_one_angle(axis, changes):
    turn = np.zeros(3)
    turn[axis] = 0.3
    change = angles(CANONICAL @ se3.so3_exp(turn)) - angles(CANONICAL)
    assert abs(change[changes]) == pytest.approx(0.3)
    assert np.abs(np.delete(change, changes)).max() < 1e-12


@pytest.mark.parametrize("phi", ATTITUDES)
def test_the_pose_jacobian_is_the_derivative(phi):
    world, r = se3.so3_exp(np.array([0.2, 1.0, -0.4])), np.array([1.0, -2.0, 3.0])
    T = se3.pose(attitude(world, phi), r)

    def perturbation(x):
        R = attitude(world, x[3:])
        return np.concatenate([se3.so3_log(T[:3, :3].T @ R), T[:3, :3].T @ (x[:3] - r)])

    expected = jacobian(perturbation, np.concatenate([r, phi]))
    np.testing.assert_allclose(pose_jacobian(T[:3, :3], phi), expected, atol=1e-8)


@pytest.mark.parametrize("phi", ATTITUDES)
def test_the_body_rate_derivative(phi):
    omega = np.array([0.7, -1.1, 0.4])
    expected = jacobian(lambda x: body_rate_matrix(x) @ omega, phi)
    np.testing.assert_allclose(body_rate_derivative(phi, omega), expected, atol=1e-8)


@pytest.mark.parametrize("phi", ATTITUDES)
def test_a_new_angles_world_is_the_same_state(phi):
    rng = np.random.default_rng(0)
    world, state = se3.so3_exp(rng.standard_normal(3)), rng.standard_normal(12)
    state[3:6] = phi
    new_world, new, _ = reanchor(world, state)
    np.testing.assert_allclose(attitude(new_world, new[3:6]), attitude(world, phi), atol=1e-12)
    body = body_rate_matrix(phi) @ state[9:12]
    np.testing.assert_allclose(body_rate_matrix(new[3:6]) @ new[9:12], body, atol=1e-12)
    np.testing.assert_array_equal(new[[0, 1, 2, 6, 7, 8]], state[[0, 1, 2, 6, 7, 8]])


@pytest.mark.parametrize("phi", ATTITUDES)
def test_the_jacobian_of_a_new_angles_world(phi):
    rng = np.random.default_rng(1)
    world, state = se3.so3_exp(rng.standard_normal(3)), rng.standard_normal(12)
    state[3:6] = phi
    new_world, _, J = reanchor(world, state)

    def moved(x):  # the same change of variables with the new world held fixed
        after = x.copy()
        after[3:6] = angles(new_world.T @ attitude(world, x[3:6]))
        after[9:12] = np.linalg.solve(body_rate_matrix(after[3:6]), body_rate_matrix(x[3:6]) @ x[9:12])
        return after

    np.testing.assert_allclose(J, jacobian(moved, state), atol=1e-7)


# --- measurements ---


def model(rig, world) -> StereoMeasurement:
    """With landmarks in world coordinates: they have no anchors."""
    return StereoMeasurement(rig, world, Euclidean(), np.zeros((0, 3, 4)))


def linearise(rig, world, pose, points):
    return model(rig, world).linearise(np.concatenate([pose, points.reshape(-1)]))


def dense(line, rows: np.ndarray, displacement: Displacement | None = None) -> np.ndarray:
    H = Jacobian.of(line, rows, displacement)
    whole = H.times(np.eye(6 + 3 * len(rows)))
    np.testing.assert_allclose(H.transposed_times(np.eye(3 * len(rows))).T, whole, atol=1e-9)
    return whole


def test_products_with_the_jacobian():
    rng = np.random.default_rng(7)
    points = rng.uniform((-1, -1, 4), (1, 1, 10), (5, 3))
    line, rows = linearise(RIG, np.eye(3), np.zeros(6), points), np.ones((5, 3), bool)
    rows[3] = rows[1, 2] = False
    U, L, P = rng.standard_normal((21, 6)), rng.standard_normal((6, 21)), positive(21, rng)
    plain, reduced = dense(line, rows), dense(line, rows, Displacement(U, L))
    np.testing.assert_allclose(reduced, plain - plain @ U @ L, atol=1e-8)
    H = Jacobian.of(line, np.ones((5, 3), bool), Displacement(U, L)).only(rows)
    np.testing.assert_allclose(H.times(H.times(P).T), reduced @ P @ reduced.T, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("rig", [RIG, GENERAL_RIG], ids=["rectified", "general"])
@pytest.mark.parametrize("phi", ATTITUDES)
def test_measurement_jacobians(rig, phi):
    rng = np.random.default_rng(2)
    world, r = se3.so3_exp(rng.standard_normal(3)), rng.standard_normal(3)
    h = rng.uniform((-1, -1, 4), (1, 1, 10), (5, 3))
    points = h @ attitude(world, phi).T + r
    line = linearise(rig, world, np.concatenate([r, phi]), points)
    np.testing.assert_allclose(line.z, rig.project_stereo(h)[0], atol=1e-9)

    measured = model(rig, world).predict
    x = np.concatenate([r, phi, points.reshape(-1)])
    everything = np.ones((5, 3), bool)
    np.testing.assert_allclose(dense(line, everything), jacobian(measured, x), rtol=1e-6, atol=1e-5)


def test_rows_not_measured_are_zero():
    line = linearise(RIG, np.eye(3), np.zeros(6), np.array([[0.1, 0.2, 5.0], [0.3, -0.1, -4.0]]))
    rows = np.array([[True, True, False], [False] * 3])
    H = dense(line, rows)
    assert np.isfinite(H).all() and (H[2:] == 0).all() and (H[:2, :9] != 0).any(axis=1).all()


def test_innovation_covariances_are_blocks_of_the_dense_ones():
    rng = np.random.default_rng(3)
    points = rng.uniform((-1, -1, 4), (1, 1, 10), (4, 3))
    line = linearise(RIG, np.eye(3), np.zeros(6), points)
    P = positive(6 + 12, rng)
    H = dense(line, np.ones((4, 3), bool))
    S = H @ P @ H.T + 0.25 * np.eye(12)
    cross = P[6:, :6].reshape(4, 3, 6)
    blocks = np.array([P[6 + 3 * i : 9 + 3 * i, 6 + 3 * i : 9 + 3 * i] for i in range(4)])
    found = innovation_covariances(line, P[:6, :6], cross, blocks) + 0.25 * np.eye(3)
    for i in range(4):
        np.testing.assert_allclose(found[i], S[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], rtol=1e-9)


# --- the landmarks' coordinates ---


@pytest.mark.parametrize("coordinates", [InverseDepth(), Euclidean()], ids=["inverse depth", "euclidean"])
def test_coordinates_there_and_back(coordinates):
    rng = np.random.default_rng(0)
    anchors = np.concatenate([se3.so3_exp(rng.standard_normal((5, 3))), rng.standard_normal((5, 3, 1))], axis=2)
    local = rng.uniform((-2, -2, 1), (2, 2, 60), (5, 3))
    points = (anchors[:, :, :3] @ local[:, :, None])[:, :, 0] + anchors[:, :, 3]
    c = coordinates.of(anchors, points)
    np.testing.assert_allclose(coordinates.points(anchors, c), points, atol=1e-10)
    for i, D in enumerate(coordinates.jacobian(anchors, c)):
        numeric = jacobian(lambda x, i=i: coordinates.points(anchors[[i]], x[None])[0], c[i], 1e-6 * abs(c[i, 2]))
        np.testing.assert_allclose(D, numeric, rtol=1e-4, atol=1e-4)


def test_a_pixel_error_at_first_sight_is_linear_in_inverse_depth():
    h = np.array([[3.0, -1.0, 60.0]])
    anchor = np.eye(3, 4)[None]
    z = RIG.project_stereo(h)[0]
    c = [InverseDepth().of(anchor, RIG.triangulate(z[:, :2], z[:, [2, 1]] + [d, 0]))[0] for d in (-0.5, 0.0, 0.5)]
    np.testing.assert_allclose(c[0] + c[2], 2 * c[1], atol=1e-12)


def test_landmarks_keep_their_names():
    marks, anchors = Landmarks(InverseDepth()), np.tile(np.eye(3, 4), (4, 1, 1))
    points = np.arange(12.0).reshape(4, 3) + 1
    marks.append(np.array([7, 3, 9, 1]), anchors, points)
    marks.remove(np.array([3, 9]), np.array([1]), np.array([3]))
    assert marks.ids.tolist() == [7, 1] and marks.slots([1, 7]).tolist() == [1, 0]
    np.testing.assert_allclose(marks.points, points[[0, 3]])
    with pytest.raises(MeasurementError, match="landmark 3 is not in the map"):
        marks.slots([3])
    with pytest.raises(MeasurementError, match="landmark 7 is in the map already"):
        marks.require_new(np.array([4, 7]))


# --- the update on the gathered state ---


def far_off(iterations: int, guess: bool = False) -> Problem:
    """An update whose prior is 1.5 m and 0.15 rad off, with points at 4 to 8 m."""
    rng = np.random.default_rng(13)
    world, phi = anchor(np.eye(3))
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (12, 3))
    truth = np.concatenate([[0.3, -0.2, 1.5], phi + np.array([0.05, 0.15, -0.1])])
    z = linearise(RIG, world, truth[:6], points).z + 0.5 * rng.standard_normal((12, 3))
    prior = np.concatenate([np.zeros(3), phi, points.reshape(-1)])
    prior[6:] += 0.05 * rng.standard_normal(36)
    P = np.diag(np.concatenate([np.full(3, 1.5**2), np.full(3, 0.2**2), np.full(36, 0.05**2)]))
    return Problem(prior, P, z, 0.5, model(RIG, world), iterations, 0.9999, truth - prior[:6] if guess else None)


def cost(problem: Problem, x: np.ndarray) -> float:
    d = x - problem.prior
    residual = (problem.z - problem.model.predict(x)).reshape(-1) / problem.sigma
    return float(d @ np.linalg.solve(problem.covariance, d) + residual @ residual)


@pytest.mark.parametrize("guess", [False, True])
def test_the_iterated_update_is_the_maximum_of_the_posterior(guess, monkeypatch):
    monkeypatch.setattr("backends.ekf.solve._LINEAR", 1e-6)
    problem = far_off(30, guess)
    solution = solve(problem, replace(gate(problem), used=np.ones(12, bool)))
    x = problem.prior + problem.covariance @ solution.s
    deviation = np.sqrt(np.diag(problem.covariance))

    def residuals(step):  # whitened by the prior, so that a general solver has an easy time
        x = problem.prior + deviation * step
        return np.concatenate([step, ((problem.z - problem.model.predict(x)) / problem.sigma).reshape(-1)])

    best = least_squares(residuals, np.zeros(42), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(x, problem.prior + deviation * best.x, atol=1e-5)
    assert solution.nis == pytest.approx(2 * best.cost, rel=1e-3)  # νᵀS⁻¹ν there is the least cost


def test_more_iterations_never_raise_the_cost():
    costs = []
    for iterations in (2, 3, 5, 8):
        problem = far_off(iterations)
        solution = solve(problem, replace(gate(problem), used=np.ones(12, bool)))
        costs.append(cost(problem, problem.prior + problem.covariance @ solution.s))
    assert costs[0] < cost(problem, problem.prior) and (np.diff(costs) <= 1e-9).all()
    assert costs[-1] < 2 * 36


def test_a_step_that_lowers_no_cost_is_no_information(monkeypatch):
    """Where the mean does not move towards the measurements, the variance must not fall either."""
    problem = far_off(5)
    monkeypatch.setattr("backends.ekf.solve._descend", lambda problem, rows, now, target: (now, False))
    with pytest.raises(UnsolvableError, match="cost"):
        solve(problem, replace(gate(problem), used=np.ones(12, bool)))


def test_conditional_distances_are_what_leaving_out_would_change():
    """A landmark's squared distance from what the others predict is the fall of the NIS when it is left out."""
    problem = far_off(1)
    everything = np.ones(12, bool)
    gated = gate(problem)
    whole = _iterate(problem, everything, gated.start, gated.system)
    for j in (0, 5, 11):
        without = _iterate(problem, np.arange(12) != j, gated.start, gated.system)
        assert whole.nis - without.nis == pytest.approx(whole.distances[j], rel=1e-6)


def test_a_large_displacement_of_the_world_changes_no_prediction():
    """By metres, in coordinates that are not linear in it: nor does an update that is linearised there measure it."""
    rng = np.random.default_rng(3)
    world, phi = anchor(np.eye(3))
    points = rng.uniform((-4, -2, 8), (4, 2, 30), (40, 3))
    anchors, coordinates = np.tile(np.eye(3, 4), (40, 1, 1)), InverseDepth()
    c = coordinates.of(anchors, points)
    inverse = np.linalg.inv(coordinates.jacobian(anchors, c))
    gauge_jacobian = np.zeros((126, 6))
    gauge_jacobian[:3, :3] = np.eye(3)
    gauge_jacobian[3:6, 3:] = np.linalg.inv(world @ rotation(phi) @ body_rate_matrix(phi))
    gauge_jacobian[6:] = np.concatenate([inverse, -inverse @ se3.hat(points)], axis=2).reshape(-1, 6)
    own = np.diag(np.concatenate([np.full(3, 0.1**2), np.full(3, 0.01**2), np.tile([1e-6, 1e-6, 1e-7], 40)]))
    P = own + gauge_jacobian @ np.diag(np.repeat([3.0, 0.03], 3) ** 2) @ gauge_jacobian.T
    prior = np.concatenate([np.zeros(3), phi, c.reshape(-1)])
    measurement = StereoMeasurement(RIG, world, coordinates, anchors)
    z = measurement.predict(prior)
    problem = Problem(prior, 0.5 * (P + P.T), z, 0.5, measurement, 5, 0.999, gauge_jacobian=lambda: gauge_jacobian)
    change = gauge_jacobian @ np.array([2.0, -1.0, 3.0, 0.03, -0.02, 0.05])
    assert np.nanmax(np.abs(measurement.predict(prior + change) - z)) > 1.0
    np.testing.assert_allclose(measurement.predict(problem.mean(change)), z, atol=1e-5)
    there = change + np.linalg.cholesky(own) @ rng.standard_normal(126)
    H = problem.jacobian(measurement.linearise(problem.mean(there)), np.ones((40, 3), bool), there)
    np.testing.assert_allclose(H.times(gauge_jacobian), 0, atol=1e-4)  # [px/m], [px/rad]
