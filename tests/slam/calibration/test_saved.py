from dataclasses import replace

import numpy as np
import pytest

import slam
from slam.calibration import RigModel, SelfCalibration, SelfCalibrationConfig
from slam.calibration.posterior import RESIDUAL_SCALES, Evidence, RigEvidence, factory_prior, systematic_variance
from slam.calibration.saved import agreement, agreement_in_words, joint_calibration
from slam.errors import CalibrationError, ConfigurationError
from slam.geometry.rig import StereoRig
from slam.system import StereoSlam
from tests.slam.calibration.drives import CAR, Street, disparity_error, drive, parameters, pose, residual_fields

TURNED = parameters(pitch=5e-4, yaw=5e-4, roll=5e-4)


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
        np.testing.assert_array_equal(getattr(kept.posterior, name), getattr(first.kept().posterior, name))
    assert kept.rig == first.kept().rig
    second = SelfCalibration(CAR, SelfCalibrationConfig(), kept)
    np.testing.assert_array_equal(second.applied.parameters, kept.posterior.mean)
    assert (second.posterior.sigma > kept.posterior.sigma).all()  # the cameras may have turned since
    without_bias = SelfCalibration(CAR, SelfCalibrationConfig(systematic=1e-4), kept).posterior.sigma
    added = np.square(second.posterior.sigma) - np.square(without_bias)  # a systematic error of this recording, once
    np.testing.assert_allclose(added, systematic_variance(second.model, 0.05), rtol=1e-3)
    before, after = second.posterior, observed(second, TURNED, seed=2).posterior
    assert np.abs((after.mean - TURNED) / after.sigma).max() < 3
    assert (after.sigma < before.sigma).all()
    field = first.model.field(first.model.far())[:, 2]
    variances = [np.einsum("ni,ij,nj->", field, p.covariance, field) for p in (second.kept().posterior, kept.posterior)]
    assert variances[0] < 0.8 * variances[1]  # of what two recordings say of the rig, and one
    evidence = [first.evidence(), second.evidence()]
    both = joint_calibration(first.model, factory_prior(first.model), evidence).posterior
    np.testing.assert_allclose(second.kept().posterior.mean, both.mean, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(second.kept().posterior.covariance, both.covariance, rtol=1e-6, atol=1e-15)


def test_a_systematic_error_of_the_present_recording_is_claimed_also_after_its_evidence(first):
    """Drives whose pixels are all off alike: evidence fixes far disparities, with that error in them."""
    kept, off, claimed = first.kept(), [], []
    for seed in range(3):
        calibration = SelfCalibration(CAR, SelfCalibrationConfig(), kept)
        far = calibration.model.field(calibration.model.far())[:, 2]
        bias = np.random.default_rng(seed).standard_normal(far.shape[1])
        theta = TURNED + bias * np.sqrt(systematic_variance(calibration.model, 0.05))
        observed(calibration, theta, seed=10 + seed)
        off.append(np.square(far @ (calibration.posterior.mean - TURNED)).mean())
        claimed.append(np.einsum("ni,ij,nj->n", far, calibration.posterior.covariance, far).mean())
    assert np.sqrt(np.mean(claimed)) > 0.13  # [px]; 0.10 where each parameter's own variance said what is evidence
    assert np.sqrt(np.mean(off)) < 1.5 * np.sqrt(np.mean(claimed))


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


def joint(*drives):
    """The rig by several drives."""
    model = drives[0].model
    return joint_calibration(model, factory_prior(model), [d.evidence() for d in drives]).posterior


def test_recordings_together_are_surer_and_agree(first):
    drives = [first, *(drive(TURNED, seed=seed, frames=20) for seed in (2, 3))]
    together, alone = joint(*drives), [d.kept().posterior for d in drives]
    assert np.abs((together.mean - TURNED) / together.sigma).max() < 3
    far = first.model.far()
    pixels = np.concatenate([first.model.field(far)[:, 2], first.model.field(far)[:, 3]])
    joint_variance, *variances = (np.einsum("ni,ij,nj->", pixels, p.covariance, pixels) for p in (together, *alone))
    assert joint_variance < 0.7 * min(variances)  # of what pixels of far points are off by
    found = agreement(first.model, [d.evidence() for d in drives])
    assert agreement_in_words(found).startswith("The recordings agree") and found.shape == together.mean.shape
    assert np.nanmax(found) < 3
    assert agreement(first.model, [first.evidence()]) is None


def shown(model, depths, theta, fields, rng):
    """The evidence of a recording that measures disparities and rows of points, to 0.05 px."""
    points = model.focal * rng.uniform([-0.8, -0.25, depths[0]], [0.8, 0.25, depths[1]], (200, 3))
    A = np.concatenate([model.field(points)[:, 2], model.field(points)[:, 3]]) / 0.05
    F = np.concatenate([model.residual_field(points)[:, 2], model.residual_field(points)[:, 3]]) / 0.05
    scales = -1e3 * np.abs(np.arange(len(RESIDUAL_SCALES)) - 6)  # that of the fields is known
    plain = Evidence(A.T @ A, A.T @ (A @ theta - F @ fields), A.T @ F)
    return RigEvidence(plain, plain.with_error(systematic_variance(model, 0.01)), scales)


def test_errors_that_no_parameter_holds_do_not_drive_recordings_apart():
    """Recordings of far and of near points, by rigs with fields that no parameter holds.

    Each one's parameters take up the fields differently. Added up as if there were none, they contradict each other,
    and what they hardly show takes up the contradiction: jointly the rig was less sure in some combinations than by one
    of them alone, by 1.8 variances of the prior, and the common focal length off by twice as much.
    """
    model, rng = RigModel(CAR), np.random.default_rng(0)
    prior = factory_prior(model)
    prior = replace(prior, covariances=prior.covariances[-1:])  # one scale, to compare what the evidence gives
    root, focal = np.linalg.cholesky(prior.covariances[0]), parameters(left_f=0.5, right_f=0.5)
    nees, off, wider = [], [], []
    for _ in range(20):
        theta, fields = root @ rng.standard_normal(len(root)), -RESIDUAL_SCALES[6] * residual_fields(rng)
        recordings = [shown(model, depths, theta, fields, rng) for depths in ((0, 0.02), (0.05, 0.12))]
        found = [joint_calibration(model, prior, some).posterior for some in (recordings, *zip(recordings))]
        errors = [p.mean - theta for p in found]
        nees.append([e @ np.linalg.solve(p.covariance, e) / len(e) for e, p in zip(errors, found)])
        off.append([focal @ e for e in errors])
        for alone in found[1:]:
            less = np.linalg.solve(root, np.linalg.solve(root, alone.covariance - found[0].covariance).T)
            wider.append(-np.linalg.eigvalsh(less).min())
    np.testing.assert_array_less(np.abs(np.mean(nees, axis=0) - 1), 0.3)
    assert max(wider) < 0.1
    together, *alone = np.sqrt(np.mean(np.square(off), axis=0))
    assert together < 0.8 * min(alone) and max(alone) < 0.004


def test_recordings_of_another_rig_do_not_agree(first):
    other = drive(TURNED + parameters(roll=3e-3), seed=2, frames=20)
    found = agreement(first.model, [first.evidence(), other.evidence()])
    assert agreement_in_words(found).startswith("The recordings do not agree in") and "roll" in agreement_in_words(
        found
    )
    assert found[18] > 3
