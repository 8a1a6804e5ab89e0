"""`Surf` in the hands of somebody who knows OpenCV's Feature2D."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from frontends.surf import Keypoints, Surf
from slam.errors import SequenceError
from tests.frontends.test_surf import IMAGE


@pytest.mark.parametrize("upright", [True, False])
def test_compute_describes_what_detect_found(upright):
    surf = Surf(100, upright=upright)
    keypoints, descriptors = surf.compute(IMAGE, surf.detect(IMAGE))
    both, expected = surf.detectAndCompute(IMAGE, None)
    np.testing.assert_array_equal(descriptors, expected)
    assert [k.pt for k in keypoints] == [k.pt for k in both]
    again, same = surf.compute(IMAGE, keypoints)  # once through OpenCV's objects, which have single precision
    assert len(again) == len(keypoints)
    assert np.median(np.linalg.norm(same - descriptors, axis=1)) < 1e-3


def test_compute_describes_the_key_points_of_other_detectors():
    for detector in (cv2.SIFT_create(), cv2.ORB_create()):
        keypoints, descriptors = Surf().compute(IMAGE, detector.detect(IMAGE, None))
        assert len(keypoints) == len(descriptors) > 50
        np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)


def test_key_points_that_are_impossible():
    inside, outside, large = cv2.KeyPoint(50, 50, 12), cv2.KeyPoint(-9, 1e9, 12), cv2.KeyPoint(50, 50, 1e9)
    assert [k.pt for k in Surf().compute(IMAGE, [inside, outside, large])[0]] == [(50, 50)]
    assert Surf().compute(IMAGE, [])[1].shape == (0, 64)
    with pytest.raises(SequenceError, match=r"must be cv2\.KeyPoint"):
        Surf().compute(IMAGE, [(3, 4)])
    with pytest.raises(SequenceError, match="no finite place"):
        Surf().compute(IMAGE, [cv2.KeyPoint(float("nan"), 0, 9)])
    assert repr(Keypoints.from_cv2([inside])) == "Keypoints(1 features)"
