import numpy as np
import pytest

from slam.geometry.camera import PinholeCamera

CAMERAS = {
    "ideal": PinholeCamera(260, 255, 160, 118, 320, 240),
    "euroc": PinholeCamera(458.654, 457.296, 367.215, 248.375, 752, 480, "radtan", (-0.2834, 0.0740, 0.0002, 1.8e-05)),
    "radtan5": PinholeCamera(984, 981, 690, 233, 1392, 512, "radtan", (-0.373, 0.204, 0.0022, 0.0014, -0.072)),
    "radtan8": PinholeCamera(500, 500, 320, 240, 640, 480, "radtan", (0.1, -0.2, 1e-3, -1e-3, 0.05, 0.2, -0.1, 0.02)),
    "fisheye": PinholeCamera(190.98, 190.97, 254.9, 256.9, 512, 512, "equidistant", (0.0035, 0.0007, -0.002, 0.0002)),
}


@pytest.fixture(params=CAMERAS, ids=str)
def camera(request):
    return CAMERAS[request.param]


def points_in_view(camera, count=200, seed=0):
    rng = np.random.default_rng(seed)
    uv = rng.uniform((5, 5), (camera.width - 6, camera.height - 6), (count, 2))
    xy = camera.normalise(uv)
    seen = np.isfinite(xy).all(axis=1)  # the corners of a fisheye image look backwards
    assert seen.mean() > 0.7
    ray = np.concatenate([xy, np.ones((count, 1))], axis=1) * rng.uniform(0.5, 30, (count, 1))
    return uv[seen], ray[seen]


def test_projection_inverts_normalisation(camera):
    uv, points = points_in_view(camera)
    np.testing.assert_allclose(camera.project(points), uv, atol=1e-9)


def test_projection_agrees_with_opencv(camera):
    cv2 = pytest.importorskip("cv2")
    _, points = points_in_view(camera)
    if camera.model == "equidistant":
        D = np.array(camera.distortion)
        expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.K, D)[0][:, 0]
    else:
        D = np.array(camera.distortion or (0.0,) * 4)
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, D)[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-8)


def test_behind_the_camera_is_nan_and_not_in_view(camera):
    points = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0]])
    assert np.isnan(camera.project(points)).all()
    assert not camera.in_view(points).any()


def test_far_rays_are_not_folded_back_into_the_image():
    camera = CAMERAS["radtan5"]
    a = np.linspace(0.0, 4.0, 400)
    uv = camera.project(np.stack([a, 0 * a, 1 + 0 * a], axis=1))
    inside = camera.in_image(uv)
    assert inside[0]
    assert not inside[np.argmin(inside) :].any()  # once out of the image, never in again
