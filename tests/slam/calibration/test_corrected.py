from __future__ import annotations

import numpy as np
import pytest

import slam
from slam.calibration import RigCorrection, RigModel
from slam.calibration.corrected import corrected_rig
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import so3_exp
from slam.sequences.rigs import write_opencv
from tests.slam.calibration.drives import CAR
from tests.slam.scene import GENERAL_RIG

OFF = np.random.default_rng(0).normal(0, 3e-4, len(RigModel.names))


def points(rig):
    """Points (N, 3) [m] in both images."""
    rng = np.random.default_rng(1)
    z = rng.uniform(10, 40, 400) * rig.baseline / 0.54
    xy = rng.uniform(-0.4, 0.4, (400, 2)) * [rig.width, rig.height] / rig.left.fu * z[:, None]
    found = np.column_stack([xy, z])
    left, right = rig.project(found)
    return found[rig.left.in_image(left) & rig.right.in_image(right)]


@pytest.mark.parametrize("rig", [CAR, GENERAL_RIG], ids=["rectified", "general"])
def test_the_corrected_rig_measures_as_corrected_pixels_do(rig):
    """Seen by the corrected rig, points are triangulated right from its pixels, and by the corrections just so."""
    model = RigModel(rig)
    corrected = corrected_rig(model, OFF)
    assert corrected.left_off < 0.02 and corrected.right_off < 0.02
    true = points(corrected.rig)
    left, right = corrected.rig.project(true)
    rectified = rig.rectified
    z = np.column_stack([rectified.rectify_left(left), rectified.rectify_right(right)[:, 0]])

    def shape(z):
        seen = rectified.rig.triangulate(z[:, :2], z[:, [2, 1]])
        return np.linalg.norm(seen, axis=1), np.linalg.norm(seen - seen[0], axis=1)

    expected = np.linalg.norm(true, axis=1), np.linalg.norm(true - true[0], axis=1)
    by_correction, as_delivered = shape(RigCorrection(model, OFF).rows(z)), shape(z)
    for corrected_ones, delivered, truth in zip(by_correction, as_delivered, expected):
        left_over, before = (np.abs(x / np.maximum(truth, 1e-9) - 1)[1:].max() for x in (corrected_ones, delivered))
        assert left_over < 1e-2 < 2e-2 < before


def test_no_error_leaves_the_rig_as_it_is():
    corrected = corrected_rig(RigModel(GENERAL_RIG), np.zeros(len(OFF))).rig
    for name in ("fu", "fv", "u0", "v0"):
        assert getattr(corrected.right, name) == pytest.approx(getattr(GENERAL_RIG.right, name), abs=1e-4)
    np.testing.assert_allclose(corrected.R, GENERAL_RIG.R, atol=1e-9)
    np.testing.assert_allclose(corrected.b, GENERAL_RIG.b, atol=1e-9)


def fisheye():
    camera = PinholeCamera(300, 300, 320, 240, 640, 480, "equidistant", (0.01, 0.002, 0.0, 0.0))
    return StereoRig(camera, camera, so3_exp(np.array([0.0, 0.01, 0.0])), np.array([-0.1, 0, 0]))


def test_what_a_form_cannot_hold_is_said(tmp_path):
    """A fisheye has no tangential distortion."""
    tangential = np.where(np.array([name == "left_p1" for name in RigModel.names]), 3e-3, 0.0)
    corrected = corrected_rig(RigModel(fisheye()), tangential)
    assert corrected.left_off > 0.05 > 1e-3 > corrected.right_off
    write_opencv(tmp_path / "opencv.yaml", corrected.rig)
    assert slam.load_rig(tmp_path / "opencv.yaml").left == corrected.rig.left
