"""Shared compiled helpers against NumPy and against differences."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry import se3 as reference
from slam.geometry.rig import StereoRig
from slam.kernels import linear, se3, stereo
from tests.slam.numeric import jacobian, positive

RIG = StereoRig.rectified_pair(450.0, 320.0, 240.0, 0.12, 640, 480, doffs=3.0)
CAMERA = RIG.rectified_parameters
T = reference.exp(np.array([0.3, -0.5, 0.2, 1.0, 2.0, -3.0]))
OTHER = reference.exp(np.array([-0.2, 0.1, 0.7, 0.5, -1.0, 2.0]))
POINT = np.array([0.4, -0.3, 2.5])  # in front of the camera at T
STEPS = [[0, 0, 0], [1e-9, 0, 0], [2e-5, -1e-5, 0], [9e-3, 0, 1e-3], [0.02, 0.01, 0], [1.0, -0.7, 0.4], [0, 3.1, 0]]


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def call(helper, *arguments):
    """A helper's value; helpers can be called from compiled code alone."""
    from numba import njit

    return njit(lambda *all_of_them: helper(*all_of_them))(*arguments)


def filled(helper, *arguments, shape):
    """What a helper writes into its last argument."""
    out = np.full(shape, 7.0)
    call(helper, *arguments, out)
    return out


@pytest.mark.parametrize("values", [[2], [3, 1], [5, 1, 3], [1, 1, 2, 2, 1, 2], [4, 3, 2, 1, 0], "random"])
def test_median(values, rng):
    for n in range(1, 40) if values == "random" else [0]:
        numbers = rng.normal(size=n).round(1) if n else np.array(values, float)
        assert call(linear.median, numbers.copy()) == np.median(numbers)


@pytest.mark.parametrize("n", [1, 3, 6, 20])
def test_factorise_and_solve(n, rng):
    M, v = positive(n, rng), rng.normal(size=n)
    factor, x = np.tril(M) + np.triu(np.full((n, n), np.nan), 1), v.copy()
    call(linear.factorise, factor, n)
    call(linear.solve_factorised, factor, n, x)
    L = np.tril(factor, -1) + np.eye(n)
    np.testing.assert_allclose(L @ np.diag(factor.diagonal()) @ L.T, M, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(x, np.linalg.solve(M, v), rtol=1e-9, atol=1e-12)


def test_whitening(rng):
    C, g = positive(3, rng), rng.normal(size=3)
    W = filled(linear.whitener, C, shape=(3, 3))
    np.testing.assert_allclose(W, np.linalg.inv(np.linalg.cholesky(C)), rtol=1e-12, atol=1e-14)
    assert call(linear.squared_distance, g, C) == pytest.approx(g @ np.linalg.solve(C, g), rel=1e-12)
    assert np.isnan(call(linear.squared_distance, g, -C))
    left = np.array([*g[:2], np.nan])
    assert call(linear.squared_distance, left, C) == pytest.approx(g[:2] @ np.linalg.solve(C[:2, :2], g[:2]), rel=1e-12)
    assert np.isnan(filled(linear.whitener, np.diag([1.0, -1.0, 1.0]), shape=(3, 3))[1, 1])


@pytest.mark.parametrize("turn", STEPS)
def test_exponential_and_logarithm(turn):
    xi = np.array([*turn, 1.0, -2.0, 0.5])
    motion = filled(se3.exp, xi, shape=(3, 4))
    np.testing.assert_allclose(motion, reference.exp(xi)[:3], rtol=0, atol=1e-15)
    w, inverse_J, tangent = np.empty(3), np.empty((3, 3)), np.empty(6)
    call(se3.log, motion, w, inverse_J, tangent)
    np.testing.assert_allclose(tangent, xi, rtol=0, atol=1e-12)
    np.testing.assert_allclose(inverse_J, np.linalg.inv(reference.so3_left_jacobian(xi[:3])), rtol=0, atol=1e-11)
    moved = T.copy()
    call(se3.move, moved, xi)
    np.testing.assert_allclose(moved, T @ reference.exp(xi), rtol=0, atol=1e-14)


def test_derivatives_of_a_point_by_a_motion():
    found = filled(se3.point_by_motion, POINT, 2.0, shape=(3, 6))
    expected = jacobian(lambda xi: reference.transform(reference.exp(2.0 * xi), POINT[None]), np.zeros(6))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def predicted(pose, point):
    """(uL, vL, uR) of a point in the world, by the rig."""
    local = reference.transform(reference.inverse(pose), point[None])
    return RIG.project_stereo(local)[0][0]


def test_stereo_residual_and_its_derivatives():
    world = reference.transform(T, POINT[None])[0]
    measured = predicted(T, world) + np.array([1.0, -2.0, 3.0])
    r, J, by_pose, by_point = np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    assert call(stereo.residual, CAMERA, POINT, measured, r, J)
    np.testing.assert_allclose(r, [1.0, -2.0, 3.0], atol=1e-11)
    for k in range(3):
        call(stereo.by_pose, J[k], POINT, by_pose[k])
        call(stereo.by_point, J[k], T, by_point[k])
    expected = jacobian(lambda xi: predicted(T @ reference.exp(xi), world), np.zeros(6))
    np.testing.assert_allclose(by_pose, expected, atol=1e-5)
    np.testing.assert_allclose(by_point, jacobian(lambda p: predicted(T, p), world), atol=1e-5)


def test_no_residual_behind_the_camera_nor_where_nothing_is_measured():
    r, J = np.empty(3), np.empty((3, 3))
    assert not call(stereo.residual, CAMERA, -POINT, np.zeros(3), r, J)
    assert np.isnan(r).all() and (J == 0).all()
    assert call(stereo.residual, CAMERA, POINT, np.array([0.0, 0.0, np.nan]), r, J)
    assert np.isnan(r).tolist() == [False, False, True] and np.isfinite(J).all()
