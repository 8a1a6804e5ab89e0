"""`Surf` in the hands of somebody who knows OpenCV's Feature2D."""

import inspect

import cv2
import numpy as np
import pytest

import frontends.surf
from frontends.surf import Keypoints, Surf
from slam.errors import ConfigurationError, SequenceError
from tests.frontends.test_surf import IMAGE


def test_detect_gives_what_opencv_takes_as_key_points():
    found = Surf(100).detect(IMAGE)
    first = found[0]
    assert isinstance(first, cv2.KeyPoint)
    assert first.pt == pytest.approx(tuple(found.uv[0]))
    assert (first.angle, first.class_id) == (-1, found.laplacian[0])
    assert len(list(found)) == len(found)
    assert cv2.KeyPoint_convert(found).shape == (len(found), 2)


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


def test_the_arguments_and_defaults_are_opencv_s():
    parameters = inspect.signature(frontends.surf.create).parameters
    expected = {"hessianThreshold": 100.0, "nOctaves": 4, "nOctaveLayers": 3, "extended": False, "upright": False}
    assert {name: p.default for name, p in parameters.items()} == expected
    surf = frontends.surf.create(400, 3, 2, False, True)
    got = surf.getHessianThreshold(), surf.getNOctaves(), surf.getNOctaveLayers(), surf.getExtended(), surf.getUpright()
    assert got == (400.0, 3, 2, False, True)
    assert isinstance(surf, Surf) and surf.descriptorSize() == 64
    assert surf.defaultNorm() == cv2.SIFT_create().defaultNorm()


def test_setters_change_what_is_found_and_refuse_what_this_surf_does_not_have():
    surf = frontends.surf.create()
    for name, value, wrong in (
        ("HessianThreshold", 5000, -1),
        ("NOctaves", 2, 5),
        ("NOctaveLayers", 2, 4),
        ("Upright", True, "no"),
        ("Extended", False, True),
    ):
        getattr(surf, f"set{name}")(value)
        with pytest.raises(ConfigurationError):
            getattr(surf, f"set{name}")(wrong)
        assert getattr(surf, f"get{name}")() == value
    keypoints, descriptors = surf.detectAndCompute(IMAGE, None)
    other, expected = Surf(5000, 2, 2).detectAndCompute(IMAGE)
    assert len(keypoints) == len(other) > 0 and np.array_equal(descriptors, expected)
