"""What a summary says of the frames of a run."""

from types import SimpleNamespace

import numpy as np
import pytest

from slam.data import CommonError, Estimate, FrameResult, FrameStatus, StereoFeatures, UpdateReport, UpdateStatus
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.se3 import exp
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.run.results import figures
from slam.run.run_record import RunRecord, results_of
from tests.slam.numeric import chained, straight

N, SIGMA = 60, 0.01
NONE = np.zeros(0, np.int64)


TRUTH = straight(N, 0.2)
SEQUENCE = SimpleNamespace(format="folder", ground_truth=TRUTH, truth_noise=TruthNoise(1e-4, 1e-3))


def estimated():
    """The true path with independent errors, the first pose without any."""
    rng = np.random.default_rng(0)
    poses = TRUTH.poses @ np.array([exp(SIGMA * rng.standard_normal(6) * (k > 0)) for k in range(N)])
    return Trajectory(TRUTH.stamps, poses), np.array([SIGMA**2 * np.eye(6) * (k > 0) for k in range(N)])


def measured(statuses):
    """Figures of a run whose frames have these statuses, far off where they are not measured."""
    path, covariances = estimated()
    poses, record, nothing = path.poses.copy(), RunRecord(), np.zeros(0, np.intp)
    for k in range(N):
        status = statuses.get(k, FrameStatus.STARTED if k == 0 else FrameStatus.TRACKED)
        poses[k, :3, 3] += 5.0 * (k in statuses)
        estimate = Estimate(path.stamps[k], poses[k], covariances[k], NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)))
        report = UpdateReport(UpdateStatus.OK, "", NONE, NONE, 20.0, 10)
        features = StereoFeatures.empty(path.stamps[k])
        record.add(k, FrameResult(
            k, status, "", estimate, report, features, 0, NONE, nothing, NONE, nothing, NONE, 7, {"update": 1.0}
        ))  # fmt: skip
    summary = {"frames": N, "status": {name: record.statuses.count(name) for name in record.statuses}}
    final = Trajectory(path.stamps, poses)
    summary |= results_of(SEQUENCE, SimpleNamespace(landmarks=None), record, final, None)
    return figures(summary)


def test_frames_that_are_not_tracked_are_counted_and_left_out_of_the_accuracy():
    """Metres of error in 13 of 60 frames, none of which was measured: a figure of its own, not one of accuracy."""
    statuses = {k: FrameStatus.PREDICTED for k in range(20, 30)}
    statuses |= {35: FrameStatus.LOST, 36: FrameStatus.LOST, 40: FrameStatus.FAILED}
    found = measured(statuses)
    path, covariances = estimated()
    rows = np.array([k not in statuses for k in range(N)])
    alone = evaluate(path.select(rows), SEQUENCE)
    assert found["ate_online_m"] == found["ate_final_m"] == pytest.approx(alone["ATE RMSE [m]"])
    assert found["ate_online_m"] < 0.05
    honest = consistency(path.select(rows), covariances[rows], SEQUENCE)["mean NEES"]
    assert found["ratio_start"] == pytest.approx(np.sqrt(honest / 6))
    assert found["tracked"] == pytest.approx(47 / 60)


@pytest.mark.slow
def test_a_path_that_lacks_frames_is_said(caplog):
    """Of a back end of one's own; the frames were left out of the final error without a word."""
    path, covariances = estimated()
    record = RunRecord(stamps=path.stamps.tolist(), poses=list(path.poses), covariances=list(covariances))
    record.measured, record.common = [True] * N, [CommonError()] * N
    record.milliseconds = [{}] * N
    results_of(SEQUENCE, SimpleNamespace(), record, path.select(np.arange(N - 3)), None)
    assert "trajectory() lacks 3 of 60 frames" in caplog.text and "singular" not in caplog.text
    far = Trajectory(path.stamps, np.linalg.inv(path.poses))
    results_of(SEQUENCE, SimpleNamespace(), record, far, None)
    assert "estimate() and trajectory() are 23.6 m apart" in caplog.text
    record.covariances = [np.zeros((6, 6))] * N
    results_of(SEQUENCE, SimpleNamespace(), record, path, None)
    assert "singular covariance for 59 of 60 poses" in caplog.text


def test_truth_that_begins_after_the_first_image_is_judged_from_there_and_a_wrong_one_not_at_all(caplog):
    record = RunRecord(milliseconds=[{}] * N, measured=[True] * N, common=[CommonError()] * N)
    steps = np.array([exp(0.1 * SIGMA * step) for step in np.random.default_rng(0).standard_normal((N, 6))])
    poses = chained(exp(np.array([0, 0, 0, 0, 0, 0.2])) @ steps[1:])
    record.stamps, record.poses = TRUTH.stamps.tolist(), list(poses)
    record.covariances = [(0.1 * SIGMA) ** 2 * k * np.eye(6) for k in range(N)]
    late = SimpleNamespace(format="folder", ground_truth=TRUTH.select(np.arange(20, N)), truth_noise=TruthNoise())
    final = Trajectory(TRUTH.stamps, poses)
    found = results_of(late, SimpleNamespace(), record, final, None)
    assert "mean NEES" in found["consistency"] and found["consistency"]["poses before the truth"] == 20
    late.ground_truth.poses[:, :3, 3] *= 1000.0
    found = results_of(late, SimpleNamespace(), record, final, None)
    assert "is it in mm?" in found["truth_doubt"] == caplog.messages[-1] and "mean NEES" not in found["consistency"]
