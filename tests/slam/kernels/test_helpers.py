"""Shared compiled helpers against NumPy and against differences."""

from functools import cache

import numpy as np
import pytest
from numba import njit

from slam.geometry import se3 as reference
from slam.kernels import linear, se3
from tests.slam.numeric import positive

T = reference.exp(np.array([0.3, -0.5, 0.2, 1.0, 2.0, -3.0]))
STEPS = [[0, 0, 0], [1e-9, 0, 0], [2e-5, -1e-5, 0], [9e-3, 0, 1e-3], [0.02, 0.01, 0], [1.0, -0.7, 0.4], [0, 3.1, 0]]


@cache
def called(helper):
    """A helper as a function for Python; helpers can be called from compiled code alone."""
    return njit(lambda *arguments: helper(*arguments))


def filled(helper, *arguments, shape):
    """What a helper writes into its last argument."""
    out = np.full(shape, 7.0)
    called(helper)(*arguments, out)
    return out


def test_median():
    """Of all small numbers of values, many of them equal."""
    rng = np.random.default_rng(3)
    for n in range(1, 40):
        numbers = rng.normal(size=n).round(1)
        assert called(linear.median)(numbers.copy()) == np.median(numbers)


def test_whitening():
    rng = np.random.default_rng(3)
    C, g = positive(3, rng), rng.normal(size=3)
    W = filled(linear.whitener, C, shape=(3, 3))
    np.testing.assert_allclose(W, np.linalg.inv(np.linalg.cholesky(C)), rtol=1e-12, atol=1e-14)
    squared_distance = called(linear.squared_distance)
    assert squared_distance(g, C) == pytest.approx(g @ np.linalg.solve(C, g), rel=1e-12)
    assert np.isnan(squared_distance(g, -C))
    left = np.array([*g[:2], np.nan])
    assert squared_distance(left, C) == pytest.approx(g[:2] @ np.linalg.solve(C[:2, :2], g[:2]), rel=1e-12)
    assert np.isnan(filled(linear.whitener, np.diag([1.0, -1.0, 1.0]), shape=(3, 3))[1, 1])


@pytest.mark.parametrize("turn", STEPS)
def test_exponential_and_logarithm(turn):
    xi = np.array([*turn, 1.0, -2.0, 0.5])
    motion = filled(se3.exp, xi, shape=(3, 4))
    np.testing.assert_allclose(motion, reference.exp(xi)[:3], rtol=0, atol=1e-15)
    w, inverse_J, tangent = np.empty(3), np.empty((3, 3)), np.empty(6)
    called(se3.log)(motion, w, inverse_J, tangent)
    np.testing.assert_allclose(tangent, xi, rtol=0, atol=1e-12)
    np.testing.assert_allclose(inverse_J, np.linalg.inv(reference.so3_left_jacobian(xi[:3])), rtol=0, atol=1e-11)
    moved = T.copy()
    called(se3.move)(moved, xi)
    np.testing.assert_allclose(moved, T @ reference.exp(xi), rtol=0, atol=1e-14)
