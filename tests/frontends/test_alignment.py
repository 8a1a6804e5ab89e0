"""Patches found again in a later image that is shifted, turned and zoomed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from frontends.surf import SurfFrontend
from slam.data import ImagePair, StereoFrame
from slam.geometry.rig import StereoRig
from slam.interfaces import AligningFrontend
from tests.frontends.scenes import stereo_pair

RIG = StereoRig.rectified_pair(260.0, 160.0, 120.0, 0.12, 320, 240)
DISPARITY = 12.25


def seen_later(zoom: float, degrees: float, shift: tuple[float, float]) -> tuple[ImagePair, np.ndarray]:
    """A pair of images that is zoomed and turned about its middle and shifted, and the matrix (2, 3) that did so."""
    A = cv2.getRotationMatrix2D((160.0, 120.0), degrees, zoom)
    A[:, 2] += shift
    left, _ = stereo_pair(DISPARITY)
    later = cv2.warpAffine(left, A, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT).astype(np.float32)
    to_right = np.array([[1.0, 0.0, -DISPARITY], [0.0, 1.0, 0.0]])
    right = cv2.warpAffine(later, to_right, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return ImagePair(later, right), A


@pytest.mark.parametrize("zoom,degrees", [(1.0, 0.0), (1.25, 0.0), (0.8, 0.0), (1.05, 12.0)])
def test_a_patch_is_found_where_the_view_took_it(zoom, degrees):
    left, right = stereo_pair(DISPARITY)
    frontend = SurfFrontend(RIG, features=200)
    assert isinstance(frontend, AligningFrontend)
    features = frontend.extract(StereoFrame(0, 0.0, left, right))
    assert features.images is not None
    later, A = seen_later(zoom, degrees, (3.3, -2.6))
    truth = features.uv_left @ A[:, :2].T + A[:, 2]
    inside = ((truth > (50, 25)) & (truth < (295, 215))).all(axis=1)
    truth = truth[inside]
    patches = frontend.patches(features.images, features.uv_left[inside], features.scale[inside])
    warps = np.tile(np.linalg.inv(A[:, :2]), (len(truth), 1, 1))
    start = truth + np.random.default_rng(1).uniform(-1.2, 1.2, truth.shape)
    found, found_right = frontend.align(later, patches, warps, start, start - (DISPARITY, 0.0))
    assert np.isfinite(found[:, 0]).mean() > 0.85
    errors = np.linalg.norm(found - truth, axis=1)
    assert np.nanmedian(errors) < 0.06  # the lowest version of OpenCV has 0.051
    assert np.nanmean(errors < 0.5) > 0.85
    assert abs(np.nanmedian(found[:, 0] - found_right[:, 0]) - DISPARITY) < 0.05


def test_what_is_not_there_is_not_found():
    left, right = stereo_pair(DISPARITY)
    frontend = SurfFrontend(RIG, features=100)
    features = frontend.extract(StereoFrame(0, 0.0, left, right))
    patches = frontend.patches(features.images, features.uv_left, features.scale)
    other = np.roll(features.images.left, (60, 90), axis=(0, 1))
    warps = np.tile(np.eye(2), (len(features), 1, 1))
    for image in (other, np.full_like(other, 128.0)):
        found, found_right = frontend.align(ImagePair(image, None), patches, warps, features.uv_left, features.uv_left)
        assert np.isfinite(found[:, 0]).mean() < 0.1
        assert not np.isfinite(found_right).any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 9.3e18])
def test_patches_are_not_looked_for_beyond_all_images(value):
    """Nothing is read there; a pixel that no integer holds would be one anywhere in memory."""
    frontend = SurfFrontend(RIG)
    pair = ImagePair(*(image.astype(np.float32) for image in stereo_pair(DISPARITY)))
    uv = np.full((3, 2), 120.0)
    patches = frontend.patches(pair, uv, np.full(3, 15.0))
    start = np.array([[value, 120.0], [120.0, value], [value, value]])
    for found in frontend.align(pair, patches, np.tile(np.eye(2), (3, 1, 1)), start, start):
        assert np.isnan(found).all()
