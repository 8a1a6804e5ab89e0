from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from slam.calibration.robust import student_weights


@pytest.mark.parametrize("dof", [1, 3])
def test_good_residuals_weigh_the_inverse_of_their_variance_and_outliers_next_to_nothing(dof):
    squared = 4.0 * chi2.ppf((np.arange(1000) + 0.5) / 1000, dof)  # of residuals with twice the configured noise
    weights = student_weights(np.append(squared, 4e4), dof, 0.01)
    assert weights[:1000].mean() == pytest.approx(0.25, rel=0.1)
    assert weights[-1] < 1e-3


def test_the_scale_has_a_floor_and_nothing_needs_no_scale():
    assert student_weights(np.zeros(5), 1, 0.5) == pytest.approx(np.full(5, 5 / 4 / 0.25))
    assert student_weights(np.zeros(0), 3, 0.5).shape == (0,)
