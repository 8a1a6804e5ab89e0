from __future__ import annotations

import json

import numpy as np
import pytest

import slam
from slam.calibration import SelfCalibration, SelfCalibrationConfig
from slam.calibration.joint import agreement, joint_calibration
from slam.errors import CalibrationError, ConfigurationError
from slam.geometry.rig import StereoRig
from slam.system import StereoSlam
from tests.slam.calibration.drives import CAR, Street, disparity_error, drive, parameters, pose

TURNED = parameters(pitch=5e-4, yaw=5e-4, roll=5e-4)


def scaled(evidence, factor):
    """The evidence of a recording with `factor` times the information."""
    return evidence._replace(whole=evidence.whole.scaled(factor), motion=evidence.motion.scaled(factor))


@pytest.fixture(scope="module")
def first():
    return drive(TURNED, seed=1, frames=20)


def observed(calibration, theta, seed, frames=20):
    """The same after a drive."""
    street = Street(seed, calibration.rig)
    for k in range(frames):
        calibration.observe(street.features(0.1 * k, pose(k), theta), pose(k))
    return calibration


def test_what_is_kept_corrects_from_the_first_frame_and_goes_on_being_learnt(first, tmp_path):
    slam.save_calibration(tmp_path / "rig.json", first.kept())
    kept = slam.load_calibration(tmp_path / "rig.json")
    for name in ("mean", "covariance"):
        np.testing.assert_array_equal(getattr(kept.posterior, name), getattr(first.posterior, name))
    assert kept.rig == first.kept().rig
    assert SelfCalibration(CAR, SelfCalibrationConfig(), kept).kept().residual == kept.residual < 1
    second = SelfCalibration(CAR, SelfCalibrationConfig(), kept)
    np.testing.assert_array_equal(second.applied.parameters, first.posterior.mean)
    assert (second.posterior.sigma > 0.999 * first.posterior.sigma).all()  # the cameras may have turned since
    alone = drive(TURNED, seed=2, frames=20)
    after = observed(second, TURNED, seed=2).posterior
    assert np.abs((after.mean - TURNED) / after.sigma).max() < 3
    volume = [np.linalg.slogdet(p.covariance)[1] for p in (after, first.posterior, alone.posterior)]
    assert volume[0] < min(volume[1:])


def test_a_camera_that_has_turned_since_is_found(first):
    turned = TURNED + parameters(right_cx=-1.0 / 720)  # [px]
    second = observed(SelfCalibration(CAR, SelfCalibrationConfig(), first.kept()), turned, seed=3)
    assert np.abs((second.posterior.mean - turned) / second.posterior.sigma).max() < 3
    assert disparity_error(second, turned) < 0.15 < 0.9 < disparity_error(first, turned)


def test_of_another_rig_or_switched_off_it_is_refused(first):
    other = StereoRig.rectified_pair(730, 610, 173, 0.54, 1242, 375)
    with pytest.raises(CalibrationError, match=r"another rig: focal 720 there, 730 here"):
        StereoSlam(other, None, "ekf", rig_prior=first.kept())
    with pytest.raises(ConfigurationError, match="enabled"):
        SelfCalibration(CAR, SelfCalibrationConfig(enabled=False), first.kept())


def spoilt(tree, change):
    tree = json.loads(json.dumps(tree))
    change(tree)
    return tree


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("rig"), "of which rig"),
        (lambda t: t["rig"].update(focal="long"), "of which rig"),
        (lambda t: t["rig"].update(focal=float("nan")), "finite"),
        (lambda t: t["rig"].update(focal=10**400), "of which rig"),
        (lambda t: t["parameters"][0].update(mean=10**400), "cannot be read"),
        (lambda t: t.update(residual_scale="x"), "residual_scale"),
        (lambda t: t.pop("parameters"), "neither a file of"),
        (lambda t: t["parameters"].pop(), "cannot be read"),
        (lambda t: t.update(parameters=3), "cannot be read"),
        (lambda t: t["parameters"][0].update(name="colour"), "not those of this version"),
        (lambda t: t["covariance"][0].__setitem__(0, -1.0), "covariance"),
        (lambda t: t["covariance"][0].__setitem__(1, float("nan")), "finite"),
        (lambda t: t["parameters"][3].update(mean=-1e300), "larger than the rig"),
        (lambda t: t["covariance"][0].__setitem__(0, 1e300), "larger than the rig"),
    ],
)
def test_bad_files_get_one_line(first, tmp_path, change, message):
    file = tmp_path / "bad.json"
    file.write_text(json.dumps(spoilt(first.kept().to_json(), change)))
    with pytest.raises(CalibrationError, match=message) as raised:
        slam.load_calibration(file)
    assert str(file) in str(raised.value) and "\n" not in str(raised.value)


def test_one_recording_jointly_is_that_recording(first):
    joint = joint_calibration(first.model, [first.evidence()], first.config.systematic).posterior
    np.testing.assert_allclose(joint.mean, first.posterior.mean, rtol=1e-9)
    # The run counts a part that is incomplete; here there is none, so that the covariance is the same as well.
    np.testing.assert_allclose(joint.covariance, first.posterior.covariance, rtol=1e-6, atol=1e-14)


def test_recordings_together_are_surer_and_agree(first):
    drives = [first, *(drive(TURNED, seed=seed, frames=20) for seed in (2, 3))]
    joint = joint_calibration(first.model, [d.evidence() for d in drives], first.config.systematic).posterior
    posteriors = [d.posterior for d in drives]
    assert np.abs((joint.mean - TURNED) / joint.sigma).max() < 3
    far = first.model.far()
    pixels = np.concatenate([first.model.field(far)[:, 2], first.model.vertical(far)])
    together, *alone = (np.einsum("ni,ij,nj->", pixels, p.covariance, pixels) for p in (joint, *posteriors))
    assert together < 0.7 * min(alone)  # of what pixels of far points are off by
    found = agreement(first.model, [d.evidence() for d in drives], first.config.systematic)
    assert found.words.startswith("The recordings agree") and found.largest.shape == joint.mean.shape
    assert np.nanmax(found.largest) < 3
    assert agreement(first.model, [first.evidence()], first.config.systematic) is None


def test_recordings_of_another_rig_do_not_agree(first):
    other = drive(TURNED + parameters(roll=3e-3), seed=2, frames=20)
    found = agreement(first.model, [first.evidence(), other.evidence()], first.config.systematic)
    assert found.words.startswith("The recordings do not agree in") and "roll" in found.words
    assert found.largest[18] > 3


def test_the_prior_that_recordings_share_is_no_agreement(first):
    """Two that say next to nothing are both near the calibration as delivered."""
    silent = [scaled(d.evidence(), 1e-9) for d in (first, drive(TURNED + parameters(roll=3e-3), seed=2, frames=20))]
    found = agreement(first.model, silent, first.config.systematic)
    assert np.isnan(found.largest).all() and found.words.startswith("Nothing can be said")
    half = agreement(first.model, [first.evidence(), silent[1]], first.config.systematic)
    assert np.isnan(half.largest).all()


def test_without_motion_there_is_nothing_to_join(first):
    assert drive(step=0.0, frames=3).evidence() is None
    with pytest.raises(CalibrationError, match="no recording"):
        joint_calibration(first.model, [], 0.05)
