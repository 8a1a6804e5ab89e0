import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.errors import CalibrationError
from slam.geometry import se3
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from tests.slam.numeric import jacobian

LEFT = PinholeCamera(458.654, 457.296, 367.215, 248.375, 752, 480, "radtan", (-0.2834, 0.0740, 0.0002, 1.8e-05))
RIGHT = PinholeCamera(457.587, 456.134, 379.999, 255.238, 752, 480, "radtan", (-0.2837, 0.0745, -0.0001, -3.6e-05))


def random_rig(seed):
    """A toed-in, rolled, distorted rig."""
    rng = np.random.default_rng(seed)
    return StereoRig(LEFT, RIGHT, se3.so3_exp(rng.uniform(-0.1, 0.1, 3)), [-0.11, *rng.uniform(-0.02, 0.02, 2)])


def points_in_view(rig, count=100, seed=0, depth=(0.8, 20.0)):
    rng = np.random.default_rng(seed)
    uv = rng.uniform((60, 60), (rig.width - 60, rig.height - 60), (count, 2))
    ray = np.concatenate([rig.left.normalise(uv), np.ones((count, 1))], axis=1)
    return ray * rng.uniform(*depth, (count, 1))


@given(st.integers(0, 10_000))
def test_eq_8_on_random_unrectified_rigs(seed):
    rig = random_rig(seed)
    points = points_in_view(rig, seed=seed)
    np.testing.assert_allclose(rig.triangulate(*rig.project(points)), points, atol=1e-9)


def test_stereo_projection_jacobian():
    rig = random_rig(3).rectified.rig
    points = points_in_view(rig, 20)
    z, J = rig.project_stereo(points)
    left, right = rig.project(points)
    np.testing.assert_allclose(z, np.column_stack([left, right[:, 0]]), rtol=1e-12)
    for point, found in zip(points, J):
        numeric = jacobian(lambda x: rig.project_stereo(x[None])[0], point, 1e-5 * point[2])
        np.testing.assert_allclose(found, numeric, atol=1e-5 * np.abs(numeric).max())


def test_triangulation_covariance_is_the_scatter_of_noisy_triangulations():
    rig = random_rig(5).rectified.rig
    point = np.array([[0.3, -0.2, 3.0]])
    rng = np.random.default_rng(0)
    sigma = 0.05  # small, so that first order holds
    left, right = rig.project(np.repeat(point, 40_000, axis=0))
    left = left + sigma * rng.normal(size=left.shape)
    right[:, 0] += sigma * rng.normal(size=len(right))
    scatter = np.cov(rig.triangulate(left, right).T)
    predicted = rig.triangulation_covariance(point, sigma)[0]
    # 40 000 samples know a variance to 0.7 %; correlations here are strong, so compare against the largest entry.
    np.testing.assert_allclose(predicted, scatter, atol=0.03 * np.abs(scatter).max())


def test_what_cannot_be_triangulated_is_nan():
    rig = StereoRig.rectified_pair(260, 160, 120, 0.12, 320, 240)
    left = np.array([[100.0, 50.0], [100.0, 50.0], [100.0, 50.0]])
    right = np.array([[100.0, 50.0], [110.0, 50.0], [np.nan, np.nan]])  # at infinity, behind, not matched
    assert np.isnan(rig.triangulate(left, right)).all()
    assert np.isnan(rig.triangulation_covariance(np.full((1, 3), np.nan), 1.0)).all()


@pytest.mark.parametrize("seed", range(5))
def test_rectified_twin_has_equal_rows_and_the_same_geometry(seed):
    rig = random_rig(seed)
    rectified_rig = rig.rectified
    assert rectified_rig.rig.is_rectified
    assert not rig.is_rectified
    points = points_in_view(rig, seed=seed)
    left, right = rig.project(points)
    a, b = rectified_rig.rectify_left(left), rectified_rig.rectify_right(right)
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-8)
    assert (a[:, 0] > b[:, 0]).all()
    local = rectified_rig.rig.triangulate(a, b)
    np.testing.assert_allclose(se3.transform(rectified_rig.T_left_rectified, local), points, rtol=1e-8)
    np.testing.assert_allclose(rectified_rig.unrectify_left(a), left, atol=1e-8)
    np.testing.assert_allclose(rectified_rig.unrectify_right(b), right, atol=1e-8)


def test_rectification_maps_agree_with_opencv():
    cv2 = pytest.importorskip("cv2")
    pair = random_rig(1).rectified
    size, sides = (pair.original.width, pair.original.height), ((LEFT, pair.R_left), (RIGHT, pair.R_right))
    for (camera, R), maps in zip(sides, pair.maps):
        D = np.array(camera.distortion)
        expected = cv2.initUndistortRectifyMap(camera.K, D, R, pair.rig.left.K, size, cv2.CV_32FC1)
        np.testing.assert_allclose(maps, expected, atol=1e-3)  # float32 of values up to 752


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"b": [0.11, 0, 0]}, "swapped"),
        ({"b": [0, 0, 0]}, "zero"),
        ({"b": [-0.01, 0.2, 0]}, "side by side"),
        ({"R": 2 * np.eye(3)}, "not a rotation"),
        ({"R": np.diag([1.0, 1, -1])}, "not a rotation"),
        ({"right": PinholeCamera(458, 457, 320, 240, 640, 480)}, "one size"),
    ],
)
def test_impossible_rigs(change, message):
    values = {"left": LEFT, "right": RIGHT, "R": np.eye(3), "b": [-0.11, 0, 0], **change}
    with pytest.raises(CalibrationError, match=message):
        StereoRig(**values)


def test_the_scale_of_rectified_pixels():
    """Noise of original pixels is as many rectified ones as lengths are stretched."""
    left, right = (PinholeCamera(f, f, 160.0, 120.0, 320, 240) for f in (300.0, 200.0))
    rig = StereoRig(left, right, np.eye(3), np.array([-0.1, 0.0, 0.0]))
    assert not rig.is_rectified
    assert rig.rectified.scale == pytest.approx(rig.rectified.rig.left.fu / 300.0)
    assert StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.1, 320, 240).rectified.scale == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K_left": LEFT.K / 500}, "no camera matrix"),
        ({"K_left": LEFT.K.T}, "no camera matrix"),
        ({"K_left": LEFT.K + 80 * np.eye(3, k=1)}, "no camera matrix"),
        ({"D_left": [0.1, 0.01, 0.0]}, "at least 4"),
        ({"T": [-0.11, 0, 0]}, "either T or baseline"),
    ],
)
def test_impossible_camera_matrices(change, message):
    with pytest.raises(CalibrationError, match=message):
        StereoRig.from_pinhole(**{"K_left": LEFT.K, "baseline": 0.11, "size": (640, 480), **change})
