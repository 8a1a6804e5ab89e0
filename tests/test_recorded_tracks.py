"""All back ends on recorded stereo tracks of a drive, with its real outliers; skipped where they are not there.

Bars are `bars.ROOM` times the medians over perturbations in ``tests/bars.json``, which `experiments/bars.py` writes.
"""

from __future__ import annotations

import numpy as np
import pytest

from experiments.bars import bars, replayed, stretch_name
from experiments.recorded_tracks import load


def allowed(stretch, name, unmeasured):
    """The bar [m]; `unmeasured` where the file has no median of a back end."""
    return bars(stretch)[name]["end"] if name in bars(stretch) else unmeasured


@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_the_first_frames_are_not_rejected(slam_data, name):
    """At 11 m/s, of which nothing is known at first. The truth of these frames is off by 1.4 m itself.

    Disparities of frame 0 are half of those of frame 1, so its landmarks are rejected rightly.
    """
    steps, _, off = replayed(load(slam_data).between(2, 27), name, 0.0)
    assert all(step.status == "ok" and step.used > step.rejected for step in steps[1:])
    assert off < allowed(stretch_name(2, 27, 0.0), name, 3)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_far_tracks_alone_do_not_make_it_run_away(slam_data, name, wrong):
    """Where all tracks were 80 m away, each frame was solved again from frame 435 on, and was off by up to 16 m."""
    steps, backend, off = replayed(load(slam_data).between(370, 450), name, wrong)
    assert {step.status for step in steps[1:]} == {"ok"}
    assert getattr(backend, "rebuilds", 0) == 0
    assert off < allowed(stretch_name(370, 450, wrong), name, 8)
    assert np.median([step.used / (step.used + step.rejected) for step in steps[1:]]) > 0.9 - 2 * wrong
