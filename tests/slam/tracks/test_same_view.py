"""A view that is again what it was closes a loop, however sure the path is that the camera is elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.geometry import se3
from slam.system import StereoSlam
from tests.slam.scene import RIG, Cloud

ROWS = ("uv_left", "uv_right", "scale", "angle", "response", "laplacian", "descriptors")


def joined(a, keep_a, b, keep_b):
    """Features of two frames, some of each."""
    return replace(a, **{n: np.concatenate([getattr(a, n)[keep_a], getattr(b, n)[keep_b]]) for n in ROWS})


@pytest.mark.parametrize("backend", ["ekf", "smoother"])
def test_a_camera_that_something_large_took_along_comes_back(backend):
    """It stands; something passes, covers all of its view for a second, and moves by more than a metre meanwhile."""
    world, mover = Cloud(150), Cloud(600, seed=9)
    mover.points = mover.points * (3, 0.8, 0.15) + (0, 0, 1.2)
    system = StereoSlam(RIG, None, backend, config=SystemConfig.for_kind("handheld", None))
    results = []
    for k in range(85):
        here, _ = world.features(np.eye(4), k / 30, 0.3)
        there, _ = mover.features(se3.exp(np.array([0, 0, 0, -0.04 * (k - 10), 0, 0])), k / 30, 0.3)
        edge = 14.0 * (k - 20)
        covered = [(f.uv_left[:, 0] < edge) & (f.uv_left[:, 0] > edge - 520) for f in (here, there)]
        results.append(system.process_features(joined(here, ~covered[0], there, covered[1])))
    off = [float(np.linalg.norm(r.estimate.T_world_left[:3, 3])) for r in results]
    assert max(off) > 0.3  # taken along: that it is, others see to
    sigmas = [float(np.sqrt(np.trace(r.estimate.covariance[3:, 3:]))) for r in results]
    assert all(error < 3 * sigma for error, sigma in zip(off, sigmas))  # it grows where what fills the view changes
    assert max(off[k] for k, r in enumerate(results) if r.loop == 0) < 0.05
    assert off[-1] < 0.2 * max(off)
