from dataclasses import replace

import numpy as np
import pytest

from slam.calibration import RigCorrection, RigModel, RigPosterior, SelfCalibration, SelfCalibrationConfig
from slam.calibration.posterior import prior_information
from slam.config import SystemConfig
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.system import StereoSlam
from tests.slam.calibration.drives import CAR, Street, disparity_error, drive, parameters, pose, residual_fields
from tests.slam.scene import BACKENDS, GENERAL_RIG, RIG, Cloud, features_at

#: A turn of the right camera after a knock [rad].
TURNED = parameters(pitch=5e-4, yaw=5e-4, roll=5e-4)


def z_scores(calibration, theta):
    posterior = calibration.posterior
    return (posterior.mean - theta) / posterior.sigma


def test_the_posterior_holds_what_it_claims():
    """NEES over seeds, of rigs drawn from the prior, with fields that no parameter holds and errors of the matching."""
    root = np.linalg.cholesky(np.linalg.inv(prior_information(RigModel(CAR))))
    nees = []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        theta = (1.0, 0.3)[seed % 2] * root @ rng.standard_normal(len(root))
        calibration = drive(theta, seed, frames=20, residual=residual_fields(rng))
        posterior, error = calibration.posterior, calibration.posterior.mean - theta
        nees.append(float(error @ np.linalg.solve(posterior.covariance, error)) / len(theta))
        assert posterior.sigma[posterior.names.index("roll")] < 5e-4  # of 4e-3 beforehand
    # 6 times 21 degrees of freedom have their mean in 0.62 to 1.48 with 99.9 %.
    assert 0.62 < np.mean(nees) < 1.48, nees


@pytest.mark.parametrize("theta", [TURNED, parameters(right_cx=-0.4 / 720)], ids=["turned", "offset"])
def test_an_error_of_the_rig_is_found_and_corrected(theta):
    calibration = drive(theta, seed=1)
    assert np.abs(z_scores(calibration, theta)).max() < 3
    assert disparity_error(calibration, theta) < 0.1 < 0.3 < disparity_error(drive(frames=1), theta)
    assert calibration.unsolved == 0 and calibration.pairs > 10 and calibration.apply() is not None
    seen, ideal = (Street(2).features(0.0, np.eye(4), p, noise=0.0) for p in (theta, None))
    disparity = [f.uv_left[:, 0] - f.uv_right[:, 0] for f in (calibration.correct(seen), ideal)]
    assert abs(np.median(disparity[0] - disparity[1])) < 0.1


def test_pairs_without_a_common_motion_are_counted_and_told():
    calibration, rng, street = SelfCalibration(CAR, SelfCalibrationConfig()), np.random.default_rng(3), Street(3)
    for k in range(6):
        looks, n = street.descriptors[50 * k : 50 * k + 80], 80  # 30 of them are in the next view
        left = rng.uniform([100, 50], [1100, 320], (n, 2))
        right = left - np.column_stack([rng.uniform(5, 60, n), np.zeros(n)])
        calibration.observe(features_at(left, right, looks, k), pose(k))
    assert calibration.pairs == 0
    assert calibration.summary()["unsolved_pairs"] == calibration.unsolved >= 4


FOCAL = parameters(left_f=0.005, right_f=0.005)


def common_focal(calibration):
    """Mean and standard deviation of the focal length's error that both cameras share."""
    posterior = calibration.posterior
    w = 0.5 * (FOCAL > 0)
    return w @ posterior.mean, np.sqrt(w @ posterior.covariance @ w)


def quarter_turn(theta, rig=CAR):
    """The calibration of `rig` after a quarter turn of the car among points all around."""
    street = Street(4, count=4000)
    rng, count = np.random.default_rng(0), len(street.points)
    angle, radius = rng.uniform(-np.pi, np.pi, count), rng.uniform(15, 45, count)
    street.points[:, ::2] = radius[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    calibration = SelfCalibration(rig, SelfCalibrationConfig())
    for k in range(40):
        yaw = np.deg2rad(90) * k / 39
        T = se3.exp(np.array([0, yaw, 0, 0, 0, 0]))
        T[:3, 3] = [8 - 8 * np.cos(yaw), 0, 8 * np.sin(yaw)]
        calibration.observe(street.features(0.1 * k, T, theta, noise=0.3), T)
    return calibration


@pytest.mark.parametrize("theta", [FOCAL, FOCAL + TURNED])
def test_a_common_error_of_the_focal_lengths_is_found_in_a_turn(theta):
    calibration = quarter_turn(theta)
    assert np.abs(z_scores(calibration, theta)).max() < 3
    mean, sigma = common_focal(calibration)
    assert abs(mean - 0.005) < 3 * sigma < 0.0075
    assert mean > (0.001 if theta[-4] else 0.0025)
    assert calibration.doubt == ""


@pytest.mark.parametrize(
    ("share", "wrong", "said_as", "words"),
    [
        (1.2, {}, "doubt", "% shorter than the calibration's: is it of this camera"),
        (0.8, {}, "doubt", "% longer than the calibration's: is it of this camera"),
        (
            1.0,
            {"left_k1": 0.2, "right_k1": 0.2},
            "doubt",
            "a lens distortion that is not in the calibration (k1 about -0.",
        ),
        (1.0, {"right_cx": 0.01}, "doubt", "disparities about"),
        (1.0, {"roll": 0.03}, "doubt", "a right camera that is turned by about 1.7°"),
        (1.1, {}, "warning", "% shorter than"),
        (0.9, {}, "warning", "% longer than"),
        (1.0, {}, "warning", ""),
    ],
)
def test_what_no_calibration_of_this_camera_has_is_named(share, wrong, said_as, words):
    rig = CAR.rectified_pair(share * CAR.left.fu, CAR.left.u0, CAR.left.v0, CAR.baseline, CAR.width, CAR.height)
    said = getattr(quarter_turn(parameters(**wrong), rig), said_as)
    assert words in said and bool(said) == bool(words)


@pytest.mark.parametrize(("off", "frames"), [(0.0, 30), (0.5, 30), (1.0, 30), (0.0, 10)])
def test_cropped_images_are_believed_where_they_show_that_the_calibration_is_theirs(off, frames):
    """Its principal point is far from their middle; the true one is so much of the way nearer to that."""
    rig = StereoRig.rectified_pair(720, 238, 166, 0.54, 807, 293)
    x = off * (238 - 403) / 720
    calibration = drive(parameters(left_cx=x, right_cx=x), seed=1, frames=frames, rig=rig)
    assert ("is far from the middle of the images" in calibration.doubt) == (off > 0 or frames < 30)


def test_on_a_straight_road_a_common_error_of_the_focal_lengths_stays_unknown():
    for theta in (FOCAL, parameters()):
        mean, sigma = common_focal(drive(theta, seed=6, frames=20))
        assert abs(mean - theta.max()) < 3 * sigma and 0.0025 < sigma < 0.006


@pytest.mark.parametrize("seed", [0, 1])
def test_a_good_calibration_is_left_as_it_is(seed):
    calibration = drive(seed=seed)
    assert np.abs(z_scores(calibration, 0)).max() < 3
    assert disparity_error(calibration, 0) < 0.03


def test_what_motion_has_hardly_shown_is_not_applied(monkeypatch):
    """Steps of five centimetres and noisy pixels: most of what is believed of the disparities is the prior's."""
    monkeypatch.setattr(SelfCalibrationConfig, "minimum_parallax", 0.01)
    calibration = drive(TURNED, frames=8, step=0.05, noise=1.0)
    assert calibration.posterior.mean.any() and calibration.apply() is None
    assert disparity_error(calibration, TURNED) > 0.9 * disparity_error(drive(TURNED, frames=1), TURNED)


def test_what_rows_alone_say_is_not_applied():
    """Rows with an error of their own, which is no error of the rig: motion does not show it."""
    theta = parameters(roll=1e-3, yaw=1e-3, pitch=1e-3, left_k1=0.005)
    street, calibration, applied = Street(3), SelfCalibration(CAR, SelfCalibrationConfig()), []
    for k in range(20):
        T = pose(k)
        f = street.features(0.1 * k, T, noise=0.1)
        z = calibration.model.points(np.column_stack([f.uv_left, f.uv_right[:, 0]]))
        error = calibration.model.field(z)[:, 3] @ theta
        calibration.observe(replace(f, uv_right=f.uv_right - np.column_stack([0 * error, error])), T)
        calibration.apply()
        applied.append(calibration.model.field(calibration.model.far())[:, 2] @ calibration.applied.parameters)
    assert np.sqrt(np.mean(np.square(applied), axis=1)).max() < 0.1


def test_unrectified_rig():
    theta = parameters(right_cx=2e-3)
    calibration = drive(theta, rig=GENERAL_RIG, scale=GENERAL_RIG.baseline / CAR.baseline, noise=0.1, frames=20)
    assert np.abs(z_scores(calibration, theta)).max() < 3
    assert disparity_error(calibration, theta) < 0.2 * 2e-3 * calibration.model.focal


def test_a_change_that_does_not_count_is_not_applied():
    calibration = drive(TURNED, seed=2, frames=10)
    assert calibration.apply(least=1e4) is None and not calibration.applied.parameters.any()
    revision = calibration.apply()
    np.testing.assert_array_equal(revision.after.parameters, calibration.posterior.mean)
    assert calibration.apply() is None


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_revision_does_not_move_the_camera(backend):
    """Landmarks follow the new correction: else a sudden change of all pixels looks like motion.

    A revision moves the past: the newest pose is to the last digit where it was, also for whoever reads poses live.
    """
    correction = RigCorrection(RigModel(RIG), parameters(left_k1=-0.05, right_k1=-0.05, right_cx=1e-3))
    cloud, truth = Cloud(150, seed=2), [se3.exp(np.array([0, 0, 0, 0, 0, 0.01 * k])) for k in range(12)]
    system = StereoSlam(RIG, None, backend, config=SystemConfig().with_settings(["map.max_depth_error=0.3"]))
    system.calibration.observe = lambda *_: None
    revise, moved = system.backend.revise, []

    def watched(correct):
        pose = system.backend.estimate(landmarks=False).T_world_left
        revise(correct)
        moved.append(np.abs(system.backend.estimate(landmarks=False).T_world_left - pose).max())

    system.backend.revise = watched
    for k, T in enumerate(truth):
        f = cloud.features(T, k / 30, 0.05)[0]
        z = correction.undone(np.column_stack([f.uv_left, f.uv_right[:, 0]]))
        wrong = replace(f, uv_left=z[:, :2], uv_right=np.column_stack([z[:, 2], z[:, 1]]))
        if k == 8:
            tight = 1e-4 * system.calibration._own.covariance
            system.calibration._own = RigPosterior(correction.parameters, tight)
            system.calibration._motion_agrees = lambda: True
        before = system.estimate().T_world_left if k else np.eye(4)
        result = system.process_features(wrong)
        assert (result.revision is not None) == (k == 8)
        if k == 8:
            step = np.linalg.norm((np.linalg.inv(before) @ result.estimate.T_world_left)[:3, 3])
            assert abs(step - 0.01) < 0.01
    assert moved == [0.0]
