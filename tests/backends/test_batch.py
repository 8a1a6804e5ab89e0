"""The batch optimum: without noise it is the truth, with noise the yardstick; it fails in one line at most."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

import slam
from backends.batch import BatchBackend
from backends.smoother.graph import SolverError
from experiments.simulated_recording import true_recording
from slam.data import StereoFeatures
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel, models_for
from slam.run.replay import Replay
from slam.system import StereoSlam
from slam.worlds import open_world
from tests.backends.scenes import RIG, path, run, scene, with_far_points

MODELS = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=0.5)


def drive(frames: int = 20):
    return scene(path(frames, 0.1, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.03, 0.0])), points=120)


@pytest.mark.parametrize("world", ["desk", "aisle", "street"])
def test_without_noise_smoother_and_batch_are_the_truth(world):
    sequence = slam.open_sequence(f"synthetic:{world}?frames=15&sigma=0&outliers=0")
    models = replace(models_for(sequence.kind), pixel_sigma=0.01)
    recording = true_recording(sequence, models=models)
    batch = BatchBackend(recording.rig, models)
    online = np.array([r.estimate.T_world_left for _, r in Replay(recording, batch).run()])
    truth = se3.inverse(sequence.ground_truth.poses[0]) @ sequence.ground_truth.poses
    for name, poses in (("online", online), ("batch", batch.trajectory().poses)):
        off = np.abs(se3.log(se3.inverse(truth) @ poses))
        # What is left is the pull of the motion prior against measurements of 0.01 px.
        assert off.max() < 1e-6, f"{name}: off by {off.max()}"


def test_a_problem_that_cannot_be_solved_is_one_line(monkeypatch):
    class Broken:
        def __init__(self, *_):
            raise RuntimeError("Indeterminant linear system\ndetected while working near x5")

    data = drive(5)
    backend = BatchBackend(RIG, MODELS)
    run(backend, data)
    monkeypatch.setattr(gtsam, "LevenbergMarquardtOptimizer", Broken)
    with pytest.raises(SolverError, match="Indeterminant") as caught:
        backend.trajectory()
    assert "\n" not in str(caught.value)


def test_far_landmarks_leave_it_its_own_covariances(caplog):
    """One that went to infinity took those of everything away."""
    data = with_far_points(30, 3.0)
    backend = BatchBackend(RIG, EstimatorModels(MotionModel(1.0, 0.3), 0.7, initial_velocity_sigma=15.0))
    run(backend, data)
    found = backend.estimate()
    off = se3.log(se3.inverse(found.T_world_left) @ data.poses[-1])
    assert off @ np.linalg.solve(found.covariance, off) < 25
    assert "the estimate is the smoother's" not in caplog.text
    near = np.linalg.norm(data.points[found.ids] - data.poses[-1][:3, 3], axis=1) < 60
    off = (found.positions - data.points[found.ids])[near]
    assert np.median(np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariances[near]), off)) < 6


def test_the_attitude_at_the_start_is_not_measured():
    """Nothing is measured but relative to it: the motion's prior took three quarters of its variance away."""
    data = scene(path(40, 0.1, np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.03, 0.0])), points=150)
    backend = BatchBackend(RIG, replace(MODELS, initial_rotation_sigma=0.2))
    run(backend, data)
    assert np.linalg.eigvalsh(backend.estimate().covariance[:3, :3]).min() > 0.99 * 0.2**2


@pytest.mark.parametrize(
    ("dark", "stamps"),
    [
        ((0,), (0.0, 1.5)),
        ((0,), (0.0, 1.5, 1.6, 1.7, 1.8)),
        ((0, 1), (0.0, 0.5, 0.6)),
        ((0, 1, 2, 3), (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)),
    ],
)
def test_dark_frames_at_the_start_leave_a_path_and_a_map(dark, stamps):
    world = open_world("desk?frames=10")
    system = StereoSlam(world.rig, None, "batch")
    for k, stamp in enumerate(stamps):
        seen = world.observations(k)
        nothing = StereoFeatures.empty(stamp, seen.descriptors.shape[1])
        system.process_features(nothing if k in dark else replace(seen, stamp=stamp))
    path, found = system.trajectory(), system.estimate()
    assert path.stamps.tolist() == list(stamps) and np.isfinite(path.poses).all()
    assert len(found.ids) and np.isfinite(found.positions).all() and np.linalg.eigvalsh(found.covariances).min() > 0
