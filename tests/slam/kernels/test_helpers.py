"""Shared compiled helpers against NumPy and against differences."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry import se3 as reference
from slam.geometry.rig import StereoRig
from slam.kernels import se3

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
