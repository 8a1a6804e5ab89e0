"""The pose graph over the ends of loops gives what one over all keyframes gives."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.atlas.closing import disagreement, is_informative
from slam.atlas.keyframes import Loop
from slam.atlas.pose_graph import Chain, PoseGraph
from slam.geometry.se3 import exp, inverse, log
from tests.slam.numeric import chained

SIGMAS = np.array([1e-3, 2e-3, 1e-3, 0.02, 0.01, 0.03])


def circle(count: int = 60, laps: float = 1.5) -> np.ndarray:
    """True poses (N, 4, 4) of a camera that goes round and comes back."""
    step = exp(np.array([0.0, 2 * np.pi * laps / count, 0.0, 0.0, 0.0, 1.0]))
    return chained([step] * (count - 1))


def steps_of(poses: np.ndarray) -> np.ndarray:
    """From each pose (N, 4, 4) to the next."""
    return inverse(poses[:-1]) @ poses[1:]


def problem(seed: int) -> tuple[np.ndarray, Chain, tuple[Loop, ...]]:
    """True poses, a chain with drift, and loops after one lap."""
    rng = np.random.default_rng(seed)
    true = circle()
    odom = chained(steps_of(true) @ exp(rng.normal(size=(len(true) - 1, 6)) * SIGMAS))
    sigma = np.array([1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02])
    loops = tuple(
        Loop(i, i + 40, inverse(true[i]) @ true[i + 40] @ exp(rng.normal(size=6) * sigma), np.diag(sigma**2), 50)
        for i in (2, 9, 15)
    )
    return true, Chain(odom, np.tile(np.diag(SIGMAS**2), (len(true), 1, 1))), loops


def whole(chain: Chain, loops: tuple[Loop, ...]) -> tuple[gtsam.Values, gtsam.Marginals]:
    """The problem with all keyframes as variables."""

    def pose3(T: np.ndarray) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3])

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, pose3(chain.poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for i, T in enumerate(chain.poses):
        values.insert(i, pose3(T))
        if i:
            step = pose3(inverse(chain.poses[i - 1]) @ T)
            graph.add(gtsam.BetweenFactorPose3(i - 1, i, step, gtsam.noiseModel.Gaussian.Covariance(chain.steps[i])))
    for loop in loops:
        noise = gtsam.noiseModel.Gaussian.Covariance(loop.covariance)
        graph.add(gtsam.BetweenFactorPose3(loop.first, loop.second, pose3(loop.T_first_second), noise))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return values, gtsam.Marginals(graph, values)


def test_the_same_as_with_all_keyframes():
    _, chain, loops = problem(0)
    solution = PoseGraph.solved(chain, loops, chain.poses)
    values, marginals = whole(chain, loops)
    full = np.array([values.atPose3(i).matrix() for i in range(len(chain.poses))])
    # Stretches are linearised where the path is, so it is the same to second order of the change, which is some 0.1 m.
    moved = np.linalg.norm(full[:, :3, 3] - chain.poses[:, :3, 3], axis=1).max()
    assert moved > 0.05
    assert np.abs(solution.keyframe_poses() - full).max() < 0.05 * moved
    expected = marginals.marginalCovariance(len(full) - 1)
    np.testing.assert_allclose(solution.covariance()[:6, :6], expected, atol=0.02 * np.abs(expected).max())


TURN_AND_SCALE = np.array([[0, 4e-3, 0, 0, 0, 0], [0, 0, 0, 0, 0, 2e-2]]).T  # of a step, for errors of unit variance


def problem_with_common_errors(seed: int) -> tuple[np.ndarray, Chain, tuple[Loop, ...], np.ndarray]:
    """As `problem`, where each step is turned too far and too long by what all steps share (2,)."""
    true, chain, loops = problem(seed)
    errors = np.random.default_rng(1000 + seed).normal(size=2)
    odom = chained(steps_of(chain.poses) @ exp(-TURN_AND_SCALE @ errors))
    common = np.tile(TURN_AND_SCALE, (len(true), 1, 1))
    return true, Chain(odom, chain.steps, common), loops, errors


def test_common_errors_are_found_and_the_covariance_is_right():
    nees, apart, found = [], [], []
    for seed in range(20):
        true, chain, loops, errors = problem_with_common_errors(seed)
        solution = PoseGraph.solved(chain, loops, chain.poses)
        error = np.concatenate([log(inverse(solution.keyframe_poses()[-1]) @ true[-1]), errors - solution.common])
        nees.append(error @ np.linalg.solve(solution.covariance(), error))
        found.append(errors[0] - solution.common[0])
        noise = chain.steps + chain.common @ np.swapaxes(chain.common, 1, 2)
        other = PoseGraph.solved(Chain(chain.poses, noise), loops, chain.poses)
        apart.append(np.linalg.norm(other.keyframe_poses()[:, :3, 3] - true[:, :3, 3], axis=1).mean())
        apart[-1] -= np.linalg.norm(solution.keyframe_poses()[:, :3, 3] - true[:, :3, 3], axis=1).mean()
    assert 5.5 < np.mean(nees) < 10.5  # 8 is right, with a deviation of 0.9
    assert np.std(found) < 0.3  # of 1: where the lap closes says how far each step turns
    assert np.mean(apart) > 0  # better than with errors that are taken for noise of each step


def test_a_motion_has_the_common_errors_in_its_covariance():
    _, chain, _, _ = problem_with_common_errors(0)
    _, P = PoseGraph.solved(chain, (), chain.poses, (10, 25)).relative_pose(10, 25)
    _, expected = chain.motion(10, 25)
    np.testing.assert_allclose(P, expected, atol=1e-3 * np.abs(expected).max())
    short = chain.motion(10, 11)[1] - chain.steps[11]
    assert np.trace(expected) > 15 * np.trace(short)  # they add up


def test_steps_without_noise_leave_a_covariance():
    rng, true, nees = np.random.default_rng(6), circle(), []
    for _ in range(20):
        common, errors = 1e-3 * rng.normal(size=(len(true), 6, 8)), rng.normal(size=8)
        some = [*range(10, 16), *range(50, 56)]  # keyframes one after the other that all close a loop
        steps = np.tile(np.diag(SIGMAS**2), (len(true), 1, 1))
        steps[some, :, 2:] = steps[some, 2:, :] = 0
        sigmas = np.sqrt(np.diagonal(steps, axis1=1, axis2=2))[1:]
        odom = chained(steps_of(true) @ exp(-(common[1:] @ errors + sigmas * rng.normal(size=sigmas.shape))))
        P = np.diag(np.repeat([1e-3, 0.02], 3) ** 2)
        loops = [
            Loop(k, k + 40, inverse(true[k]) @ true[k + 40] @ exp(np.linalg.cholesky(P) @ rng.normal(size=6)), P, 50)
            for k in range(9, 16)
        ]
        solution = PoseGraph.solved(Chain(odom, steps, common), loops, odom)
        assert np.linalg.eigvalsh(solution.covariance())[0] > 0
        error = np.concatenate([log(inverse(solution.keyframe_poses()[-1]) @ true[-1]), errors - solution.common])
        nees.append(error @ np.linalg.solve(solution.covariance(), error))
    assert 10 < np.mean(nees) < 22  # 14 is right, with a deviation of 1.2


def test_a_loop_says_little_where_earlier_ones_have_told_as_much():
    """Two equal loops are as good as one that is twice as sure."""
    true, chain, loops, _ = problem_with_common_errors(4)
    chain, loop = Chain(true, chain.steps), loops[0]
    untold, told = (PoseGraph.solved(chain, some, true, loop.pair) for some in ((), (loop, loop)))
    assert is_informative(untold, loop)
    assert not is_informative(told, loop)
    assert is_informative(told, replace(loop, covariance=0.1 * loop.covariance))


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
