"""Both back ends on recorded stereo tracks of a drive, with its real outliers; skipped where they are not there."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from experiments.recorded_tracks import load, replay
from slam.config import SystemConfig
from slam.geometry.se3 import inverse


def replayed(folder, name, start, stop, wrong=0.0):
    """The steps of a replay, the back end, and how far it is off over the whole stretch [m]."""
    tracks = load(folder).between(start, stop)
    config = SystemConfig.for_kind("driving", None, name)
    backend = backends.create(name, tracks.rig, models=config.models, **config.backend)
    steps = list(replay(tracks, backend, config, wrong))
    moved = inverse(steps[0].T_world_left) @ steps[-1].T_world_left
    off = np.linalg.norm(moved[:3, 3] - (inverse(tracks.poses[0]) @ tracks.poses[-1])[:3, 3])
    return steps, backend, off


@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_the_first_frames_are_not_rejected(slam_data, name):
    """At 11 m/s, of which nothing is known at first. The truth of these frames is off by 1.4 m itself.

    Disparities of frame 0 are half of those of frame 1, so its landmarks are rejected rightly.
    """
    steps, _, off = replayed(slam_data, name, 2, 27)
    assert all(step.status == "ok" and step.used > step.rejected for step in steps[1:])
    assert off < 3


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_far_tracks_alone_do_not_make_it_run_away(slam_data, name, wrong):
    """Where all tracks were 80 m away, each frame was solved again from frame 435 on, and was off by up to 16 m."""
    steps, backend, off = replayed(slam_data, name, 370, 450, wrong)
    assert {step.status for step in steps[1:]} == {"ok"}
    assert getattr(backend, "rebuilds", 0) == 0
    assert off < 8
    assert np.median([step.used / (step.used + step.rejected) for step in steps[1:]]) > 0.9 - 2 * wrong
