"""Stereo matches on pairs with known disparity, and patches found again in a later pair."""

import cv2
import numpy as np
import pytest

from frontends.surf import SurfFrontend
from slam.data import ImagePair, StereoFrame
from slam.geometry import se3
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.interfaces import AligningFrontend
from tests.frontends.scenes import RIG, photograph, stereo_pair, texture


@pytest.mark.parametrize(("disparity", "exposure"), [(2.5, 1), (12.0, 1), (12.25, 1), (37.75, 1), (12.25, 0.6)])
def test_disparity_of_a_wall(disparity, exposure):
    left, right = stereo_pair(disparity)
    right = np.clip(exposure * right + 100 * (1 - exposure), 0, 255).astype(np.uint8)
    features = SurfFrontend(RIG, features=200).extract(StereoFrame(0, 0.0, left, right))
    inside = features.uv_left[:, 0] > disparity + 25  # the rest has no counterpart in the right image
    assert inside.sum() > 60
    assert features.has_stereo[inside].mean() > 0.95
    errors = (features.uv_left - features.uv_right)[features.has_stereo] - (disparity, 0.0)
    assert np.median(np.abs(errors[:, 0])) < 0.05  # a bar of 0.15 px, with room
    assert np.median(np.abs(errors[:, 1])) < 0.05
    assert (np.abs(errors) < 0.5).all(axis=1).mean() > 0.98


def test_range_of_depths():
    left, right = stereo_pair(12.0)
    frame = StereoFrame(0, 0.0, left, right)
    depth = 260 * 0.12 / 12.0
    assert SurfFrontend(RIG, min_depth=0.9 * depth, max_depth=1.1 * depth).extract(frame).has_stereo.mean() > 0.8
    for limits in ({"min_depth": 1.1 * depth}, {"max_depth": 0.9 * depth}):
        # A wrong place within the range may correlate by chance.
        assert SurfFrontend(RIG, **limits).extract(frame).has_stereo.mean() < 0.02


def test_unlike_rows_need_a_wider_band():
    left, right = stereo_pair(12.0)
    right = np.roll(right, 4, axis=0)
    frame = StereoFrame(0, 0.0, left, right)
    assert SurfFrontend(RIG).extract(frame).has_stereo.mean() < 0.02
    features = SurfFrontend(RIG, epipolar=5.0).extract(frame)
    assert features.has_stereo.mean() > 0.8
    assert np.nanmedian((features.uv_right - features.uv_left)[:, 1]) == pytest.approx(4.0, abs=0.05)


def grid(period, half, size, shift, noise, seed):
    """Photograph of lines along and across the rows, shifted to the left [px]."""
    v, u = np.mgrid[: size[1], : size[0]] * 1.0
    lines = [np.abs((x / period + 0.5) % 1.0 - 0.5) * period - half for x in (u + shift, v)]
    fine = 220 - 160 * np.clip(np.minimum(*lines) + 0.5, 0, 1)
    return photograph(cv2.GaussianBlur(fine.astype(np.float32), (0, 0), 0.7), noise, seed)


@pytest.mark.parametrize("noise", [0.5, 2.0])
@pytest.mark.parametrize("period", [8.4, 17.3, 36.9])
@pytest.mark.parametrize("disparity", [12.0, 20.13])
def test_a_regular_grid_gives_no_match(period, disparity, noise):
    """Most of its wrong places are seen better at whole pixels than the true place between two."""
    views = [grid(period, 1.5, (320, 240), shift, noise, side) for side, shift in enumerate((0.0, disparity))]
    features = SurfFrontend(RIG, features=200).extract(StereoFrame(0, 0.0, *views))
    assert len(features) > 60
    assert features.has_stereo.mean() < 0.05


@pytest.mark.parametrize("disparity", [41.6, 40.9])
def test_lines_far_apart_give_hardly_a_match(disparity):
    """The lines along the row are alike everywhere; those across it stand out of that for less than a column.

    By noise alone the best of two equal places is now and then a fifth better than the other.
    """
    views = [grid(69.3, 3.5, (640, 240), shift, 2.0, side) for side, shift in enumerate((0.0, disparity))]
    rig = StereoRig.rectified_pair(520.0, 320.0, 120.0, 0.12, 640, 240)
    features = SurfFrontend(rig, features=400).extract(StereoFrame(0, 0.0, *views))
    assert len(features) > 100
    assert features.has_stereo.mean() < 0.02


def seen_wall(camera, T_camera_left, wall, scale, depth):
    """Photograph of a plane at z = depth [m] of the left camera, `scale` pixels of texture a metre."""
    v, u = np.mgrid[: camera.height, : camera.width]
    xy = camera.normalise(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    T_left_camera = se3.inverse(T_camera_left)
    rays = np.c_[xy, np.ones(len(xy))] @ T_left_camera[:3, :3].T
    origin = T_left_camera[:3, 3]
    points = origin + rays * ((depth - origin[2]) / rays[:, 2])[:, None]
    x, y = (points[:, :2] * scale + np.array(wall.shape[::-1]) / 2).T.astype(np.float32)
    seen = cv2.remap(wall, x.reshape(u.shape), y.reshape(u.shape), cv2.INTER_CUBIC)
    return photograph(seen, noise=1.0)


def test_distorted_and_turned_cameras():
    left = PinholeCamera(300.0, 298.0, 162.0, 118.0, 320, 240, "radtan", (-0.28, 0.07, 2e-4, 2e-5))
    right = PinholeCamera(299.0, 301.0, 158.0, 123.0, 320, 240, "radtan", (-0.27, 0.06, -1e-4, 1e-4))
    rig = StereoRig(left, right, se3.so3_exp(np.array([0.01, -0.02, 0.015])), np.array([-0.11, 0.004, -0.003]))
    wall, depth = texture(1200, 1400, seed=2, finest=3.0), 2.0
    images = [seen_wall(camera, T, wall, 400, depth) for camera, T in ((left, np.eye(4)), (right, rig.T_right_left))]
    frontend = SurfFrontend(rig, features=300)
    assert "maps" in vars(rig.rectified)  # a live run's first frame does not wait for them
    features = frontend.extract(StereoFrame(0, 0.0, *images))
    assert len(features) > 100
    assert features.has_stereo.mean() > 0.8
    # Taken back to raw pixels and triangulated with the rig's own general model, they lie on the wall.
    assert features.rectified
    uv_left, uv_right = rig.rectified.unrectify_left(features.uv_left), rig.rectified.unrectify_right(features.uv_right)
    points = rig.triangulate(uv_left, uv_right)[features.has_stereo]
    assert np.median(points[:, 2]) == pytest.approx(depth, rel=0.005)
    _, expected = rig.project(points * (depth / points[:, 2])[:, None])
    errors = np.abs(uv_right[features.has_stereo] - expected)
    assert (np.median(errors, axis=0) < 0.1).all()


def test_middlebury_disparities(slam_data):
    folder = slam_data / "middlebury_motorcycle"
    left, right = (cv2.imread(str(folder / f"motorcycle_{side}.png")) for side in ("left", "right"))
    with np.load(folder / "motorcycle_disp.npz") as file:
        truth = file[file.files[0]]
    height, width = truth.shape
    rig = StereoRig.rectified_pair(994.978, 311.193, 254.877, 0.193001, width, height, doffs=31.086)
    features = SurfFrontend(rig).extract(StereoFrame(0, 0.0, left, right))
    assert len(features) >= 700
    assert features.has_stereo.mean() > 0.6
    u, v = np.rint(features.uv_left).astype(int).T
    errors = (features.uv_left - features.uv_right)[:, 0] - truth[v.clip(0, height - 1), u.clip(0, width - 1)]
    errors = errors[np.isfinite(errors)]
    assert len(errors) > 400
    assert (np.abs(errors) < 1).mean() > 0.8
    assert np.median(np.abs(errors)) < 0.28  # 1.5 times the median over noise and numbers of features


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
