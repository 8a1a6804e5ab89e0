import numpy as np
import pytest
from scipy.stats import chi2

from slam.chi_square import chi_square_limit
from slam.errors import CalibrationError
from slam.geometry import se3
from slam.geometry.rig import StereoRig, measurement_rows
from slam.window.consensus import find_consensus
from slam.window.gating import _passing, squared_distances
from slam.window.pose_only import PoseProblem, solve
from slam.window.stereo import RectifiedStereo
from tests.slam.scene import RIG, Cloud


def measured_from(T, count=80, noise=0.0, seed=0):
    cloud = Cloud(400, seed)
    features, ids = cloud.features(T, 0.0, noise)
    return cloud.points[ids[:count]], measurement_rows(features.uv_left, features.uv_right)[:count]


T_TRUE = se3.exp(np.array([0.05, -0.1, 0.03, 0.2, -0.1, 0.15]))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_consensus_among_wrong_matches(share):
    points, z = measured_from(T_TRUE, noise=0.3)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(points)) < share
    z[wrong] = z[rng.permutation(np.flatnonzero(wrong))]
    moved = np.abs(z[wrong] - measured_from(T_TRUE, noise=0.0)[1][wrong]).max(axis=1) > 3
    found = find_consensus(RIG, points, z, np.eye(4), threshold=2.0, hypotheses=200, seed=0)
    assert found.inliers[~wrong].mean() > 0.98
    assert not found.inliers[np.flatnonzero(wrong)[moved]].any()
    error = se3.log(se3.inverse(T_TRUE) @ found.T_world_left)
    # 0.3 px at f = 300 and 3.5 m, over at least 30 points: 0.3/300/√30 rad and 3.5 m times that; 4 sigmas of it.
    assert np.abs(error[:3]).max() < 4 * 0.3 / 300 / np.sqrt(30) * 2
    assert np.abs(error[3:]).max() < 4 * 3.5 * 0.3 / 300 / np.sqrt(30) * 2


@pytest.mark.parametrize("right", [0, 2, 10])
def test_left_pixels_alone_give_a_pose_far_from_the_guess(right):
    points, z = measured_from(T_TRUE, noise=0.3)
    z[right:, 2] = np.nan
    wrong = np.arange(len(z)) % 2 == 1
    z[wrong] = z[np.roll(np.flatnonzero(wrong), 7)]
    guess = se3.exp(np.array([0.1, 0.3, -0.2, 1.0, 0.5, -0.5]))
    found = find_consensus(RIG, points, z, guess, threshold=2.0, hypotheses=100, seed=0)
    assert found.inliers[~wrong].mean() > 0.95
    assert np.abs(se3.log(se3.inverse(T_TRUE) @ found.T_world_left)).max() < 0.02


def test_cameras_that_are_not_rectified_are_refused():
    points, z = measured_from(T_TRUE)
    other = StereoRig(RIG.left, RIG.right, RIG.R, RIG.b + np.array([0.0, 1e-8, 0.0]))
    with pytest.raises(CalibrationError, match="not rectified"):
        find_consensus(other, points, z, np.eye(4), 2.0, 50, seed=3)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_matches_do_no_harm(count):
    points, z = measured_from(np.eye(4), count)
    found = find_consensus(RIG, points, z, np.eye(4), 2.0, 50, seed=0)
    assert np.isfinite(found.T_world_left).all()
    assert found.inliers.shape == (count,)


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
