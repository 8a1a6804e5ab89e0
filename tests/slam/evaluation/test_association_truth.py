from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from slam.evaluation.association_truth import SurfacePoints
from slam.sequences import open_sequence


@pytest.fixture(scope="module")
def boxes():
    return open_sequence("synthetic:boxes?frames=40&camera=moving")


def test_pixels_of_the_still_world_are_found_again(boxes):
    """Projecting a surface point through the true poses gives the pixel in another frame: its depth agrees there."""
    points = SurfacePoints(boxes)
    v, u = np.mgrid[20:220:20, 20:300:20]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    ids = np.arange(len(uv))
    points.add(0, ids, uv)
    still = boxes.object_ids(0)[v.ravel(), u.ravel()] == 0
    assert np.isinf(points.errors(0, ids, uv)[~still]).all()
    assert points.errors(0, ids, uv)[still].max() < 1e-6
    assert (points.errors(0, ids, uv + np.array([0, 4.0]))[still] > 3.9).all()
    moved = points.errors(30, ids[still], uv[still])  # the camera moves, so the same pixels show other points
    assert np.median(moved) > 1.0
    rows = np.arange(len(uv))
    result = SimpleNamespace(features=SimpleNamespace(uv_left=uv), matched=ids, matched_features=rows, added=ids[:0],
                             added_features=rows[:0])  # fmt: skip
    assert np.isinf(points.of_matches(0, result)).sum() == (~still).sum() > 0  # matches of what moves are wrong, too
