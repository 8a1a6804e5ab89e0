"""Regions that are followed until they have moved by their own size: tracks come and go, the region stays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.bodies import regions
from slam.bodies.config import ObjectsConfig
from slam.bodies.fits import ConstantVelocity
from slam.bodies.frame import Frame, Setup
from slam.bodies.regions import follow_regions
from slam.data import RecentPoses, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.models import models_for

DT, WINDOW = 0.1, 12
VELOCITY, START = np.array([0.5, 0.0, 5.0]), np.array([5.0, 0, 20])
RIG = StereoRig.rectified_pair(700.0, 620, 188, 0.54, 1241, 376)
SETUP = Setup(
    RIG,
    ObjectsConfig(size=2.0, min_speed=1.0, max_speed=25.0),
    models_for("driving").objects,
    models_for("driving").pixel_sigma,
)


def frame(dt: float = DT) -> Frame:
    stamps = np.concatenate([[-dt, 0.0], np.full(WINDOW - 2, np.nan)])
    cameras = RecentPoses(np.zeros(1), np.eye(4)[None], np.zeros((6, 6)))
    poses = np.tile(np.eye(4), (WINDOW, 1, 1))
    return Frame(SETUP, 1, StereoFeatures.empty(0.0), np.zeros((0, 3)), stamps, poses, cameras)


def step(monkeypatch, r, points, velocities, rng, dt=DT):
    """A frame's tracks, known to 0.1 m and 0.5 m/s. All regions, and those that moved."""
    n = len(points)
    motion = ConstantVelocity(
        points, np.tile(0.01 * np.eye(3), (n, 1, 1)), velocities + 0.2 * rng.standard_normal((n, 3)),
        np.tile(0.25 * np.eye(3), (n, 1, 1)), np.full(n, 50.0),
    )  # fmt: skip
    monkeypatch.setattr(regions, "constant_velocity", lambda *_: motion)
    yes, no = np.ones(n, bool), np.zeros(n, bool)
    tracks: Any = SimpleNamespace(found=yes, body=np.full(n, -1), still=no, count=lambda rows: np.full(len(rows), 4))
    now = frame(dt)
    going_on, moved = follow_regions(r, now, tracks)
    return going_on + moved, moved


def run(monkeypatch, frames, speed, seed, velocity=VELOCITY):
    """Three tracks at a time at a place that goes with `speed`."""
    r, rng = [], np.random.default_rng(seed)
    for k in range(frames):
        points = START + k * DT * speed + rng.uniform(-0.5, 0.5, (3, 3))
        r, bodies = step(monkeypatch, r, points, np.tile(velocity, (3, 1)), rng)
        yield r, bodies


def test_short_tracks_on_a_moving_region_make_a_body_once_it_has_moved_by_its_size(monkeypatch):
    steps = list(run(monkeypatch, 10, VELOCITY, 0))
    assert all(len(r) == 1 for r, _ in steps)
    moved = DT * np.linalg.norm(VELOCITY) * np.arange(10)
    assert not any(bodies for (_, bodies), way in zip(steps, moved) if way < 1.5)
    assert steps[-1][1] == steps[-1][0]
    assert steps[-1][0][0].state[3:] == pytest.approx(VELOCITY, abs=0.5)


@pytest.mark.parametrize(
    ("speed", "velocity"),
    [
        (0 * VELOCITY, VELOCITY),  # false velocities of what stands still
        (np.array([3.0, 0, 0]), np.array([1.5, 0, 0])),  # it takes up other still tracks, not by its velocity
    ],
)
def test_what_does_not_move_by_itself_makes_none(monkeypatch, speed, velocity):
    assert not any(bodies for _, bodies in run(monkeypatch, 12, speed, 1, velocity))


def test_where_depth_is_noisier_than_the_region_nothing_is_followed(monkeypatch):
    rng = np.random.default_rng(3)
    for depth, count in ((20.0, 1), (60.0, 0)):
        points = np.array([0, 0, depth]) + rng.uniform(0, 1, (5, 3))
        r, _ = step(monkeypatch, [], points, np.tile(VELOCITY, (5, 1)), rng)
        assert len(r) == count
    assert SETUP.radius(60.0) == pytest.approx(3.0) and SETUP.radius(5.0) == 1.0


def test_tracks_from_everywhere_are_no_region(monkeypatch):
    """After a long gap the region may be anywhere; what then agrees with its motion does not lie in it."""
    r, rng, gap = [*run(monkeypatch, 2, VELOCITY, 4)][-1][0], np.random.default_rng(4), 20.0
    points = START + gap * VELOCITY + rng.uniform(-1, 1, (60, 3)) * np.array([8.0, 3.0, 8.0])
    r, _ = step(monkeypatch, r, points, np.tile(VELOCITY, (60, 1)), rng, dt=gap)
    for one in r:
        away = np.linalg.norm(points[one.rows] - one.state[:3], axis=1)
        assert len(one.rows) < 6 and (away < 4.0).all()
