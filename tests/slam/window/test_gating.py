from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from slam.chi_square import chi_square_limit
from slam.window.gating import _passing, squared_distances
from slam.window.pose_only import PoseProblem, solve
from slam.window.stereo import RectifiedStereo
from tests.slam.scene import RIG


@pytest.mark.parametrize(
    "residual, covariance",
    [
        ([np.nan, 0, 0], np.eye(3)),
        ([np.inf, 0, 0], np.eye(3)),
        ([0, 0, 0], np.diag([1.0, 1.0, -1.0])),
        ([0, 0, 0], np.diag([0.0, 1.0, 1.0])),
        ([0, 0, 0], np.full((3, 3), np.nan)),
        ([0, 0, np.nan], np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1.0]])),
    ],
)
def test_what_cannot_be_judged_does_not_pass(residual, covariance):
    residual, covariance = np.array([residual], float), covariance[None]
    assert np.isinf(squared_distances(residual, covariance)).all()


def test_a_landmark_of_which_too_little_is_known_does_not_take_part_and_fails_nothing():
    stereo, rng = RectifiedStereo.of(RIG), np.random.default_rng(4)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (20, 3))
    noise = np.repeat(np.eye(3)[None], 20, axis=0)
    d = np.array([1.0, 0.7, 0.3])
    noise[7] = 1e18 * np.outer(d, d) - np.eye(3)  # what rounding leaves of a variance of 1e18 along one line
    problem = PoseProblem(stereo, points, stereo.project(points)[0], noise, np.eye(4), np.eye(6), 0.99)
    T, used = solve(problem, np.eye(4))
    np.testing.assert_allclose(T, np.eye(4), atol=1e-9)
    assert used.sum() == 19 and not used[7]
    assert np.isinf(problem.distances(T)[7])


def test_a_left_pixel_alone_is_gated_with_two_degrees_of_freedom():
    stereo, rng = RectifiedStereo.of(RIG), np.random.default_rng(3)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (20, 3))
    z, _ = stereo.project(points)
    z[0, 2] = np.nan
    z[:2, 1] += np.sqrt(6.9)  # between the quantiles at 95 % of χ²(2) and χ²(3), 6.0 and 7.8
    known = 1e8 * np.eye(6)
    problem = PoseProblem(stereo, points, z, np.tile(np.eye(3), (20, 1, 1)), np.eye(4), known, 0.95)
    np.testing.assert_array_equal(solve(problem, np.eye(4))[1], np.arange(20) > 0)


@pytest.mark.parametrize("dof", [2, 3])
@pytest.mark.parametrize("scatter", [5.0, 20.0, 100.0])
def test_how_many_wrong_observations_pass_follows_from_those_that_do_not(scatter, dof):
    limit = chi_square_limit(dof, 0.999)
    distances = scatter * np.random.default_rng(0).chisquare(dof, 20000)
    assert _passing(distances[distances > limit], dof, 0.999) == pytest.approx(chi2.cdf(limit / scatter, dof), rel=0.1)
