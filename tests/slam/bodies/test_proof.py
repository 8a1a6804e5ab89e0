"""Whether a body moved: a test against all that is uncertain."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.bodies.bodies import new_body
from slam.bodies.config import ObjectsConfig
from slam.bodies.detector import MovingObjectDetector
from slam.bodies.finder import Displacements, Scene
from slam.bodies.proof import PROVEN, Way, with_frame
from slam.geometry.se3 import exp, points_by_pose
from tests.slam.bodies.test_recovery import MODELS, RIG, frame_of
from tests.slam.bodies.test_recovery import scene as body_of_points

WINDOW, NONE = 12, np.zeros(3)
ENDS = np.concatenate([np.zeros((1, 3)), 0.3 * np.eye(3)])
ASIDE = np.array([0, 0, 0, 1.0, 0, 0])


def scene(sigma: float = 1e-6) -> Scene:
    return Scene([], np.zeros(0), np.zeros(6), sigma**2 * np.eye(6))


def group(n: int, motion: np.ndarray, noise: float, rng: np.random.Generator, scatter: float = 1.0) -> Displacements:
    """Members that go with a motion [ω, v] (6,) about their middle, a frame."""
    points = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.3, 0.3, (n, 3))
    lag = rng.uniform(2, 6, n)
    d = -lag[:, None] * (points_by_pose(points - [0, 0, 4.0]) @ motion) + scatter * noise * rng.standard_normal((n, 3))
    return Displacements(points, d, np.tile(np.eye(3) / noise**2, (n, 1, 1)), lag)


def way(motion: np.ndarray, jumps: float, rng: np.random.Generator, by_rig: np.ndarray = NONE) -> Way:
    """A frame's motion, twelve times, each place off by so much."""
    frames = np.arange(WINDOW)
    poses = exp(frames[:, None] * np.concatenate([motion[:3], np.zeros(3)]))
    poses[:, :3, 3] = frames[:, None] * motion[3:] + jumps * rng.standard_normal((WINDOW, 3))
    places = (poses[:, None, :3, :3] @ ENDS[:, :, None])[..., 0] + poses[:, None, :3, 3]
    return Way(places, places, 0.1 * frames, by_rig, np.zeros((WINDOW, 3)))


def result(
    motion: np.ndarray = 0.05 * ASIDE, noise: float = 0.01, jumps: float = 0.01, still: Scene | None = None,
    by_rig: np.ndarray = NONE, far: bool = False, members: np.ndarray | None = None, both: float = 1.0,
    along: bool = False,
) -> tuple[float, int]:  # fmt: skip
    """Evidence of the first frame for ten members, and what it counts; they may show another motion.

    With `along` it goes along with the camera.
    """
    rng = np.random.default_rng(1)
    moved, went = group(10, motion if members is None else members, noise, rng), way(motion, jumps, rng, by_rig)
    if along:
        went = replace(went, in_view=ENDS + jumps * rng.standard_normal((WINDOW, 1, 3)))
    return with_frame(0.0, moved, scene() if still is None else still, went, far, both)


@pytest.mark.parametrize("n", [4, 8, 20])
@pytest.mark.parametrize("scatter", [0.5, 1.0, 10.0])
def test_still_groups_are_not_proven(n, scatter):
    """Whatever the size of the members' errors."""
    rng = np.random.default_rng(n)
    for _ in range(300):
        moved = group(n, 0 * ASIDE, 0.01, rng, scatter)
        assert not with_frame(0.0, moved, scene(), way(0 * ASIDE, 0.01, rng), False, 1.0)[1]


@pytest.mark.parametrize(
    ("certain", "given"),
    [
        (True, {}),
        (True, {"motion": np.array([0, 0.2, 0, 0, 0, 0]), "jumps": 0.005}),  # it turns on the spot
        (False, {"still": scene(0.05)}),  # the camera's motion explains it
        (False, {"by_rig": np.array([0.05, 0, 0])}),  # as a disparity would that is wrong by the deviation of a pixel
        (True, {"by_rig": np.array([0, 0.05, 0])}),
        (False, {"jumps": 0.3}),  # a junction of two edges: its features agree, but not its places
        (False, {"members": 0 * ASIDE}),
        (True, {"members": 0 * ASIDE, "far": True}),  # it went farther than it is wide: its way alone counts
        (False, {"jumps": 0.3, "far": True}),
        (False, {"along": True, "far": True}),  # a bonnet, or a reflection in a windscreen
        (True, {"along": True}),
        (False, {"both": 0.5}),  # the right image's matches are wrong for all alike, as along a repeated pattern
        (False, {"both": 0.5, "far": True}),
    ],
)
def test_what_moves_for_certain(certain, given):
    assert result(**given)[1] == (2 if certain else 0)


def test_a_turn_makes_up_for_a_short_way_by_half():
    """Ten members that turn by 0.03 rad a frame or do not, and go a way that is less certain than is asked."""
    turning, straight = (np.array([0, turn, 0, 0.05, 0, 0]) for turn in (0.05, 0.0))
    assert [result(0.05 * ASIDE, jumps=0.045, members=members)[1] for members in (turning, straight)] == [1, 0]


def test_what_goes_farther_than_the_camera_does_not_slide_with_it():
    """So less is asked of it; the camera's way is the only difference."""
    rng = np.random.default_rng(1)
    moved, jumpy = group(10, 0.05 * ASIDE, 0.01, rng), way(0.05 * ASIDE, 0.03, rng)
    upwards = np.linspace(0, 1, WINDOW)[:, None] * [0, 1.0, 0]
    proven = [
        with_frame(0.0, moved, scene(), replace(jumpy, cameras=far * upwards), False, 1.0)[1] for far in (0.1, 3.0)
    ]
    assert proven == [2, 0]


@pytest.mark.parametrize(("share", "across", "certain"), [(0.6, 0.0, 0), (1.0, 0.0, 0), (0.6, 0.05, 2), (1.8, 0.0, 2)])
def test_what_goes_a_share_of_the_cameras_way_may_stand_still(share, across, certain):
    """As a crossing of edges at two depths does; a body goes across that way, or farther."""
    rng = np.random.default_rng(1)
    frames = np.arange(WINDOW)[:, None]
    cameras = 0.05 * frames * [1.0, 0.2, 0] + 0.002 * frames**2 * [0, 0, 1.0]
    middle = share * cameras + across * frames * [0, 0, 1.0] + 1e-3 * rng.standard_normal((WINDOW, 3))
    went = Way(middle[:, None] + ENDS, ENDS, 0.1 * frames[:, 0], NONE, cameras)
    assert with_frame(0.0, group(10, 0.05 * ASIDE, 0.01, rng), scene(), went, False, 1.0)[1] == certain


def test_the_common_motion_of_the_scene_is_none_of_the_bodys():
    rng = np.random.default_rng(2)
    moved = group(10, 0 * ASIDE, 0.01, rng)
    common = np.array([0, 0.01, 0, 0.02, 0, 0])
    by_common = -(moved.lag[:, None, None] * points_by_pose(moved.points)) @ common
    along = Displacements(moved.points, moved.d + by_common, moved.W, moved.lag)
    still = Scene([], np.zeros(0), common, 1e-12 * np.eye(6))
    assert with_frame(0.0, along, still, way(0 * ASIDE, 0.01, rng), False, 1.0) == (0.0, 0)


def test_evidence_fades_while_a_body_rests():
    rng = np.random.default_rng(3)
    known, _ = result()
    rests, _ = with_frame(known, group(10, 0 * ASIDE, 0.01, rng), scene(), way(0 * ASIDE, 0.01, rng), False, 1.0)
    assert 0 < rests < known
    assert known > PROVEN


@pytest.mark.parametrize("alike", [True, False])
def test_a_part_must_go_a_way_of_its_own_in_its_whole(alike):
    """That the whole goes on is no proof of it."""
    times = 0.1 * np.arange(WINDOW)
    bodies = []
    for id, turn in ((1, 0.0), (2, 0.0 if alike else 1.0)):
        body = new_body(id, np.array([0, 0, 4.0]), np.array([0, turn, 0, 1.0, 0, 0]), times, 0.0, 0.0)
        bodies.append(replace(body, lower=-0.1 * np.ones(3), upper=0.1 * np.ones(3)))
    frame: Any = SimpleNamespace(
        stamps=times, poses=np.tile(np.eye(4), (WINDOW, 1, 1)), setup=SimpleNamespace(depth_noise=lambda d: 0.01 * d)
    )
    own = Way.of(bodies[1], frame, bodies[0]).places
    assert (np.ptp(own, axis=0).max() < 1e-9) == alike
    assert np.ptp(Way.of(bodies[1], frame, None).places, axis=0).max() > 1.0


@pytest.mark.parametrize(("size", "went", "far"), [(2.0, 3.0, True), (2.0, 1.5, False), (0.0, 3.0, False)])
def test_a_body_that_went_farther_than_it_is_wide_on_a_drive_is_followed_for_far(size, went, far):
    body, tracks, features, _ = body_of_points(4, np.zeros(6), np.random.default_rng(0))
    T = body.T.copy()
    T[2, 3] += went
    detector = MovingObjectDetector(RIG, ObjectsConfig(size=size), MODELS)
    detector.bodies = {1: replace(body, T=T)}
    detector._prove(tracks, frame_of(features), {None: scene()})
    assert detector.bodies[1].far == far
