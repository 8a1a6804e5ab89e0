"""Short forms of every built-in world through both back ends, with bands around the accuracy measured.

Two levels: simulated observations (``sigma=0.7``, and so the settings say), and rendered images.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.trajectory import Trajectory
from slam.run.options import RunOptions
from slam.run.runner import run
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
RENDERED = {"aisle?frames=12": 0.005, "desk?frames=12": 0.005, "box?frames=12": 0.015, "street?frames=5": 0.06}


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


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["ekf", "smoother", "window"])
@pytest.mark.parametrize("world", RENDERED)
def test_rendered_world(world, backend, tmp_path):
    sequence = open_sequence(f"synthetic:{world}")
    summary = run(sequence, RunOptions(backend, "surf", SystemConfig.for_kind(sequence.kind), tmp_path))
    assert summary["status"] == {"started": 1, "tracked": len(sequence) - 1}
    assert summary["accuracy"]["online"]["ATE RMSE [m]"] < RENDERED[world]
