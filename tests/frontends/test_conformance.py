"""The same features and descriptors as OpenCV's own SURF, kept in surf_reference.npz, and as a plain detector's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from frontends.surf import Surf
from tests.frontends.plain_detector import plain_keypoints
from tests.frontends.scenes import photograph, texture

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


def checkers():
    """A chessboard, turned and noisy: corners in place of blobs, and saturated areas."""
    y, x = np.mgrid[:113, :147]
    squares = ((0.9 * x + 0.4 * y) // 13 + (0.9 * y - 0.4 * x) // 13) % 2
    return photograph(squares * 300 - 20, noise=6)


IMAGES = {
    "texture": lambda: photograph(texture(96, 131, seed=5)),
    "fine texture": lambda: photograph(texture(101, 90, seed=6, finest=0.7), noise=3),
    "noise": lambda: np.random.default_rng(7).integers(0, 256, (80, 123)).astype(np.uint8),
    "checkers": checkers,
    "16 bit": lambda: photograph(texture(96, 131, seed=8)).astype(np.uint16) * 257,
}


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize(("octaves", "layers", "threshold"), [(2, 2, 50), (4, 3, 0)])
def test_plain_detector(name, octaves, layers, threshold):
    image = IMAGES[name]()
    expected = plain_keypoints(image if image.dtype == np.uint8 else image // 257, threshold, octaves, layers)
    found = Surf(threshold, octaves, layers).detect(image)
    rows = np.c_[found.uv, found.size, found.response, found.laplacian, found.octave]
    scaled = np.array([1, 1, 1e3, 0, 0, 1e4])  # a size or an octave away is never the nearest
    distance, nearest = cKDTree(rows * scaled).query(expected * scaled)
    same = (distance < 0.01) & (rows[nearest, 4] == expected[:, 4])
    same &= np.abs(rows[nearest, 3] / expected[:, 3] - 1) < 1e-4
    assert len(expected) > 20
    # Responses are single precision here, so a maximum by less than that may go either way.
    assert same.mean() >= 0.995
    assert abs(len(rows) - len(expected)) <= 0.005 * len(expected)
