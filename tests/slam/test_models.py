from __future__ import annotations

import numpy as np
import pytest

from slam.errors import ConfigurationError
from slam.geometry import se3
from slam.models import KINDS, EstimatorModels, MotionModel, models_for


def test_the_velocity_variance_is_that_of_a_random_walk():
    motion = MotionModel(acceleration=2.0, angular_acceleration=0.5)
    assert motion.velocity_variance(0.1) == pytest.approx((0.4, 0.025))
    # two short steps add up to a long one, whatever the frame rate
    halves = 2 * np.array(motion.velocity_variance(0.05))
    np.testing.assert_allclose(halves, motion.velocity_variance(0.1))


def test_a_gate_of_one_lets_everything_pass_and_is_refused():
    with pytest.raises(ConfigurationError, match="gate_probability"):
        EstimatorModels(gate_probability=1.0)


def test_the_first_pose_is_the_identity_or_what_is_given():
    np.testing.assert_array_equal(EstimatorModels().initial_pose, np.eye(4))
    T = se3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(EstimatorModels(T_world_left=T.tolist()).initial_pose, T)


def test_kinds_are_found_by_name():
    for name, models in KINDS.items():
        assert models_for(name) is models
    with pytest.raises(ConfigurationError, match="handheld, driving"):
        models_for("flying")
