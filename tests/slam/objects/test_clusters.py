from __future__ import annotations

import numpy as np

from slam.objects.clusters import Displacements, judge_scene
from slam.se3 import hat

RNG = np.random.default_rng(3)


def scene(count=80, near=12, shift=(0.0, 0.0, 0.0), pose_error=(0.0,) * 6, noise=1e-3):
    """A wall with a cluster of nearer points before it; the pose error displaces all, the shift the near ones."""
    points = np.column_stack([RNG.uniform(-1, 1, (count, 2)), RNG.uniform(2.0, 2.4, count)])
    points[:near] = np.column_stack([RNG.uniform(-0.1, 0.1, (near, 2)), RNG.uniform(0.95, 1.05, near)])
    pose_error = np.asarray(pose_error)
    d = pose_error[3:] - np.einsum("nij,j->ni", hat(points), pose_error[:3]) + noise * RNG.standard_normal((count, 3))
    d[:near] += shift
    W = np.repeat(np.eye(3)[None] / noise**2, count, axis=0)
    view = np.column_stack([points[:, :2] / points[:, 2:], 0.5 * np.log(points[:, 2])])
    return Displacements(points, d, W, np.ones(count)), view


def test_a_wrong_pose_moves_nothing():
    """A rotation of 20 mrad and a shift of 2 cm displace every point by more than ten deviations."""
    moved, view = scene(pose_error=np.array([0.0, 0.02, 0.005, 0.02, 0.0, 0.01]))
    found = judge_scene(moved, view, 30.0, 4)
    assert not found.clusters
    assert found.alone.max() < 30  # χ²(3) of 80 points: 99.9999 %


def test_the_near_cluster_is_found_though_the_pose_is_wrong():
    moved, view = scene(shift=(0.006, 0.0, 0.0), pose_error=np.array([0.0, 0.02, 0.005, 0.02, 0.0, 0.01]))
    found = judge_scene(moved, view, 30.0, 4)
    assert len(found.clusters) == 1
    assert set(found.clusters[0]) <= set(range(12)) and len(found.clusters[0]) >= 10
    assert abs(found.away[0] - 0.006) < 0.002


def test_where_the_near_cluster_rules_the_pose_it_is_still_the_one_that_moves():
    """The pose follows the box, so that its own points stand still and the wall is displaced."""
    moved, view = scene(shift=(0.006, 0.0, 0.0), pose_error=np.array([0.0, 0.0, 0.0, -0.006, 0.0, 0.0]))
    found = judge_scene(moved, view, 30.0, 4)
    assert len(found.clusters) == 1 and set(found.clusters[0]) <= set(range(12))


def test_too_few_tracks_say_nothing():
    moved, view = scene(count=8, near=4, shift=(0.1, 0, 0))
    assert not judge_scene(moved, view, 30.0, 4).clusters
