from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam.calibration.disparity_offset import SelfCalibration, SelfCalibrationConfig, _move, offset_from_pair

from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.system import StereoSlam
from slam.testing import GENERAL_RIG
from tests.slam.numeric import jacobian
from tests.slam.scene import RIG, Cloud, path

CAR = StereoRig.rectified_pair(700, 601, 183, 0.54, 1226, 370)


def shifted(rig, uv_right, offset):
    """Right pixels with disparities larger by `offset`."""
    rectified_rig = rig.rectified
    return rectified_rig.unrectify_right(rectified_rig.rectify_right(uv_right) - [offset, 0])


def drive(rig=CAR, offset=-0.3, seed=0, noise=0.3, frames=40, step=1.2, outliers=0.0, scale=1.0, **settings):
    """A calibration after a drive through points up to 40 m ahead; `scale` shrinks the world and the step."""
    rng = np.random.default_rng(seed)
    count = 1500
    points = np.column_stack(
        [
            rng.uniform(3, 25, count) * rng.choice([-1, 1], count),
            rng.uniform(-4, 1.6, count),
            rng.uniform(2, 130, count),
        ]
    )
    calibration = SelfCalibration(rig, SelfCalibrationConfig(**settings))
    for k in range(frames):
        T_world_left = se3.exp(np.array([0, 0.02 * np.sin(k / 9), 0, 0, 0, step * k]))
        local = se3.transform(se3.inverse(T_world_left), points)
        left, right = rig.project(scale * local)
        seen = rig.left.in_image(left) & rig.right.in_image(right) & (local[:, 2] < 40) & (rng.random(count) < 0.7)
        ids = np.flatnonzero(seen)
        left = left[ids] + noise * rng.standard_normal((len(ids), 2))
        right = shifted(rig, right[ids], offset) + noise * rng.standard_normal((len(ids), 2))
        wrong = rng.random(len(ids)) < outliers
        left[wrong] += rng.normal(0, 5, (wrong.sum(), 2))
        right[wrong, 0] += rng.normal(0, 8, wrong.sum())
        calibration.observe(ids, left, right)
    return calibration


def test_recovers_the_offset_with_an_honest_sigma():
    z = []
    for offset in (-0.3, 0.2):
        for seed in range(5):
            calibration = drive(offset=offset, seed=seed, prior_probability=1.0)
            assert calibration.sigma < 0.1
            z.append((calibration.offset - offset) / calibration.sigma)
    # |z| < 3 each; the mean of ten is within 3/sqrt(10) of 0 (the prior pulls some 0.3 towards 0), and the spread of
    # ten lies between its 0.1 % quantiles, 0.38 and 1.72, with room below: sigma is inflated by choice.
    assert np.abs(z).max() < 3
    assert abs(np.mean(z)) < 1
    assert 0.25 < np.sqrt(np.mean(np.square(z))) < 1.72


@pytest.mark.parametrize("offset", [-0.3, 0.2])
def test_strong_evidence_overcomes_the_belief_in_the_calibration(offset):
    calibration = drive(offset=offset, seed=1)
    assert calibration.probability > 0.5
    assert abs(calibration.offset - offset) < 3 * calibration.sigma < 0.4


def test_without_an_offset_it_stays_near_zero():
    calibration = drive(offset=0.0, seed=3)
    assert abs(calibration.offset) < 3 * calibration.sigma < 0.3


@pytest.mark.parametrize("noise", [0.3, 0.7])
def test_without_parallax_nothing_is_learnt(noise):
    """Standing still, and landmarks that come and go at random: noise must not look like motion."""
    calibration = drive(step=0.0, noise=noise, kept_share=1.0)
    assert calibration.offset == 0.0 and calibration.sigma == pytest.approx(0.3)


def test_outliers_do_not_lead_astray():
    """One in five observations is wrong, that is a third of the pairs."""
    for seed in range(4):
        calibration = drive(seed=seed, outliers=0.2)
        assert abs(calibration.offset + 0.3) < 3 * calibration.sigma < 0.45


def test_unrectified_rig():
    calibration = drive(GENERAL_RIG, scale=0.2 / 0.54, noise=0.1, seed=1)
    assert abs(calibration.offset + 0.3) < 3 * calibration.sigma < 0.45


def test_a_pair_without_noise_is_exact():
    rng = np.random.default_rng(0)
    R, t = se3.so3_exp(np.array([0.03, -0.1, 0.02])), np.array([0.5, 0.2, -2.0])
    points = np.column_stack([rng.uniform(-300, 300, (30, 2)), rng.uniform(0, 40, 30)])
    moved = _move(points, R, t, 700)[0]
    shift = np.array([0, 0, 0.37])
    offset, information = offset_from_pair(points + shift, moved + shift, 700, 0.0, 0.5, 0.3)
    assert offset == pytest.approx(0.37, abs=1e-3)  # the iteration stops once nothing moves by 0.05 px
    assert information > 0


def test_motion_in_disparity_space_is_the_rigid_one():
    T = se3.exp(np.array([0.03, -0.1, 0.02, 0.5, 0.2, -2.0]))
    points = np.random.default_rng(0).uniform((-5, -3, 6), (5, 3, 30), (20, 3))

    def disparity_space(p):
        z, _ = CAR.project_stereo(p)
        return np.column_stack([z[:, :2] - [CAR.left.u0, CAR.left.v0], z[:, 0] - z[:, 2]])

    x = disparity_space(points)
    f, R, t = CAR.left.fu, T[:3, :3], T[:3, 3] / CAR.baseline
    moved, J_point, J_motion = _move(x, R, t, f)
    np.testing.assert_allclose(moved, disparity_space(se3.transform(T, points)), atol=1e-9)
    for i in range(3):
        numeric = jacobian(lambda p: _move(p[None], R, t, f)[0][0], x[i])
        np.testing.assert_allclose(J_point[i], numeric, rtol=1e-5, atol=1e-5)
        numeric = jacobian(lambda xi, p=x[i]: _move(p[None], se3.so3_exp(xi[:3]) @ R, t + xi[3:], f)[0][0], np.zeros(6))
        np.testing.assert_allclose(J_motion[i], numeric, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("rig", [CAR, GENERAL_RIG], ids=["rectified", "general"])
def test_correction_takes_the_offset_away(rig):
    calibration = drive(seed=2)
    calibration.rig = rig
    points = np.random.default_rng(0).uniform((-2, -1, 5), (2, 1, 10), (20, 3))
    left, right = rig.project(points)
    features = feature_rows(left, shifted(rig, right, calibration.offset))
    features.uv_right[3] = np.nan
    assert calibration.correct(features) is features, "not before it is applied"
    assert calibration.apply() == calibration.offset
    corrected = calibration.correct(features)
    good = np.arange(20) != 3
    np.testing.assert_allclose(corrected.uv_right[good], right[good], atol=1e-6)
    assert np.isnan(corrected.uv_right[3]).all()
    np.testing.assert_array_equal(corrected.uv_left, features.uv_left)


def test_a_change_that_does_not_count_is_not_applied():
    calibration = drive(seed=2)
    assert calibration.apply(least=100.0) == 0.0 == calibration.applied
    assert calibration.apply() == calibration.applied == calibration.offset != 0
    assert calibration.apply() == 0.0


def feature_rows(left, right):
    n = len(left)
    ones = np.ones(n)
    return StereoFeatures(0.0, left, right, ones, ones, ones, np.ones(n, np.int8), np.ones((n, 4), np.float32))


def test_disabled_means_untouched():
    calibration = drive(enabled=False)
    features = feature_rows(np.ones((5, 2)), np.ones((5, 2)))
    assert calibration.offset == calibration.apply() == 0.0
    assert calibration.correct(features) is features


def test_nothing_seen_is_no_error():
    calibration = SelfCalibration(CAR, SelfCalibrationConfig())
    for count in (0, 1, 3, 0):
        calibration.observe(np.arange(count), np.full((count, 2), 200.0), np.full((count, 2), np.nan))
    assert calibration.offset == 0.0


def test_same_input_same_output():
    assert drive(seed=5).offset == drive(seed=5).offset


def test_the_system_corrects_what_it_is_given():
    """With an offset already known, the system's path is the one without offset."""
    cloud, truth = Cloud(150), path(12)
    frames = [cloud.features(T, k / 30, 0.1)[0] for k, T in enumerate(truth)]

    def run(frames, offset):
        config = SystemConfig().with_settings(["map.max_depth_error=0.3", "self_calibration.weakest_pair=0.101"])
        system = StereoSlam(RIG, None, "ekf", config=config)  # nothing more is learnt: no pair is that strong here
        system.calibration._mean, system.calibration._information = offset, 1e6
        for features in frames:
            result = system.process_features(features)
        return result.estimate.T_world_left

    wrong = [replace(f, uv_right=f.uv_right - [0.5, 0]) for f in frames]
    np.testing.assert_allclose(run(wrong, 0.5), run(frames, 0.0), atol=1e-9)
    assert np.abs(run(wrong, 0.0) - run(frames, 0.0)).max() > 1e-3


@pytest.mark.parametrize(
    "setting",
    [
        "prior_sigma=0",
        "max_radius=-1",
        "kept_share=1.5",
        "minimum_common=3",
        "weakest_pair=0.01",
        "prior_probability=0",
        "colour=1",
    ],
)
def test_settings_are_checked(setting):
    with pytest.raises(ConfigurationError, match="self_calibration"):
        SystemConfig().with_settings([f"self_calibration.{setting}"])
