"""Whether a body moved: a test against all that is uncertain."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.bodies.finder import Displacements, Scene
from slam.bodies.proof import PROVEN, Way, by_left_image, with_frame
from slam.geometry.se3 import points_by_pose
from slam.tracks.table import Tracks


def scene(sigma: float = 1e-6) -> Scene:
    return Scene([], np.zeros(0), np.zeros(6), sigma**2 * np.eye(6))


def group(n: int, velocity: float, noise: float, rng: np.random.Generator, scatter: float = 1.0) -> Displacements:
    points = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.3, 0.3, (n, 3))
    lag = rng.uniform(2, 6, n)
    d = velocity * lag[:, None] * np.array([1.0, 0, 0]) + scatter * noise * rng.standard_normal((n, 3))
    return Displacements(points, d, np.tile(np.eye(3) / noise**2, (n, 1, 1)), lag)


NONE = np.zeros(3)


def way(velocity: float, jumps: float, rng: np.random.Generator, by_rig: np.ndarray = NONE) -> Way:
    """Twelve frames along x, each place off by so much."""
    times = 0.1 * np.arange(12)
    places = velocity * np.arange(12)[:, None] * np.array([1.0, 0, 0]) + jumps * rng.standard_normal((12, 3))
    return Way(places, times, by_rig, 0.0)


def result(
    velocity: float, noise: float = 0.01, jumps: float = 0.01, still: Scene | None = None, by_rig: np.ndarray = NONE,
    far: bool = False, members: float | None = None, left: float = 0.0,
) -> tuple[float, int]:  # fmt: skip
    """Evidence of the first frame for ten members, and what it counts; they may show another velocity than the way."""
    rng = np.random.default_rng(1)
    moved = group(10, velocity if members is None else members, noise, rng)
    return with_frame(0.0, moved, scene() if still is None else still, way(velocity, jumps, rng, by_rig), left, far)


@pytest.mark.parametrize("n", [4, 8, 20])
@pytest.mark.parametrize("scatter", [0.5, 1.0, 10.0])
def test_still_groups_are_not_proven(n, scatter):
    """Whatever the size of the members' errors."""
    rng = np.random.default_rng(n)
    runs = [
        with_frame(0.0, group(n, 0.0, 0.01, rng, scatter), scene(), way(0.0, 0.01, rng), 0.0, False)
        for _ in range(1000)
    ]
    assert not any(proven for _, proven in runs)


def test_a_group_that_moves_is_proven():
    assert result(0.05)[1]


def test_what_the_cameras_motion_explains_is_still():
    assert not result(0.05, still=scene(0.05))[1]


def test_what_a_wrong_disparity_explains_is_still():
    """As it would if a disparity were wrong by the deviation of a pixel, the group moves against the scene."""
    assert not result(0.05, by_rig=np.array([0.05, 0, 0]))[1]
    assert result(0.05, by_rig=np.array([0, 0.05, 0]))[1]


def test_what_jumps_instead_of_going_on_is_no_body():
    """A junction of two edges at different depths: its features agree, but not its places in successive frames."""
    assert not result(0.05, jumps=0.3)[1]


def test_a_frame_of_both_tests_counts_twice_and_one_of_members_and_left_image_once():
    assert result(0.05)[1] == 2
    assert result(0.05, jumps=0.3, left=30.0)[1] == 1
    assert result(0.05, members=0.0, left=30.0)[1] == 0


def test_what_goes_farther_than_the_camera_does_not_slide_with_it():
    """So less is asked of it; the camera's way is the only difference."""
    rng = np.random.default_rng(1)
    moved, jumpy = group(10, 0.05, 0.01, rng), way(0.05, 0.03, rng)
    proven = [with_frame(0.0, moved, scene(), replace(jumpy, of_camera=far), 0.0, False)[1] for far in (0.1, 3.0)]
    assert proven == [2, 0]


def test_what_went_farther_than_it_is_wide_is_proven_by_its_way():
    assert not result(0.05, members=0.0)[1]
    assert result(0.05, members=0.0, far=True)[1]
    assert not result(0.05, jumps=0.3, far=True)[1]


def test_the_common_motion_of_the_scene_is_none_of_the_bodys():
    rng = np.random.default_rng(2)
    moved = group(10, 0.0, 0.01, rng)
    common = np.array([0, 0.01, 0, 0.02, 0, 0])
    by_common = -(moved.lag[:, None, None] * points_by_pose(moved.points)) @ common
    along = Displacements(moved.points, moved.d + by_common, moved.W, moved.lag)
    still = Scene([], np.zeros(0), common, 1e-12 * np.eye(6))
    assert with_frame(0.0, along, still, way(0.0, 0.01, rng), 0.0, False) == (0.0, 0)


def test_evidence_fades_while_a_body_rests():
    rng = np.random.default_rng(3)
    known, _ = result(0.05)
    rests, _ = with_frame(known, group(10, 0.0, 0.01, rng), scene(), way(0.0, 0.01, rng), 0.0, False)
    assert 0 < rests < known
    assert known > PROVEN


# ------------------------------------------------------------------------------------------- the left image alone

WINDOW = 12
FU = 450.0


def left_image(
    velocity: list[float], closer: float = 1.0, n: int = 8, bend: float = 0.0, still: Scene | None = None,
    noise: float = 0.2,
) -> float:  # fmt: skip
    """What twelve frames of a camera that swings sideways say of points 4 m away, which stereo sees closer, or bent.

    Every point goes on with a velocity [m/s], and all are shifted by up to `bend` [px] along a line, by an even error.
    """
    rng = np.random.default_rng(4)
    times = (np.arange(WINDOW) - WINDOW + 1) / 20.0
    poses = np.tile(np.eye(4), (WINDOW, 1, 1))
    poses[:, :2, 3] = np.column_stack([0.2 * np.sin(4.0 * times), 0.1 * np.cos(5.0 * times)])
    points = rng.uniform([-0.5, -0.5, 3.8], [0.5, 0.5, 4.2], (n, 3))[:, None] + times[:, None] * velocity
    rays = points - poses[:, :3, 3]
    even = bend * np.linspace(-1, 0, WINDOW)[:, None] * [1.0, 0.0]
    off = noise * rng.standard_normal((n, WINDOW, 2)) + even
    rays[..., :2] += off * rays[..., 2:] / FU
    tracks = Tracks.empty(0, WINDOW, n)
    tracks.p[:], tracks.dof[:] = poses[:, :3, 3] + closer * rays, 3
    frame: Any = SimpleNamespace(
        poses=poses, ages=np.arange(WINDOW)[::-1], stamps=times, eye=poses[-1, :3, 3],
        setup=SimpleNamespace(rig=SimpleNamespace(left=SimpleNamespace(fu=FU))),
    )  # fmt: skip
    return by_left_image(tracks, np.arange(n), frame, scene() if still is None else still)


def test_the_left_image_shows_that_a_group_moves():
    assert left_image([0.3, 0.2, 0.0]) > 20


def test_what_stands_still_at_another_depth_than_stereo_says_does_not_move():
    """A wall with the right pixels of a rail before it: a tenth of a pixel besides is hardly worse."""
    assert left_image([0.0, 0.0, 0.0]) < 2
    assert left_image([0.0, 0.0, 0.0], closer=0.4) < 2
    assert left_image([0.02, 0.02, 0.0], closer=0.4) == 0.0


def test_errors_that_neighbours_share_are_no_motion():
    """However many features say so: those of the lens, and of the camera's motion."""
    assert left_image([0.0, 0.0, 0.0], bend=1.0, n=40, noise=0.05) < 5
    assert left_image([0.3, 0.2, 0.0], still=scene(0.05)) < 5


def test_few_features_say_nothing():
    assert left_image([0.3, 0.2, 0.0], n=3) == 0.0
