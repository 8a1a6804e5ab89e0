from __future__ import annotations

import numpy as np

from slam.objects.metrics import absolute_pose_errors, body_alignment, motion_errors, object_nees
from slam.se3 import exp

RNG = np.random.default_rng(0)
TRUE = np.array([exp(np.array([0.02 * k, 0.01 * k, 0, 0.05 * k, 0, 1 + 0.01 * k])) for k in range(20)])
CHANGE = exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))


def test_errors_do_not_depend_on_the_choice_of_the_body_frame():
    other = TRUE @ CHANGE
    for delta in (1, 5):
        errors = motion_errors(other, TRUE, delta)
        assert errors.rotation.max() < 1e-5 and errors.translation.max() < 1e-9
    errors = absolute_pose_errors(other, TRUE)
    assert errors.rotation.max() < 1e-5 and errors.translation.max() < 1e-9
    np.testing.assert_allclose(body_alignment(TRUE, other), CHANGE, atol=1e-9)


def test_motion_error_is_that_of_the_bodys_place():
    """A step that turns 1 degree too much about the body's own origin is no error of its translation."""
    wrong = TRUE.copy()
    wrong[10] = TRUE[10] @ exp(np.array([0, 0, np.radians(1.0), 0, 0, 0]))
    errors = motion_errors(wrong, TRUE)
    np.testing.assert_allclose(errors.rotation[9], 1.0, atol=1e-6)
    assert errors.translation[9] < 1e-9
    wrong[10] = TRUE[10] @ exp(np.array([0, 0, 0, 0.003, 0, 0]))
    np.testing.assert_allclose(motion_errors(wrong, TRUE).translation[9], 0.003, rtol=1e-6)


def test_nees_of_gaussian_errors_is_its_dimension():
    P = np.diag([1e-4] * 3 + [1e-5] * 3)
    true = np.repeat(TRUE, 50, axis=0)
    errors = RNG.multivariate_normal(np.zeros(6), P, len(true))
    values = object_nees(true @ exp(errors), np.repeat(P[None], len(true), axis=0), true)
    # 1000 values of mean 6 and variance 12: a deviation of 0.11 on the mean.
    assert abs(values.mean() - 6) < 0.4
