"""The usual mistakes of a file of true poses are named, and one that fits is not doubted."""

import numpy as np
import pytest

from slam.geometry.se3 import exp, inverse, pose, quaternion, rotation_from_quaternion, so3_exp
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.run.truth_check import truth_doubt

TIMES = np.arange(0.003, 15.0, 0.01)  # a motion capture's, between the images


def walk():
    """A hand-held path with turns, as it was and as it is estimated: with noise and drift, in a world of its own."""
    t = TIMES
    turns = np.stack([0.2 * np.sin(0.9 * t), 0.5 * np.sin(0.6 * t), 0.1 * np.cos(1.1 * t)], axis=1)
    places = np.stack([np.sin(0.7 * t), 0.2 * np.sin(1.3 * t), 0.3 * t + 0.2 * np.sin(2 * t)], axis=1)
    truth = Trajectory(t, pose(so3_exp(turns), places))
    rng, rows = np.random.default_rng(0), np.arange(0, len(t), 40)
    drift = exp(np.cumsum(0.0003 * rng.standard_normal((len(rows), 6)), axis=0))
    return Trajectory(t[rows], exp(np.full(6, 0.3)) @ truth.poses[rows] @ drift), truth


OWN, TRUTH = walk()
QUARTER = pose(so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])), np.array([0.1, 0.0, 0.0]))
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x forward, z up


def scaled(factor):
    return pose(TRUTH.poses[:, :3, :3], factor * TRUTH.positions)


def as_read():
    """Quaternions of a file that has w first, read as if it were last."""
    return pose(rotation_from_quaternion(quaternion(TRUTH.poses[:, :3, :3])[:, [3, 0, 1, 2]]), TRUTH.positions)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poses", "late", "words"),
    [
        (TRUTH.poses, 0.0, ""),
        (scaled(1000), 0.0, "is it in mm?"),
        (scaled(100) @ QUARTER, 0.0, "turned by 90"),
        (scaled(0.5 / 39.37), 0.0, "is it in another unit?"),
        (as_read(), 0.0, "quaternions are w x y z"),
        (inverse(TRUTH.poses), 0.0, "its poses are inverse"),
        (TRUTH.poses @ QUARTER, 0.0, "body turned by 90"),
        (TRUTH.poses, 0.25, "its times are 0.25 s too late"),
        (TRUTH.poses, -1.5, "its times are 1.50 s too early"),
        (TRUTH.poses, 0.03, "its times are 0.03 s too late"),  # motions differ by 2 %
        (pose(TRUTH.poses[:, :3, :3], TRUTH.positions @ AHEAD.T), 0.0, "its rotations do not"),
        (np.array([pose(np.eye(3), p) for p in TRUTH.positions]), 0.0, "its rotations do not"),
    ],
)
def test_a_usual_mistake_of_the_truth_is_named_and_alone(poses, late, words):
    said = truth_doubt(OWN, Trajectory(TRUTH.stamps + late, poses))
    assert words in said and bool(words) == bool(said)
    assert "unit= does not apply" in said or "is it in" not in said
    assert said.count("; and ") == (words.startswith("turned by"))


@pytest.mark.slow
def test_what_the_truth_s_own_errors_explain_is_no_mistake_of_it():
    """Positions by satellites, off by as much as the camera moves in a second, and by little of the way; rotations."""
    rng, t = np.random.default_rng(2), np.arange(0.0, 120.0, 0.5)
    ahead = pose(so3_exp(0.2 * np.sin(t)[:, None] * np.array([0.0, 1.0, 0.0])), t[:, None] * np.array([0.0, 0.0, 1.0]))
    noisy = Trajectory(t, pose(ahead[:, :3, :3], ahead[:, :3, 3] + 0.7 * rng.standard_normal((len(t), 3))))
    assert "rotations do not" in truth_doubt(Trajectory(t, ahead), noisy)
    assert truth_doubt(Trajectory(t, ahead), noisy, TruthNoise(translation=0.7)) == ""
    turned = Trajectory(t, ahead @ pose(so3_exp(0.1 * rng.standard_normal((len(t), 3))), np.zeros(3)))
    assert "rotations do not" in truth_doubt(Trajectory(t, ahead), turned)
    assert truth_doubt(Trajectory(t, ahead), turned, TruthNoise(rotation=0.1)) == ""


def test_a_baseline_that_is_wrong_is_not_the_truths_fault():
    said = truth_doubt(OWN, Trajectory(TRUTH.stamps, scaled(1 / 1.3)))
    assert said.startswith("the estimated path is 1.3 times as long")


def test_a_path_that_is_wrong_or_stands_tells_nothing_of_the_truth():
    noise = exp(np.cumsum(0.2 * np.random.default_rng(1).standard_normal((len(OWN), 6)), axis=0))
    still = np.tile(np.eye(4), (len(OWN), 1, 1))
    assert truth_doubt(Trajectory(OWN.stamps, noise), TRUTH) == truth_doubt(Trajectory(OWN.stamps, still), TRUTH)
    assert truth_doubt(OWN.select(np.arange(8)), TRUTH) == ""
