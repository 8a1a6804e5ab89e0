from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import se3

angles = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)).map(np.array)


@given(angles)
def test_rotation_is_rz_ry_rx(phi):
    x, y, z = (se3.so3_exp(phi[i] * np.eye(3)[i]) for i in range(3))
    np.testing.assert_allclose(se3.rotation(phi), z @ y @ x, atol=1e-14)


@given(angles)
def test_angles_invert_rotation(phi):
    np.testing.assert_allclose(se3.angles(se3.rotation(phi)), phi, atol=1e-9)


@given(angles)
def test_body_rates_against_finite_differences(phi):
    rate = np.array([0.3, -0.2, 0.5])
    step = 1e-6
    turned = se3.so3_log(se3.rotation(phi - step * rate).T @ se3.rotation(phi + step * rate)) / (2 * step)
    np.testing.assert_allclose(se3.body_rate_matrix(phi) @ rate, turned, atol=1e-7)


@pytest.mark.parametrize("sign", [1, -1])
def test_singular_rotation_comes_back(sign):
    R = se3.rotation(np.array([0.4, sign * np.pi / 2, 0.7]))
    phi = se3.angles(R)
    assert phi[1] == pytest.approx(sign * np.pi / 2)
    np.testing.assert_allclose(se3.rotation(phi), R, atol=1e-7)
