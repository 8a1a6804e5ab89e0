import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from slam.geometry import se3

vectors = arrays(float, 3, elements=st.floats(-3, 3))
twists = arrays(float, 6, elements=st.floats(-1.7, 1.7))


@given(twists)
def test_se3_exp_is_the_matrix_exponential(xi):
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = se3.hat(xi[:3]), xi[3:]
    np.testing.assert_allclose(se3.exp(xi), expm(matrix), atol=1e-12)


@given(twists)
def test_log_inverts_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, 1.0, np.pi - 1e-7, np.pi])
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
def test_so3_log_over_all_angles(angle, axis):
    w = se3.so3_log(se3.so3_exp(angle * np.array(axis)))
    assert np.linalg.norm(w) == pytest.approx(angle, abs=1e-9)
    np.testing.assert_allclose(se3.so3_exp(w), se3.so3_exp(angle * np.array(axis)), atol=1e-9)


@given(twists, twists)
def test_adjoint_moves_a_twist_through_a_pose(a, b):
    T = se3.exp(a)
    b = 0.1 * b
    np.testing.assert_allclose(
        T @ se3.exp(b) @ se3.inverse(T), se3.exp(se3.adjoint(T) @ b), atol=1e-12 * (1 + np.abs(a).max()) * 10
    )


@given(vectors, vectors)
def test_left_jacobian(w, d):
    step = 1e-6 * d
    np.testing.assert_allclose(
        se3.so3_exp(w + step), se3.so3_exp(se3.so3_left_jacobian(w) @ step) @ se3.so3_exp(w), atol=1e-10
    )


# --- the papers' angles ---

ANGLES = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)).map(np.array)


@given(ANGLES)
def test_rotation_is_rz_ry_rx(phi):
    x, y, z = (se3.so3_exp(phi[i] * np.eye(3)[i]) for i in range(3))
    np.testing.assert_allclose(se3.rotation(phi), z @ y @ x, atol=1e-14)


@given(ANGLES)
def test_angles_invert_rotation(phi):
    np.testing.assert_allclose(se3.angles(se3.rotation(phi)), phi, atol=1e-9)


@given(ANGLES)
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
