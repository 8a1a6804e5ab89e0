from __future__ import annotations

import numpy as np
import pytest

from slam.calibration import Revision, RigCorrection, RigModel
from slam.data import StereoFeatures
from slam.geometry import se3
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from tests.slam.calibration.drives import CAR, parameters
from tests.slam.scene import GENERAL_RIG

MODEL = RigModel(CAR)
F = MODEL.focal


def cloud(count=200, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-6, 6, count), rng.uniform(-2, 2, count), rng.uniform(9, 60, count)])


def other_rig(turn=(0, 0, 0), down=0.0, forward=0.0, **camera):
    """The car's rig with the right camera turned [rad] and moved, or with another right camera."""
    kind = {"model": "radtan"} if "distortion" in camera else {}
    right = PinholeCamera(**{**vars_of(CAR.right), **camera, **kind})
    b = CAR.b + CAR.baseline * np.array([0, -down, -forward])
    return StereoRig(CAR.left, right, se3.so3_exp(np.array(turn)), b)


def vars_of(camera):
    names = ("fu", "fv", "u0", "v0", "width", "height")
    return {name: getattr(camera, name) for name in names}


A = 1e-3
TRUE_RIGS = {
    "pitch": other_rig(turn=(-A, 0, 0)),
    "yaw": other_rig(turn=(0, -A, 0)),
    "roll": other_rig(turn=(0, 0, -A)),
    "down": other_rig(down=A),
    "forward": other_rig(forward=A),
    "right_cx": other_rig(u0=CAR.right.u0 - A * F),
    "right_cy": other_rig(v0=CAR.right.v0 - A * F),
    "right_f": other_rig(fu=F / (1 + A), fv=F / (1 + A)),
    "right_aspect": other_rig(fv=F / (1 + A)),
    "right_k1": other_rig(distortion=(-A, 0.0, 0.0, 0.0)),
    "right_k2": other_rig(distortion=(0.0, -A, 0.0, 0.0)),
    "right_p1": other_rig(distortion=(0.0, 0.0, -A, 0.0)),
    "right_p2": other_rig(distortion=(0.0, 0.0, 0.0, -A)),
}


@pytest.mark.parametrize("name", TRUE_RIGS)
def test_a_parameter_corrects_the_error_that_it_is_named_after(name):
    """What a rig with the error sees, corrected, is what the ideal one sees, but for a turn of both cameras."""
    points = cloud()
    left, right = TRUE_RIGS[name].project(points)
    z = np.column_stack([left, right[:, 0]])
    theta = parameters(**{name: A})
    measured = MODEL.points(z)
    vertical = right[:, 1] - left[:, 1] + MODEL.field(measured)[:, 3] @ theta
    np.testing.assert_allclose(vertical, 0, atol=4e-3)
    ideal, _ = CAR.project_stereo(points)
    np.testing.assert_allclose(measured + MODEL.field(measured)[:, :3] @ theta, MODEL.points(ideal), atol=6e-3)
    assert max(np.abs(z - ideal).max(), np.abs(right[:, 1] - left[:, 1]).max()) > 0.025


@pytest.mark.parametrize("name", ["left_cx", "left_cy"])
def test_a_shift_of_the_left_image_does_not_turn_the_rig(name):
    change = MODEL.field(MODEL.far())[:, :2] @ parameters(**{name: 0.01})
    assert np.abs(change.mean(axis=0)).max() < 0.05 * 0.01 * F  # the image as a whole stays where it is


@pytest.mark.parametrize("rig", [CAR, GENERAL_RIG], ids=["rectified", "general"])
def test_features_are_corrected_and_revised(rig):
    model = RigModel(rig)
    rng = np.random.default_rng(1)
    before, after = (RigCorrection(model, 2e-3 * rng.standard_normal(len(model.names))) for _ in range(2))
    points = rng.uniform((-2, -1, 5), (2, 1, 10), (20, 3))
    left, right = rig.rectified.rig.project(points)
    right[3] = np.nan
    ones = np.ones(20)
    features = StereoFeatures(0.0, left, right, ones, ones, ones, np.ones(20, np.int8), np.ones((20, 4), np.float32))
    corrected = before.features(features)
    assert np.isnan(corrected.uv_right[3]).all() and np.isfinite(corrected.uv_left).all()
    rows = [np.column_stack([f.uv_left, f.uv_right[:, 0]]) for f in (features, corrected, after.features(features))]
    np.testing.assert_allclose(before.rows(rows[0]), rows[1], atol=1e-6)
    np.testing.assert_allclose(before.undone(rows[1]), rows[0], atol=1e-4)
    np.testing.assert_allclose(Revision(before, after).rows(rows[1]), rows[2], atol=1e-4)
