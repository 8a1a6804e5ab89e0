"""How far a loop is from the path: both are uncertain."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.se3 import exp
from slam.mapping.atlas.chain import Chain
from slam.mapping.atlas.closing import disagreement
from slam.mapping.atlas.keyframes import Loop
from slam.mapping.atlas.pose_graph import PoseGraph


@pytest.mark.parametrize("share", [0.1, 1.0, 10.0])  # of the path's covariance, that of the loop
def test_a_loops_own_covariance_counts_beside_the_paths(share):
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.arange(5)
    steps = np.tile(np.diag([1e-4] * 3 + [1e-2] * 3), (5, 1, 1))
    graph = PoseGraph.solved(Chain(poses, steps), [], poses, [1, 3])
    T, P = graph.relative_pose(1, 3)
    np.testing.assert_allclose(T, poses[2], atol=1e-9)
    off = 0.05 * rng.standard_normal(6)
    loop = Loop(1, 3, T @ exp(off), share * P, 30)
    expected = off @ np.linalg.solve(P, off) / (1 + share)
    assert disagreement(graph, loop) == pytest.approx(expected, rel=1e-6)
