"""A walk without end, in short: nothing may decay or grow while landmarks come and go."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from benchmarks.backends import RIG, Corridor, measured, walk
from slam.data import Observations


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_a_walk_in_which_the_map_is_replaced_again_and_again(name):
    assert name in backends.names()
    checkpoints = list(walk(name, 60, checkpoints=3, corridor=Corridor(density=4, speed=4.0)))
    assert [c.frame for c in checkpoints] == [20, 40, 60]
    for c in checkpoints:
        assert c.failed == 0 and c.least > 0
        assert c.landmarks <= 4 * 8 + 4  # those of 24 m were in the map in all
        assert c.drift < 0.3  # of 24 m
        assert c.step_nees < 20


def test_the_filters_memory_follows_the_map():
    """Thirty frames with a new map in each: the buffer stays as large as one map needs."""
    rng, corridor, backend = np.random.default_rng(0), Corridor(density=20), backends.create("ekf", RIG)
    capacities = []
    for k in range(30):
        ids, points = corridor.landmarks(0.0)
        backend.predict(0.1 * k)
        backend.remove(backend.estimate().ids)
        seen = measured(corridor.pose(0.0), points, ids, rng)
        backend.add(Observations(seen.ids + 1000 * k, seen.uv_left, seen.uv_right))
        capacities.append(backend._covariance.capacity)
    assert len(seen) > 50
    assert max(capacities) < 1.3 * (12 + 3 * len(seen))
