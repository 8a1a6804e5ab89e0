from types import SimpleNamespace

import numpy as np

from slam.evaluation.objects import ObjectScore, motion_errors
from slam.geometry.se3 import exp, inverse
from slam.object_data import MovingObject, ObjectEstimate

RNG = np.random.default_rng(0)
TRUE = np.array([exp(np.array([0.02 * k, 0.01 * k, 0, 0.05 * k, 0, 1 + 0.01 * k])) for k in range(20)])
CHANGE = exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))


def test_motion_error_is_that_of_the_bodys_place():
    """A step that turns 1 degree too much about the body's own origin is no error of its translation."""
    wrong = TRUE.copy()
    wrong[10] = TRUE[10] @ exp(np.array([0, 0, np.radians(1.0), 0, 0, 0]))
    errors = motion_errors(wrong, TRUE)
    np.testing.assert_allclose(errors.rotation[9], 1.0, atol=1e-6)
    assert errors.translation[9] < 1e-9
    wrong[10] = TRUE[10] @ exp(np.array([0, 0, 0, 0.003, 0, 0]))
    np.testing.assert_allclose(motion_errors(wrong, TRUE).translation[9], 0.003, rtol=1e-6)


def test_nees_counts_from_where_a_body_was_found_though_it_is_reported_later():
    """An error that was there at the first report already is an error of the motion since the body was found."""
    stamps, sigma = np.arange(20) / 30.0, 0.01
    score = ObjectScore(TRUE[None], stamps, np.tile(np.eye(4), (20, 1, 1)), 300.0)
    found = TRUE[3] @ CHANGE
    for k in range(6, 20):
        T = TRUE[k] @ CHANGE @ exp(sigma * np.ones(6))
        estimate = ObjectEstimate(
            1, stamps[k], T, sigma**2 * np.eye(6), np.zeros(6), np.eye(6), True, np.arange(4), np.zeros(0, np.int64)
        )
        thing = MovingObject(
            1, np.arange(4), estimate, np.eye(4), T @ inverse(found), np.zeros((2, 3)), True, stamps[3]
        )
        result = SimpleNamespace(
            estimate=SimpleNamespace(T_world_left=np.eye(4)), objects=(thing,), moving_features=np.arange(4),
            features=SimpleNamespace(has_stereo=np.ones(4, bool)),
        )  # fmt: skip
        score.add(k, result, np.ones(4, np.int64))
    np.testing.assert_allclose(score.body(1)["mean NEES"], 6.0, rtol=1e-6)
