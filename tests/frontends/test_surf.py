"""Detection and description, also against OpenCV's own SURF, kept in surf_reference.npz."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from frontends.surf import Surf
from tests.frontends.scenes import photograph, texture, warped, zoom_about

VALUES = texture(240, 320)
IMAGE = photograph(VALUES)


def same_features(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("uv", "size", "angle", "response", "laplacian", "octave")
    )


@pytest.fixture(scope="module")
def plain():
    return Surf(300).detect_and_describe(IMAGE)


def read_only(image):
    image = image.copy()
    image.flags.writeable = False
    return image


@pytest.mark.parametrize(
    "change",
    [
        read_only,
        np.asfortranarray,
        lambda image: image[::-1][::-1],
        lambda image: np.repeat(image, 2, axis=1)[:, ::2],
        lambda image: image[:, :, None],
        lambda image: np.dstack([image] * 3),
        lambda image: np.dstack([image, image, image, np.full_like(image, 7)]),
    ],
)
def test_layouts_give_the_same_bytes(plain, change):
    keypoints, descriptors = Surf(300).detect_and_describe(change(IMAGE))
    assert same_features(keypoints, plain[0])
    assert descriptors.tobytes() == plain[1].tobytes()


@pytest.mark.parametrize("kind", ["<u2", ">u2"])
def test_16_bit_images_are_on_the_scale_of_8_bit_ones(plain, kind):
    keypoints, descriptors = Surf(300).detect_and_describe((IMAGE.astype(np.uint16) * 257).astype(kind))
    assert len(keypoints) == len(plain[0])
    # Only the rounding of single-precision products differs.
    np.testing.assert_allclose(keypoints.uv, plain[0].uv, atol=1e-3)
    np.testing.assert_allclose(keypoints.response, plain[0].response, rtol=1e-4)
    np.testing.assert_allclose(descriptors, plain[1], atol=1e-3)


def test_sums_beyond_32_bits_wrap_around_harmlessly():
    bright = np.full((360, 2700), 60000, np.uint16)  # sums of the rows of one filter wrap around, too
    bright[60:300, 2340:2660] = IMAGE[:240, :320].astype(np.uint16) + 59000
    assert int(bright.sum(dtype=np.int64)) > 2**32
    dim = bright - np.uint16(59000)
    for upright in (True, False):
        a = Surf(0.01, upright=upright).detect_and_describe(bright)
        b = Surf(0.01, upright=upright).detect_and_describe(dim)
        assert len(a[0]) == len(b[0]) > 100
        # Cell sums are single-precision: a pedestal 200 times the contrast costs as much of their 24 bits.
        np.testing.assert_allclose(a[1], b[1], atol=5e-3)
    a, b = (Surf(0.01).localise(image, b[0]) for image in (bright, dim))
    assert len(a) == len(b) > 100
    np.testing.assert_allclose(a.uv, b.uv, atol=1e-6)


@pytest.mark.parametrize("octaves", [1, 2, 4])
@pytest.mark.parametrize("layers", [2, 3])
def test_smallest_images(octaves, layers):
    rng = np.random.default_rng(1)
    for shape in ((0, 0), (0, 5), (1, 1), (1, 90), (9, 9), (23, 23), (24, 24), (25, 60), (27, 27), (55, 54)):
        image = rng.integers(0, 256, shape, np.uint8)
        for upright in (True, False):
            keypoints, descriptors = Surf(0, octaves, layers, upright=upright).detect_and_describe(image)
            assert descriptors.shape == (len(keypoints), 64)
            assert np.isfinite(descriptors).all()
            assert not len(Surf(0, octaves, layers).detect(np.full(shape, 255, np.uint8)))


def test_a_blob_is_found_where_it_is():
    y, x = np.mgrid[:120, :160]
    for sign, grey in ((1, 40), (-1, 220)):
        blob = 130 + (grey - 130) * np.exp(-((x - 80.3) ** 2 + (y - 60.6) ** 2) / (2 * 4.0**2))
        keypoints = Surf(500).detect(photograph(blob))
        assert len(keypoints) >= 1
        # The detector interpolates coarse samples: a quarter of a pixel; the continuous maximum is ten times better.
        np.testing.assert_allclose(keypoints.uv[0], (80.3, 60.6), atol=0.25)
        assert keypoints.laplacian[0] == sign
        localised = Surf(500).localise(photograph(blob), keypoints)
        np.testing.assert_allclose(localised.uv[0], (80.3, 60.6), atol=0.03)


def nearest_pairs(a, b, A, reach):
    """Rows of the features of two images that lie within `reach` of each other, by the true map."""
    there = a.uv @ A[:, :2].T + A[:, 2]
    distance = np.linalg.norm(there[:, None] - b.uv[None], axis=2)
    first = np.flatnonzero(distance.min(axis=1) < reach)
    return first, distance.argmin(axis=1)[first], distance.min(axis=1)[first]


@pytest.mark.parametrize(("degrees", "tolerance"), [(30.0, 10.0), (90.0, 1e-6), (200.0, 10.0)])
def test_orientation_follows_the_image(degrees, tolerance):
    A = zoom_about((160, 120), 1.0, degrees)
    surf = Surf(800, upright=False)
    a, da = surf.detect_and_describe(IMAGE)
    b, db = surf.detect_and_describe(warped(VALUES, A))
    i, j, _ = nearest_pairs(a, b, A, 1.0)
    middle = np.linalg.norm(a.uv[i] - (160, 120), axis=1) < 70  # what turns in from outside is a reflection
    i, j = i[middle], j[middle]
    assert len(i) > 20
    turn = (np.rad2deg(b.angle[j] - a.angle[i]) - degrees + 180) % 360 - 180
    # Box filters and windows in steps of 5 degrees repeat themselves at quarter turns, and change in between.
    assert np.median(np.abs(turn)) < tolerance
    assert np.median((da[i] * db[j]).sum(axis=1)) > 0.97


@pytest.mark.parametrize("upright", [True, False])
def test_16_dimensions_are_the_four_central_areas_of_64(upright):
    keypoints = Surf(300).detect(IMAGE)
    inside = (np.abs(keypoints.uv - (160, 120)) < (90, 60)).all(axis=1)
    keypoints = keypoints.select(inside)
    _, long = Surf(300, upright=upright).describe(IMAGE, keypoints)
    _, short = Surf(300, descriptor=16, upright=upright).describe(IMAGE, keypoints)
    central = long.reshape(-1, 4, 4, 4)[:, 1:3, 1:3].reshape(-1, 16)
    central /= np.linalg.norm(central, axis=1, keepdims=True)
    assert len(keypoints) > 20
    # The samples are the same, but for boxes whose edge is rounded another way from another origin, now and then.
    off = np.abs(short - central)
    assert (off < 1e-5).mean() > 0.9
    assert off.max() < 0.02


#: Lobes (left, top, right, bottom, weight) of the filters, in ninths of the size.
DXX = ((0, 2, 3, 7, 1), (3, 2, 6, 7, -2), (6, 2, 9, 7, 1))
DYY = tuple((top, left, bottom, right, w) for left, top, right, bottom, w in DXX)
DXY = ((1, 1, 4, 4, 1), (5, 1, 8, 4, -1), (1, 5, 4, 8, -1), (5, 5, 8, 8, 1))


def plain_response(sums: np.ndarray, x: float, y: float, size: float) -> float:
    """Determinant of the Hessian by box filters about a pixel; `sums` are those above and left of pixel corners."""

    def above(u: float, v: float) -> float:
        column, row = int(u), int(v)
        a, b = u - column, v - row
        four = sums[row : row + 2, column : column + 2]
        return float((1 - b) * ((1 - a) * four[0, 0] + a * four[0, 1]) + b * ((1 - a) * four[1, 0] + a * four[1, 1]))

    means = []
    for lobes in (DXX, DYY, DXY):
        total = 0.0
        for *corners, weight in lobes:
            left, right = (x + 0.5 + size * (c / 9 - 0.5) for c in (corners[0], corners[2]))
            top, bottom = (y + 0.5 + size * (c / 9 - 0.5) for c in (corners[1], corners[3]))
            box = above(right, bottom) - above(right, top) - above(left, bottom) + above(left, top)
            total += weight * box / ((right - left) * (bottom - top))
        means.append(total)
    xx, yy, xy = means
    return xx * yy - 0.81 * xy**2  # the weight 0.9 squared: Bay et al., 2008, Eq. 3


def test_responses_are_those_of_plain_filters_at_the_same_place():
    image = photograph(texture(120, 160, seed=5))
    surf = Surf(threshold=200)
    found = surf.localise(image, surf.detect(image))
    sums = np.pad(np.cumsum(np.cumsum(image.astype(float), axis=0), axis=1), ((1, 0), (1, 0)))
    expected = [plain_response(sums, *uv, size) for uv, size in zip(found.uv, found.size)]
    assert len(found) > 30
    off = np.abs(found.response / expected - 1)  # it was taken a last small step earlier
    assert np.median(off) < 0.003 and np.quantile(off, 0.95) < 0.02


CASES = [
    (image, layers, mode, threshold)
    for image in ("shelf_320x240", "shelf_752x480")
    for layers in (2, 3)
    for mode in ("oriented", "upright")
    for threshold in (100, 1000)
]


@pytest.fixture(scope="module")
def reference(slam_data):
    return np.load(slam_data / "surf_reference" / "surf_reference.npz")


@pytest.mark.parametrize(("image", "layers", "mode", "threshold"), CASES)
def test_reference(reference, image, layers, mode, threshold):
    case = f"{image}/layers{layers}_{mode}_threshold{threshold}"
    rows, expected = reference[f"{case}/keypoints"], reference[f"{case}/descriptors"]
    surf = Surf(threshold, layers=layers, upright=mode == "upright")
    found, descriptors = surf.detect_and_describe(reference[f"{image}/image"])
    scaled = np.array([1, 1, 1e4])  # features of another octave are never the nearest
    distance, nearest = cKDTree(np.c_[found.uv, found.octave] * scaled).query(np.c_[rows[:, :2], rows[:, 5]] * scaled)
    same = (distance < 0.01) & (found.size[nearest] == rows[:, 2]) & (found.laplacian[nearest] == rows[:, 6])
    same &= np.abs(found.response[nearest] / rows[:, 4] - 1) < 1e-4
    assert same.mean() >= 0.995
    assert len(found) <= 1.005 * len(rows)
    nearest, rows, expected = nearest[same], rows[same], expected[same]
    turn = (np.rad2deg(found.angle[nearest]) - rows[:, 3] + 180) % 360 - 180
    assert (np.abs(turn) < 0.05).mean() >= 0.99
    cosine = (descriptors[nearest] * expected).sum(axis=1)
    assert np.median(cosine) >= 0.995
    assert np.percentile(cosine, 1) >= 0.965
