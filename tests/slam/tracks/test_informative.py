"""Choosing the measurements that tell most of the camera's motion."""

from __future__ import annotations

import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.data import Prediction
from slam.errors import ConfigurationError
from slam.models import EstimatorModels
from slam.tracks.informative import most_informative

RIG = slam.open_sequence("synthetic:desk?frames=2").rig
MODELS = EstimatorModels()


def _prediction(ids: np.ndarray, variance: np.ndarray) -> Prediction:
    none = np.zeros((len(ids), 2))
    return Prediction(0.0, np.eye(4), np.eye(6), ids, none, none, np.eye(2) * variance[:, None, None])


def _points(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-1, 1, count), rng.uniform(-0.7, 0.7, count), rng.uniform(1.5, 4, count)])


def test_takes_spread_landmarks_before_those_beside_each_other():
    crowd = np.array([0.0, 0.0, 3.0]) + 0.01 * _points(30)
    corners = np.array([[x, y, 2.5] for x in (-1.0, 1.0) for y in (-0.6, 0.6)])
    positions, ids = np.concatenate([crowd, corners]), np.arange(34)
    chosen = most_informative(RIG, MODELS, _prediction(ids, np.ones(34)), ids, positions, 0.05, 10)
    assert len(chosen) == 10
    assert set(range(30, 34)) <= set(chosen.tolist())


def test_leaves_out_landmarks_that_are_hardly_known():
    positions, ids = np.repeat(_points(20), 2, axis=0), np.arange(40)
    variance = np.where(ids % 2 == 0, 1.0, 1e4)
    chosen = most_informative(RIG, MODELS, _prediction(ids, variance), ids, positions, 0.05, 20)
    assert (chosen % 2 == 0).sum() >= 18


def test_tells_more_than_a_random_choice():
    positions, ids = _points(80), np.arange(80)
    prediction = _prediction(ids, np.ones(80))
    chosen = most_informative(RIG, MODELS, prediction, ids, positions, 0.05, 20)

    def determinant(rows: np.ndarray) -> float:
        from slam.geometry.se3 import points_by_pose

        J = (RIG.project_stereo(positions[rows])[1] @ points_by_pose(positions[rows])).reshape(-1, 6)
        return float(np.linalg.slogdet(J.T @ J)[1])

    rng = np.random.default_rng(1)
    others = [determinant(rng.choice(80, 20, replace=False)) for _ in range(50)]
    assert determinant(chosen) > max(others)


def test_takes_all_where_there_are_no_more():
    ids = np.arange(5)
    assert most_informative(RIG, MODELS, _prediction(ids, np.ones(5)), ids, _points(5), 0.05, 10).tolist() == [
        *range(5)
    ]


@pytest.mark.parametrize("backend", ["ekf", "smoother", "window"])
def test_a_run_measures_no_more_and_keeps_the_others_in_the_map(backend: str):
    sequence = slam.open_sequence("synthetic:aisle?frames=15")
    config = SystemConfig.for_kind(sequence.kind, None, backend).with_settings(["association.measured=20"])
    system = slam.StereoSlam(sequence.rig, None, backend, kind=sequence.kind, config=config)
    results = [system.process_features(sequence.observations(k)) for k in range(15)]
    assert all(len(r.report.used) + len(r.report.rejected) <= 20 for r in results[1:])
    assert all(len(r.matched) > 30 for r in results[1:])
    assert all(r.status.value == "tracked" for r in results[1:])
    moved, true = results[-1].estimate.T_world_left, sequence.ground_truth.poses
    assert np.linalg.norm(moved[:3, 3] - (np.linalg.inv(true[0]) @ true[14])[:3, 3]) < 0.02


def test_fewer_than_ten_are_refused():
    with pytest.raises(ConfigurationError, match="measured"):
        SystemConfig().with_settings(["association.measured=5"])
