"""Losing the map and finding it again: states, and what joins the map meanwhile."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.geometry import se3
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.tracks.config import MapConfig
from tests.slam.scene import RIG, Cloud, path

BACKENDS = ("ekf", "smoother", "window")
MAP = MapConfig(target_in_view=40, max_depth_error=0.3, restart_after=12)
CONFIG = SystemConfig(models=EstimatorModels(pixel_sigma=0.5), map=MAP)


def run(backend, poses):
    cloud, system, results, points = Cloud(150), StereoSlam(RIG, None, backend, config=CONFIG), [], []
    for k, T in enumerate(poses):
        features, ids = cloud.features(T, k / 30, 0.3)
        results.append(system.process_features(features))
        points.append(ids)
    return system, results, points


def states(results):
    return [(name, len(list(group))) for name, group in groupby(r.status.value for r in results)]


def right_share(results, points):
    """Share of associations with the point that the landmark was made of."""
    owner, right, total = {}, 0, 0
    for result, ids in zip(results, points):
        right += sum(owner[i] == ids[row] for i, row in zip(result.matched.tolist(), result.matched_features))
        total += len(result.matched)
        owner.update({i: ids[row] for i, row in zip(result.added.tolist(), result.added_features)})
    return right / total


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_carried_camera_is_believed_when_three_frames_agree(backend):
    """The way it was carried is no motion: the back end begins again in the map, and the path keeps every frame."""
    jump = se3.exp(np.array([0, 0.3, 0, 0.4, 0, 0.2]))
    poses = [*path(25), *(T @ jump for T in path(60)[25:])]
    system, results, points = run(backend, poses)
    needed = CONFIG.association.kidnapped_after - 1
    assert states(results) == [("started", 1), ("tracked", 24), ("predicted", needed), ("tracked", 35 - needed)]
    assert results[25].reason.endswith("landmarks agree on a pose too far from the prediction to be believed at once")
    errors = np.linalg.norm(system.trajectory().positions - np.array(poses)[:, :3, 3], axis=1)
    assert len(errors) == 60
    assert errors[25 + needed :].max() < 0.02  # as before
    steps = np.diff([r.estimate.T_world_left[:3, 3] for r in results[25 + needed :]], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.03  # the jump has left no velocity behind
    assert right_share(results, points) == 1


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_shaken_camera_with_sharp_images_is_tracked(backend):
    """Each frame is far beyond what the prediction allows, but most of what is in view agrees.

    The largest error is the median of three shakes: that of one is the frame with least to agree on, as chance has it
    (0.01 to 0.05 m over six).
    """
    largest = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        poses = path(60)
        for k in range(21, 60):
            poses[k] = poses[k] @ se3.exp(0.02 * rng.normal(size=6) * (1, 1.5, 1, 0.5, 0.5, 0.5))
        system, results, points = run(backend, poses)
        assert states(results) == [("started", 1), ("tracked", 59)]
        assert right_share(results, points) == 1
        errors = np.linalg.norm(system.trajectory().positions - np.array(poses)[:, :3, 3], axis=1)
        largest.append(errors.max())
    assert np.median(largest) < 0.03
