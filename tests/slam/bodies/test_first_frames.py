"""Landmarks that move in a run's first frames."""

from __future__ import annotations

import numpy as np

import slam
from slam.bodies.config import ObjectsConfig
from slam.bodies.parting import moved_since
from slam.config import SystemConfig
from slam.geometry.se3 import exp, inverse, transform
from tests.slam.scene import RIG

SIGMA = 0.3  # pixel noise [px]
IDENTITY = np.eye(4)


def seen(points, T_world_left, rng):
    """Pixels (uL, vL, uR) (N, 3) of points (N, 3)."""
    left, right = RIG.project(transform(inverse(T_world_left), points))
    return np.column_stack([left, right[:, 0]]) + SIGMA * rng.standard_normal((len(points), 3))


def scene(shift, near=12, count=90, seed=1):
    """Landmarks all over a room, and a group of near ones: first sights in frame 0, and pixels in frame 3.

    The camera stands still, and the near group moves by `shift` (3,) in between.
    """
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.0, 3.0, count)
    points = np.column_stack([rng.uniform(-0.45, 0.45, count) * depth, rng.uniform(-0.35, 0.35, count) * depth, depth])
    points[:near] = np.column_stack([rng.uniform(-0.1, 0.1, (near, 2)), rng.uniform(0.95, 1.05, near)])
    before = seen(points, np.eye(4), rng)
    first = RIG.triangulate(before[:, :2], before[:, [2, 1]])
    now = points + np.where(np.arange(count)[:, None] < near, shift, 0.0)
    return first, seen(now, np.eye(4), rng)


def moved(first, pixels, T_world_left=IDENTITY):
    """Which of the landmarks moved in the three frames."""
    c = ObjectsConfig()
    frames = np.full(len(first), 3.0)
    return moved_since(RIG, T_world_left, first, frames, pixels, SIGMA, c.doubtful, c.suspect, c.min_support)


def test_landmarks_that_move_together_are_told_from_a_wrong_pose():
    """The pose is wrong by 5 mm and 5 mrad, which moves most of the scene by more than the group moved."""
    first, pixels = scene((0.02, 0.0, 0.0))
    wrong = exp(np.array([0.0, 0.005, 0.0, 0.005, 0.0, 0.0]))
    moves = moved(first, pixels, wrong)
    assert moves[:12].sum() >= 10 and moves[12:].sum() <= 2


def test_nothing_moves_in_a_still_scene():
    """Three of a thousand exceed the limit of a single one, which is χ²(3) at 99.7 %, by chance."""
    moves = 0
    for seed in range(10):
        first, pixels = scene((0.0, 0.0, 0.0), seed=seed)
        moves += moved(first, pixels).sum()
    assert moves <= 9


def test_landmarks_without_a_right_pixel_are_not_tested_and_few_say_nothing():
    first, pixels = scene((0.05, 0.0, 0.0))
    pixels[:6, 2] = np.nan
    moves = moved(first, pixels)
    assert not moves[:6].any() and moves[6:12].all()
    assert not moved(first[:8], pixels[:8]).any()


def test_a_landmark_s_first_sight_is_its_track_s():
    """No later than it joined the map, but for the few that were given up and begun again since."""
    sequence = slam.open_sequence("synthetic:aisle?density=40")
    system = slam.StereoSlam(sequence.rig, None, "ekf", config=SystemConfig.for_kind(sequence.kind, None))
    joined = {}
    for k in range(8):
        result = system.process_features(sequence.simulate(k).features)
        joined.update(dict.fromkeys(result.added.tolist(), k))
    tracks = system._state.tracks
    followed = np.flatnonzero((tracks.ids >= 0) & (tracks.number >= 0))
    first = (tracks.dof[followed] > 0).argmax(axis=1)
    assert len(first) > 20 and (first > 0).any()
    assert (first <= [joined[id] for id in tracks.ids[followed].tolist()]).mean() > 0.8


def test_a_large_group_does_not_hide_single_landmarks_that_move():
    first, pixels = scene((0.05, 0.0, 0.0), near=30, count=100)
    pixels[[40, 60, 80], 0] += 8.0
    pixels[[40, 60, 80], 2] += 8.0
    moves = moved(first, pixels)
    assert moves[[40, 60, 80]].all() and moves[:30].sum() >= 28
