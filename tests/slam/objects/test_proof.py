"""Whether a body moved: a test against all that is uncertain."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.se3 import points_by_pose
from slam.objects.displacements import Displacements
from slam.objects.proof import PROVEN, with_frame
from slam.objects.regions import Scene


def scene(sigma: float = 1e-6) -> Scene:
    return Scene([], np.zeros(0), np.zeros(6), sigma**2 * np.eye(6))


def group(n: int, velocity: float, noise: float, rng: np.random.Generator, scatter: float = 1.0) -> Displacements:
    points = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.3, 0.3, (n, 3))
    lag = rng.uniform(2, 6, n)
    d = velocity * lag[:, None] * np.array([1.0, 0, 0]) + scatter * noise * rng.standard_normal((n, 3))
    return Displacements(points, d, np.tile(np.eye(3) / noise**2, (n, 1, 1)), lag)


def evidence(moved: Displacements, still: Scene, frames: int = 3) -> float:
    total = 0.0
    for _ in range(frames):
        total = with_frame(total, moved, still)
    return total


@pytest.mark.parametrize("n", [4, 8, 20])
@pytest.mark.parametrize("scatter", [0.5, 1.0, 10.0])
def test_still_groups_are_hardly_ever_proven(n, scatter):
    """Whatever the size of the members' errors: of the first frame's evidence 3 is exceeded once in a million."""
    rng = np.random.default_rng(n)
    first = [with_frame(0.0, group(n, 0.0, 0.01, rng, scatter), scene()) for _ in range(3000)]
    assert max(first) < 3.0
    assert np.mean(np.array(first) > 0) < 0.004


def test_a_group_that_moves_is_proven():
    assert evidence(group(10, 0.05, 0.01, np.random.default_rng(1)), scene(), frames=1) > PROVEN


def test_what_the_cameras_motion_explains_is_still():
    assert evidence(group(10, 0.05, 0.01, np.random.default_rng(1)), scene(0.05)) == 0.0


def test_the_common_motion_of_the_scene_is_none_of_the_bodys():
    rng = np.random.default_rng(2)
    moved = group(10, 0.0, 0.01, rng)
    common = np.array([0, 0.01, 0, 0.02, 0, 0])
    by_common = -(moved.lag[:, None, None] * points_by_pose(moved.points)) @ common
    along = Displacements(moved.points, moved.d + by_common, moved.W, moved.lag)
    assert evidence(along, Scene([], np.zeros(0), common, 1e-12 * np.eye(6))) == 0.0


def test_evidence_fades_while_a_body_rests():
    rng = np.random.default_rng(3)
    known = evidence(group(10, 0.05, 0.01, rng), scene(), frames=2)
    rests = with_frame(known, group(10, 0.0, 0.01, rng), scene())
    assert PROVEN < rests < known
