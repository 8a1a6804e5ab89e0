"""Landmarks that begin to move leave the map, though nothing looks for moving bodies.

The camera, which they take along for some frames, comes back.
"""

from __future__ import annotations

import numpy as np
import pytest

from slam.bodies.config import ObjectsConfig
from slam.config import SystemConfig
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.tracks.config import MapConfig
from tests.slam.scene import RIG, Cloud, path

CONFIG = SystemConfig(
    models=EstimatorModels(pixel_sigma=0.5),
    map=MapConfig(target_in_view=60, max_depth_error=0.3),
    objects=ObjectsConfig(mode="off"),
)
STILL, FRAMES, MOVERS = 20, 60, 12


def run(backend, speed):
    """A cloud of which some near points move sideways after a while; for every frame: (result, points' rows)."""
    cloud, system = Cloud(150), StereoSlam(RIG, None, backend, config=CONFIG)
    near = np.argsort(np.abs(cloud.points[:, :2]).sum(axis=1) + cloud.points[:, 2])[:MOVERS]
    frames = []
    for k, T in enumerate(path(FRAMES)):
        if k >= STILL:
            cloud.points[near, 0] += speed / 30
        features, points = cloud.features(T, k / 30, 0.3)
        frames.append((system.process_features(features), points))
    return system, near, frames


@pytest.mark.parametrize("backend", ["ekf", "smoother", "window"])
@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_landmarks_that_begin_to_move_leave_the_map(backend, speed):
    _, movers, frames = run(backend, speed)
    born, used, gone = {}, {}, {}  # of landmarks made of points that move later: frame of birth, last use, erasure
    for k, (result, points) in enumerate(frames):
        born.update({i: k for i, row in zip(result.added.tolist(), result.added_features) if points[row] in movers})
        used.update({i: k for i in result.report.used.tolist() if i in born})
        gone.update({i: k for i in result.erased.tolist() if i in born})
    before = [i for i, k in born.items() if k < STILL and used.get(i, 0) >= STILL - 1]
    assert len(before) >= MOVERS // 3  # else there is nothing to be shown
    # A point at 2 to 3 m moves by a pixel a frame at the lower speed. It disagrees (2.5 px) after three to five frames,
    # and is erased when it was missed in five more.
    assert max(used[i] for i in before) <= STILL + 6
    assert max(gone.get(i, FRAMES) for i in before) <= STILL + 12
    truth = np.array(path(FRAMES))[:, :3, 3]
    online = np.array([result.estimate.T_world_left[:3, 3] for result, _ in frames])
    # The nearest landmarks weigh most: while they are believed they pull the camera along, by up to 6 cm.
    assert np.linalg.norm(online - truth, axis=1)[STILL + 12 :].max() < 0.02  # without movers 0.01
