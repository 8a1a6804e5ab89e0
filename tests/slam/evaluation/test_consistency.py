"""NEES of relative poses, against simulated odometry whose covariances are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from slam.data import CommonError
from slam.evaluation.consistency import consistency_figures
from slam.evaluation.joint_errors import JointErrors
from slam.evaluation.summary import evaluate
from slam.geometry.se3 import adjoint, exp, inverse
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.run.results import verdict
from tests.slam.numeric import chained

STEP = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 1.0])  # a turn of 0.02 rad and 1 m forward
SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.02])
NONE = TruthNoise()


def odometry(seed: int, frames: int = 60, noise: TruthNoise = NONE):
    """Estimated and true path, and the covariances that the estimate claims."""
    rng = np.random.default_rng(seed)
    A, P = adjoint(inverse(exp(STEP))), [1e-12 * np.eye(6)]
    true = chained([exp(STEP)] * (frames - 1))
    own = chained(exp(STEP) @ exp(SIGMA * rng.normal(size=(frames - 1, 6))))
    for _ in range(frames - 1):
        P.append(A @ P[-1] @ A.T + np.diag(SIGMA**2))
    scale = np.repeat([noise.rotation, noise.translation], 3)
    seen = np.array([T @ exp(scale * rng.normal(size=6)) for T in true])
    stamps = np.arange(frames) * 0.1
    return Trajectory(stamps, own), Trajectory(stamps, seen), np.array(P)


def mean_over_seeds(noise: TruthNoise = NONE) -> dict[str, float]:
    runs = [consistency_figures(*odometry(seed, noise=noise), noise) for seed in range(40)]
    return {key: float(np.mean([run[key] for run in runs])) for key in runs[0]}


def test_relative_nees_of_honest_odometry_is_six():
    figures = mean_over_seeds()
    for key in ("mean NEES", "NEES over 1 m", "NEES over 10 m"):
        assert 5.0 < figures[key] < 7.0, key
    assert "NEES over 100 m" not in figures
    assert figures["share of truth over 10 m"] == 0.0
    noisy = mean_over_seeds(TruthNoise(rotation=0.01, translation=1.0))
    assert noisy["share of truth over 10 m"] > 0.9 and 5.0 < noisy["NEES over 10 m"] < 7.0
    band = f"{np.sqrt(figures['band low'] / 6):.2f} to {np.sqrt(figures['band high'] / 6):.2f}"
    assert band in verdict({"ratio_start": 1.0})  # one band in a summary and in what is said of it


def with_noise_of_each_frame(seed: int) -> tuple[Trajectory, Trajectory, np.ndarray, list[np.ndarray]]:
    """Odometry with online poses that have an error of their own in each frame, which later frames do not have.

    It is as large as the growth over nine frames. Last come the covariances of five errors with the newest of them.
    """
    own, true, P = odometry(seed)
    rng, alone, A = np.random.default_rng([seed, 2]), 9 * np.diag(SIGMA**2), adjoint(inverse(exp(STEP)))
    own = Trajectory(own.stamps, own.poses @ exp(3 * SIGMA * rng.normal(size=(len(own), 6))))
    blocks = []
    for k in range(len(own)):
        earlier = [P[k - lag] @ np.linalg.matrix_power(A, lag).T for lag in range(min(k, 4), 0, -1)]
        blocks.append(np.array([*earlier, P[k] + alone]))
    return own, true, P + alone, blocks


def test_errors_of_each_frame_alone_are_told_from_drift_by_the_last_poses():
    every, joint, alone = np.arange(60), [], []
    for seed in range(40):
        own, true, P, blocks = with_noise_of_each_frame(seed)
        joint.append(consistency_figures(own, true, P, NONE, None, JointErrors.of(blocks, every)))
        alone.append(consistency_figures(own, true, P, NONE))
    for key in ("mean NEES", "NEES over 1 m", "NEES over 10 m"):
        assert 4.0 < np.mean([run[key] for run in joint]) < 7.0, key
    assert not any("no covariance" in key for run in joint for key in run)
    assert np.mean([run["NEES over 10 m"] for run in alone]) > 9.0


@pytest.mark.parametrize("told", [0, 1])
def test_joint_errors_are_not_known_across_a_frame_of_which_the_back_end_tells_nothing_before(told):
    *_, P, blocks = with_noise_of_each_frame(0)
    blocks[30] = blocks[30][5 - told :]
    first, last = np.array([5, 28, 29, 31, 40, 7]), np.array([20, 30, 40, 34, 55, 7])
    found = JointErrors.of(blocks, np.arange(60)).between(first, last)
    assert np.isfinite(found).all(axis=(1, 2)).tolist() == [True, False, False, True, True, True]
    assert np.allclose(found[3], blocks[34][1].T) and np.allclose(found[5], P[7])
    alone = JointErrors.of([each[-1:] for each in blocks], np.arange(60)).between(first, last)
    assert np.isfinite(alone).all(axis=(1, 2)).tolist() == [False, False, False, False, False, True]


def test_a_constant_turn_of_the_truths_sensor_is_no_rotation_error():
    own, true, _ = odometry(0)
    turned = Trajectory(true.stamps, true.poses @ exp(np.array([0.01, -0.02, 0.01, 0, 0, 0])))
    noise = TruthNoise(mounting=0.02)
    plain, exact, known = (
        evaluate(own, SimpleNamespace(ground_truth=truth, truth_noise=noise))["rotation RMSE from start [deg]"]
        for truth, noise in ((true, NONE), (turned, NONE), (turned, noise))
    )
    assert exact > 1.2 * plain
    assert known < 1.05 * plain


def test_a_length_over_which_the_frames_own_errors_are_larger_than_the_growth_has_no_figure():
    own, true, P = odometry(0)
    figures = consistency_figures(own, true, P + np.diag(np.repeat([0.02, 0.05], 3) ** 2), NONE)
    assert figures["no covariance over 10 m"] > 0.5 and "NEES over 10 m" not in figures


def with_common_error(seed: int):
    """Odometry of a rig whose baseline is wrong by 2 %: the same in all frames, and known to be possible."""
    own, true, P = odometry(seed)
    off = 0.02 * np.random.default_rng([seed, 1]).normal()
    shares, common = np.zeros((6, 1)), []
    for k in range(len(own)):
        if k:
            A = adjoint(inverse(inverse(true.poses[k - 1]) @ true.poses[k]))
            shares = A @ shares + np.concatenate([np.zeros(3), STEP[3:]])[:, None]
        common.append(CommonError(shares, np.array([[0.02]])))
        own.poses[k] = own.poses[k] @ exp(-off * shares[:, 0])
    return own, true, P + np.array([c.covariance for c in common]), common


def test_stretches_across_a_loop_are_left_out_and_counted_where_shared_errors_shrink_there():
    """After a loop nothing is known apart, and the whole covariance may be smaller than the shared part before it."""
    own, true, P, common = with_common_error(0)
    honest = consistency_figures(own, true, P, NONE, common)
    A, P[29] = adjoint(inverse(exp(STEP))), P[29] - 0.4 * common[29].covariance
    for k in range(30, 60):
        common[k], P[k] = CommonError(), A @ P[k - 1] @ A.T + np.diag(SIGMA**2)
    P[29] += 0.4 * common[29].covariance
    figures = consistency_figures(own, true, P, NONE, common)
    assert "no covariance over 10 m" not in honest
    assert 0.0 < figures["no covariance over 10 m"] < 0.5
    assert figures["NEES over 10 m"] > 3.0
    assert np.isfinite(figures["mean NEES"])


def test_errors_that_all_poses_share_count_once():
    runs = [with_common_error(seed) for seed in range(40)]
    apart = [consistency_figures(own, true, P, NONE, common) for own, true, P, common in runs]
    for key in ("mean NEES", "NEES over 1 m", "NEES over 10 m"):
        assert 4.8 < np.mean([figures[key] for figures in apart]) < 7.2, key


@pytest.mark.parametrize(("constant", "known"), [
    ([0.01, -0.02, 0.005, 0, 0, 0], {"mounting": 0.02}),
    ([0, 0, 0, 0.5, 0.4, -0.3], {"lever": 0.5}),
])  # fmt: skip
def test_how_the_other_sensor_is_mounted_is_found(constant, known):
    noise = TruthNoise(rotation=1e-4, translation=0.01, **known)
    mounted = exp(np.array(constant, float))
    figures = []
    for seed in range(10):
        own, true, P = odometry(seed, noise=noise)
        figures.append(consistency_figures(own, Trajectory(true.stamps, true.poses @ mounted), P, noise))
    assert 4.5 < np.mean([f["NEES over 10 m"] for f in figures]) < 7.0
    fixed = consistency_figures(own, Trajectory(true.stamps, true.poses @ mounted), P, TruthNoise(1e-4, 0.01))
    assert fixed["NEES over 10 m"] > 12


def test_a_clock_that_is_ahead_is_found():
    """A camera that is waved: at a constant rate a clock's error would be none of the relative pose."""
    stamps, late, NEES = np.arange(200) / 20, 0.02, {}
    waved = np.array([0.02, 0.0, 0.03, 0.1, 0.05, 0.0])

    def true(times):
        return exp(waved * np.sin(4 * times)[:, None] + np.array([0, 0, 0, 0, 0, 0.4]) * times[:, None])

    P = np.tile(np.diag(np.repeat([1e-6, 1e-5], 3)), (len(stamps), 1, 1)) * (1 + np.arange(len(stamps)))[:, None, None]
    own, shown = Trajectory(stamps, true(stamps)), Trajectory(stamps, true(stamps + late))
    for clock in (0.0, 0.01):
        figures = consistency_figures(own, shown, P, TruthNoise(1e-5, 1e-4, clock=clock))
        NEES[clock] = figures["NEES over 1 m"]
    assert NEES[0.01] < 0.05 * NEES[0.0]
