"""The same features and descriptors as OpenCV's own SURF, kept in surf_reference.npz."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from frontends.surf import Surf

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
