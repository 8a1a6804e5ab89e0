"""Short forms of the built-in worlds, as observations, through the back ends: bands around the accuracy measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.trajectory import Trajectory
from slam.sequences import open_sequence
from slam.system import StereoSlam

#: World, and about twice the online ATE [m] measured with either back end.
OBSERVED = {
    "aisle?frames=25&sigma=0.7": 0.007,
    "aisle?frames=25&sigma=0.7&rig=toedin": 0.008,
    "desk?frames=25&sigma=0.7": 0.006,
    "startup?frames=25&sigma=0.7": 0.010,
    "box?frames=25&sigma=0.7": 0.010,
    "boxes?frames=25&sigma=0.7": 0.020,
    "street?frames=15&sigma=0.7": 0.025,
    "town?frames=15&sigma=0.7": 0.040,
}


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["ekf", "smoother", "window"])
@pytest.mark.parametrize("world", OBSERVED)
def test_observed_world(world, backend):
    sequence = open_sequence(f"synthetic:{world}")
    config = SystemConfig.for_kind(sequence.kind)
    config = replace(config, models=replace(config.models, pixel_sigma=0.7))
    system = StereoSlam(sequence.rig, None, backend, config=config)
    results = [system.process_features(sequence.observations(k)) for k in range(len(sequence))]
    assert {r.status.value for r in results[1:]} == {"tracked"}
    estimates = [r.estimate for r in results]
    online = Trajectory(np.array([e.stamp for e in estimates]), np.array([e.T_world_left for e in estimates]))
    assert evaluate(online, sequence)["ATE RMSE [m]"] < OBSERVED[world]
    assert evaluate(system.trajectory(), sequence)["ATE RMSE [m]"] < OBSERVED[world]
    if "box" in world:
        return  # moving boxes bend the path as long as nothing detects them, and the covariance cannot know
    honesty = consistency(online, np.array([e.covariance for e in estimates]), sequence)
    # Six degrees of freedom; one run's errors are correlated, so its mean scatters far more than the band says.
    assert honesty["mean NEES"] < 20
