"""The motion model's derivatives, also where frames come at uneven times."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.se3 import exp, inverse, log
from slam.window.motion import predict
from tests.slam.numeric import jacobian


@pytest.mark.parametrize("intervals", [(0.1, 0.1), (0.1, 0.25), (0.4, 0.1)])
def test_derivatives_of_the_next_pose_are_those_of_differences(intervals):
    rng = np.random.default_rng(5)
    T0 = exp(rng.standard_normal(6) / 3)
    T1 = T0 @ exp(rng.standard_normal(6) / 10)
    T2, J0, J1, _ = predict(T0, T1, *intervals)

    def moved(change: np.ndarray) -> np.ndarray:
        return log(inverse(T2) @ predict(T0 @ exp(change[:6]), T1 @ exp(change[6:]), *intervals)[0])

    np.testing.assert_allclose(np.hstack([J0, J1]), jacobian(moved, np.zeros(12)), atol=1e-8)
