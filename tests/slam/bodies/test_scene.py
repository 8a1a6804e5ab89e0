"""Which tracks moved together: in the world, on a body, and in the newest frame."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.bodies.finder import Displacements, classify_scene, moved_in, tail
from slam.geometry.se3 import hat, transform
from tests.slam.bodies.test_membership import SIGMA, SLOT, TIMES, WINDOW, body_along, path, seen_from, table


def scene(count=80, near=12, shift=(0.0, 0.0, 0.0), pose_error=(0.0,) * 6, noise=1e-3, seed=3):
    """A wall with a group of nearer points before it; the pose error displaces all, the shift the near ones."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(2.0, 2.4, count)])
    points[:near] = np.column_stack([rng.uniform(-0.1, 0.1, (near, 2)), rng.uniform(0.95, 1.05, near)])
    pose_error = np.asarray(pose_error)
    d = pose_error[3:] - np.einsum("nij,j->ni", hat(points), pose_error[:3]) + noise * rng.standard_normal((count, 3))
    d[:near] += shift
    W = np.repeat(np.eye(3)[None] / noise**2, count, axis=0)
    view = np.column_stack([points[:, :2] / points[:, 2:], np.log(points[:, 2])])
    return Displacements(points, d, W, np.ones(count)), view


def test_a_wrong_pose_moves_nothing():
    """A rotation of 20 mrad and a shift of 2 cm displace every point by more than ten deviations."""
    moved, view = scene(pose_error=np.array([0.0, 0.02, 0.005, 0.02, 0.0, 0.01]))
    found = classify_scene(moved, view, 30.0)
    assert not found.groups
    assert found.alone.max() < 30  # χ²(3) of 80 points: 99.9999 %


@pytest.mark.parametrize("pose_error", [(0.0, 0.02, 0.005, 0.02, 0.0, 0.01), (0.0, 0.0, 0.0, -0.006, 0.0, 0.0)])
def test_the_near_group_is_found_though_the_pose_is_wrong(pose_error):
    """Also where the pose follows the group, so that its points stand still and the wall is displaced."""
    moved, view = scene(shift=(0.006, 0.0, 0.0), pose_error=pose_error)
    found = classify_scene(moved, view, 30.0)
    assert len(found.groups) == 1
    assert set(found.groups[0].members) <= set(range(12)) and len(found.groups[0].members) >= 10
    assert abs(found.groups[0].away - 0.006) < 0.002


def test_single_false_tracks_find_no_company():
    """Three tracks that jumped, each its own way: no window holds enough that moved alike."""
    moved, view = scene()
    for row, jump in zip((20, 40, 60), np.eye(3)):
        moved.d[row] += 0.5 * jump
    found = classify_scene(moved, view, 30.0)
    assert not found.groups
    assert set(np.flatnonzero(found.alone > 100)) == {20, 40, 60}


@pytest.mark.parametrize("seed", range(5))
def test_where_errors_have_heavy_tails_a_small_group_that_agrees_by_chance_does_not_move(seed):
    """Displacements of a third of the scene are four times as uncertain as modelled: so may be those of the group."""
    found, rng = {}, np.random.default_rng(seed)
    for spoilt in (False, True):
        moved, view = scene(shift=(0.0025, 0.0, 0.0), seed=seed)
        if spoilt:
            third = rng.permutation(np.arange(12, 80))[:27]
            moved.d[third] += 4e-3 * rng.standard_normal((27, 3))
        found[spoilt] = classify_scene(moved, view, 20.0)
    assert len(found[False].groups) == 1
    assert not found[True].groups
    assert tail(found[True].alone) > 1.4 > tail(found[False].alone)


def test_three_bodies_with_a_third_of_the_tracks_do_not_hide_each_other():
    """The tail of errors is that of the tracks in no group: bodies together may have more than a quarter of all."""
    moved, view = scene(count=200, near=24, shift=(0.006, 0.0, 0.0))
    rng = np.random.default_rng(4)
    for start, x, shift in ((24, 0.45, (0.0, -0.008, 0.0)), (48, -0.45, (0.0, 0.007, 0.003))):
        rows = slice(start, start + 24)
        moved.points[rows] = np.column_stack(
            [rng.uniform(x - 0.05, x + 0.05, 24), rng.uniform(-0.1, 0.1, 24), rng.uniform(0.95, 1.05, 24)]
        )
        view[rows] = np.column_stack([moved.points[rows, :2] / moved.points[rows, 2:], np.log(moved.points[rows, 2])])
        moved.d[rows] += shift
    found = classify_scene(moved, view, 30.0)
    assert sorted(int(group.members.min()) // 24 for group in found.groups) == [0, 1, 2]


@pytest.mark.parametrize(("speed", "count"), [(0.15, 1), (0.0, 0)])
def test_a_drawer_is_found_only_while_it_is_pulled_out(speed: float, count: int) -> None:
    rng, velocity = np.random.default_rng(3), np.array([0.0, 0.5, 0.0, 0.2, 0.0, 0.0])  # [rad/s], [m/s]
    chest = rng.uniform((-0.15, -0.1, -0.1), (0.15, 0.15, 0.1), (24, 3))
    drawer = rng.uniform((-0.06, -0.05, -0.12), (0.06, 0.05, -0.1), (6, 3))
    poses, rows = path(velocity), np.arange(30)
    pulled = np.stack([transform(T, drawer - speed * t * np.array([0, 0, 1.0])) for T, t in zip(poses, TIMES)], axis=1)
    pulled += SIGMA * rng.standard_normal(pulled.shape)
    tracks = table(np.concatenate([seen_from(poses, chest, 1), pulled]))
    ages, none = (SLOT - np.arange(WINDOW)) % WINDOW, np.tile(np.eye(4), (WINDOW, 1, 1))
    frame: Any = SimpleNamespace(ages=ages, poses=none, eye=np.zeros(3), setup=SimpleNamespace(slide=0.0))
    moved = moved_in(body_along(poses, rows, tracks), tracks, rows, frame)
    place = np.column_stack([tracks.position[rows, :2], np.log(tracks.position[rows, 2])])
    groups = classify_scene(moved, place, 20.0).groups
    assert [group.members.tolist() for group in groups] == [list(range(24, 30))][:count]
