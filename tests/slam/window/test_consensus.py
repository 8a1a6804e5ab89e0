from __future__ import annotations

import numpy as np
import pytest

from slam.errors import CalibrationError
from slam.geometry import se3
from slam.geometry.rig import StereoRig, measurement_rows
from slam.window.consensus import PoseConsensus, find_consensus
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


def test_the_same_seed_gives_the_same_answer():
    points, z = measured_from(T_TRUE, noise=0.5)
    z[::2] = z[::-2]
    a, b = (find_consensus(RIG, points, z, np.eye(4), 2.0, 50, seed=3) for _ in range(2))
    np.testing.assert_array_equal(a.T_world_left, b.T_world_left)
    np.testing.assert_array_equal(a.inliers, b.inliers)


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


def test_no_tried_pose_has_more_that_agree_than_the_one_returned(monkeypatch):
    """Of the guess, what is nearer to the matches, and a hypothesis, the second may be the best without a majority."""
    counts = iter([3, 6, 4])
    found = lambda *_: PoseConsensus(np.eye(4), np.arange(12) < next(counts))  # noqa: E731
    monkeypatch.setattr("slam.window.consensus._Matches.polished", found)
    points, z = measured_from(T_TRUE, count=12)
    assert find_consensus(RIG, points, z, np.eye(4), 2.0, 50, seed=3).inliers.sum() == 6
