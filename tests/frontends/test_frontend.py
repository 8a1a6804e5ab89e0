"""The front end as the system calls it, and how it spreads features over the image."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import frontends
from frontends.surf import SurfFrontend
from frontends.surf.images import Sampler
from frontends.surf.keypoints import spread
from slam.data import StereoFrame
from slam.errors import SequenceError
from slam.interfaces import Frontend
from tests.frontends.scenes import RIG, stereo_pair

LEFT, RIGHT = stereo_pair(12.0)
BLACK = np.zeros((240, 320), np.uint8)


def bytes_of(features):
    arrays = (
        features.uv_left, features.uv_right, features.scale, features.angle, features.response, features.laplacian,
        features.descriptors,
    )  # fmt: skip
    return b"".join(a.tobytes() for a in arrays) + np.float64(features.threshold).tobytes()


@pytest.mark.parametrize("white", [255, 65535])
def test_images_are_sampled_linearly_with_zero_outside(white):
    rng = np.random.default_rng(3)
    image = rng.integers(0, white + 1, (24, 40)).astype(np.min_scalar_type(white))
    x, y = rng.uniform(-3.0, 43.0, (24, 40)), rng.uniform(-3.0, 27.0, (24, 40))
    x[0, :3], y[0, :3] = (-1.0, 39.0, 40.0), (5.0, 23.0, 24.0)
    padded, left, top = np.pad(image.astype(float), 4), np.floor(x).astype(int), np.floor(y).astype(int)
    corners = [(1 - np.abs(x - left - i)) * (1 - np.abs(y - top - k)) * padded[top + 4 + k, left + 4 + i]
               for i in (0, 1) for k in (0, 1)]  # fmt: skip
    np.testing.assert_allclose(Sampler(np.float32([x, y]))(image), sum(corners), atol=0.5 + 1e-4 * white)


def test_fields():
    frontend = frontends.create("surf", RIG, features=150)
    features = frontend.extract(StereoFrame(3, 1.5, LEFT, RIGHT))
    assert isinstance(frontend, Frontend)
    assert features.stamp == 1.5
    assert 100 < len(features) <= 150
    assert features.descriptors.shape == (len(features), 64)
    assert features.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    assert features.laplacian.dtype == np.int8
    assert set(features.laplacian) == {-1, 1}
    assert (features.angle == 0).all()
    assert (np.diff(features.response) <= 0).all()
    assert features.response.min() > 0.5 * features.threshold
    assert RIG.left.in_image(features.uv_left).all()
    assert RIG.right.in_image(features.uv_right[features.has_stereo]).all()
    points = RIG.triangulate(features.uv_left, features.uv_right)[features.has_stereo]
    assert len(points) > 30
    assert np.median(points[:, 2]) == pytest.approx(260 * 0.12 / 12.0, rel=0.02), "they are on the wall"
    assert np.isnan(features.uv_right).any(axis=1).tolist() == np.isnan(features.uv_right).all(axis=1).tolist()


@pytest.mark.parametrize("options", [{}, {"upright": False, "descriptor": 16}])
def test_same_bytes_whatever_the_threads(options):
    runs = []
    for threads in (1, 2, 5):
        frontend = SurfFrontend(RIG, threads=threads, **options)
        runs.append([bytes_of(frontend.extract(StereoFrame(k, float(k), LEFT, RIGHT))) for k in range(3)])
    frontend, frames = SurfFrontend(RIG, **options), [StereoFrame(k, float(k), LEFT, RIGHT) for k in range(3)]
    with ThreadPoolExecutor(1) as ahead:  # as in a run with overlap
        runs.append([bytes_of(ahead.submit(frontend.extract, frame).result()) for frame in frames])
    assert runs[0] == runs[1] == runs[2] == runs[3]


def test_nothing_to_see():
    frontend = SurfFrontend(RIG)
    for right in (None, RIGHT, BLACK):
        features = frontend.extract(StereoFrame(0, 0.0, BLACK, right))
        assert len(features) == 0 and features.descriptors.ndim == 2
    # The next image does not suffer from it: D_threshold is found again at once.
    assert len(frontend.extract(StereoFrame(1, 0.1, LEFT, RIGHT))) > 100
    for right in (None, BLACK):
        features = SurfFrontend(RIG).extract(StereoFrame(0, 0.0, LEFT, right))
        assert len(features) > 50 and not features.has_stereo.any()


@pytest.mark.parametrize(("gain", "offset"), [(1, 0), (4, 7000), (50, 200)])
def test_a_small_part_of_16_bits(gain, offset):
    """Thermal cameras, and ones of 12 bits: features and matches as of 8 bits, also after a frame without contrast."""
    plain = SurfFrontend(RIG).extract(StereoFrame(0, 0.0, LEFT, RIGHT))
    frontend = SurfFrontend(RIG)
    left, right = (image.astype(np.uint16) * gain + offset for image in (LEFT, RIGHT))
    noise = np.random.default_rng(0).normal(8000, 2.0 * gain, LEFT.shape).astype(np.uint16)
    for k, pair in enumerate([(left, right), (noise, noise), (left, right)]):
        features = frontend.extract(StereoFrame(k, 0.1 * k, *pair))
        if k == 1:
            assert len(features) < 0.2 * len(plain)
        else:
            assert len(features) > 0.9 * len(plain)
            assert features.has_stereo.mean() == pytest.approx(plain.has_stereo.mean(), abs=0.03)


def test_mask():
    mask = np.zeros((240, 320), np.uint8)
    mask[120:] = 1
    features = SurfFrontend(RIG).extract(StereoFrame(0, 0.0, LEFT, RIGHT, mask))
    assert len(features) > 30
    assert features.uv_left[:, 1].min() > 115  # localisation may move a feature by a sixth of its size
    assert len(SurfFrontend(RIG).extract(StereoFrame(0, 0.0, LEFT, RIGHT, BLACK))) == 0
    with pytest.raises(SequenceError, match="mask: 10x10"):
        SurfFrontend(RIG).extract(StereoFrame(0, 0.0, LEFT, RIGHT, np.ones((10, 10))))


def test_threshold_keeps_the_number_of_features():
    frontend = SurfFrontend(RIG, features=100)
    counts, thresholds = [], []
    for k in range(16):
        contrast = 1.0 if k < 8 else 0.3
        left = (120 + contrast * (LEFT.astype(float) - 120)).astype(np.uint8)
        features = frontend.extract(StereoFrame(k, 0.1 * k, left, None))
        counts.append(len(features))
        thresholds.append(features.threshold)
    assert min(counts) >= 95
    # Responses go with the fourth power of the contrast: 0.3 to the fourth is 1/123.
    assert thresholds[15] < 0.2 * thresholds[7]
    assert thresholds[6] == thresholds[7]
    assert thresholds[14] == thresholds[15]


@pytest.mark.parametrize(
    ("left", "right", "says"),
    [
        (LEFT, RIGHT[:, :100], "frame 7, right image: 100x240 pixels"),
        (None, RIGHT, "frame 7, left image: is None and no array"),
        (
            LEFT.astype(float),
            RIGHT,
            r"frame 7, left image: pixels must be uint8 or uint16, not float64; give image\.astype",
        ),
        (LEFT / 255, RIGHT, r"not float64; give \(255 \* image\)\.astype"),
    ],
)
def test_unusable_images(left, right, says):
    with pytest.raises(SequenceError, match=says):
        SurfFrontend(RIG).extract(StereoFrame(7, 0.0, left, right))


def test_no_cell_takes_all():
    rng = np.random.default_rng(0)
    poster = rng.uniform((0, 0), (40, 40), (500, 2))  # the strongest 500 lie in one corner
    rest = rng.uniform((0, 0), (320, 240), (500, 2))
    uv = np.concatenate([poster, rest])
    kept = np.flatnonzero(spread(uv, 200, (8, 6), (320, 240)))
    assert len(kept) == 200
    assert (kept < 500).mean() < 0.15
    cells = set(map(tuple, (uv[kept] // 40).astype(int)))
    assert len(cells) == 48


def test_what_poor_cells_leave_goes_to_the_strongest():
    rng = np.random.default_rng(0)
    uv = rng.uniform((0, 0), (40, 40), (500, 2))
    assert np.array_equal(spread(uv, 200, (8, 6), (320, 240)), np.arange(500) < 200)
    assert spread(uv[:50] - 1, 50, (8, 6), (320, 240)).all()
