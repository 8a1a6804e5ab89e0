"""A walk without end, in short: nothing may decay or grow while landmarks come and go."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from experiments.long_run import RIG, Corridor, measured, run, setting, table
from slam.data import Observations
from tests.backends.ekf_runs import dense


@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_a_walk_in_which_the_map_is_replaced_again_and_again(name):
    assert name in backends.names()
    checkpoints = list(run(name, 60, 20, Corridor(density=4, speed=4.0)))
    assert [c.frame for c in checkpoints] == [20, 40, 60]
    for c in checkpoints:
        assert c.failed == 0 and c.least > 0
        assert c.landmarks <= 4 * 8 + 4  # those of 24 m were in the map in all
        assert c.error < 0.3  # of 24 m
        assert c.nees < 20
    assert "failed updates: 0." in table(checkpoints)


def test_options_are_given_as_to_the_command():
    assert setting("lag=100") == ("lag", 100)
    assert setting("consistent=false") == ("consistent", False)
    assert setting("landmarks=euclidean") == ("landmarks", "euclidean")


def test_the_filters_memory_follows_the_map():
    """Thirty frames with a new map in each: the covariance is that of the present one."""
    rng, corridor, backend = np.random.default_rng(0), Corridor(density=20), backends.create("ekf", RIG)
    for k in range(30):
        ids, points = corridor.landmarks(0.0)
        backend.predict(0.1 * k)
        backend.remove(backend.estimate().ids)
        seen = measured(corridor.pose(0.0), points, ids, rng)
        backend.add(Observations(seen.ids + 1000 * k, seen.uv_left, seen.uv_right))
        assert len(dense(backend.state.covariance)) == 12 + 3 * len(seen)
    assert len(seen) > 50
