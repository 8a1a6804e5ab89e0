"""What a summary says of the frames of a run."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from slam.calibration.model import Revision, RigCorrection, RigModel
from slam.data import CommonError, Estimate, FrameResult, FrameStatus, StereoFeatures, UpdateReport, UpdateStatus
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.models import models_for
from slam.run.outcome import motion_doubt
from slam.run.results import figures
from slam.run.run_record import RunRecord, results_of
from tests.slam.numeric import chained

N, SIGMA = 120, 0.01
NONE = np.zeros(0, np.int64)


STRAIGHT = np.tile(np.eye(4), (N, 1, 1))
STRAIGHT[:, 2, 3] = 0.2 * np.arange(N)
TRUTH = Trajectory(0.1 * np.arange(N), STRAIGHT)
SEQUENCE = SimpleNamespace(format="folder", ground_truth=TRUTH, truth_noise=TruthNoise(1e-4, 1e-3))


def estimated():
    """The true path with independent errors, the first pose without any."""
    rng = np.random.default_rng(0)
    poses = STRAIGHT @ np.array([exp(SIGMA * rng.standard_normal(6) * (k > 0)) for k in range(N)])
    return Trajectory(TRUTH.stamps, poses), np.array([SIGMA**2 * np.eye(6) * (k > 0) for k in range(N)])


def result_of(k, status, pose, covariance, **more):
    """What a system says of a frame with these."""
    stamp, nothing = TRUTH.stamps[k], np.zeros(0, np.intp)
    estimate = Estimate(stamp, pose, covariance, NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    report, features = UpdateReport(UpdateStatus.OK, "", NONE, NONE, 20.0, 10), StereoFeatures.empty(stamp)
    return FrameResult(
        k, status, "", estimate, report, features, 0, NONE, nothing, NONE, nothing, NONE, 7, {"update": 1.0}, **more
    )


def measured(statuses):
    """Figures of a run whose frames have these statuses, far off where they are not measured."""
    path, covariances = estimated()
    poses, record = path.poses.copy(), RunRecord()
    for k in range(N):
        status = statuses.get(k, FrameStatus.STARTED if k == 0 else FrameStatus.TRACKED)
        poses[k, :3, 3] += 5.0 * (k in statuses)
        record.add(k, result_of(k, status, poses[k], covariances[k]))
    summary = {"frames": N, "status": {name: record.statuses.count(name) for name in record.statuses}}
    final = Trajectory(path.stamps, poses)
    summary |= results_of(SEQUENCE, SimpleNamespace(landmarks=None), record, final, None)
    return figures(summary)


def test_frames_that_are_not_tracked_are_counted_and_left_out_of_the_accuracy():
    """Metres of error in 23 of 120 frames, none of which was measured: a figure of its own, not one of accuracy."""
    statuses = {k: FrameStatus.PREDICTED for k in range(40, 60)}
    statuses |= {70: FrameStatus.LOST, 71: FrameStatus.LOST, 80: FrameStatus.FAILED}
    found = measured(statuses)
    path, covariances = estimated()
    rows = np.array([k not in statuses for k in range(N)])
    alone = evaluate(path.select(rows), SEQUENCE)
    assert found["ate_online_m"] == found["ate_final_m"] == pytest.approx(alone["ATE RMSE [m]"])
    assert found["ate_online_m"] < 0.05
    honest = consistency(path.select(rows), covariances[rows], SEQUENCE)["mean NEES"]
    assert found["ratio_start"] == pytest.approx(np.sqrt(honest / 6))
    assert found["tracked"] == pytest.approx(97 / 120)


def test_a_path_that_lacks_frames_is_said(caplog):
    """Of a back end of one's own; the frames were left out of the final error without a word."""
    path, covariances = estimated()
    record = RunRecord(stamps=path.stamps.tolist(), poses=list(path.poses), covariances=list(covariances))
    record.measured, record.common = [True] * N, [CommonError()] * N
    record.milliseconds = [{}] * N
    results_of(SEQUENCE, SimpleNamespace(), record, path.select(np.arange(N - 3)), None)
    assert "trajectory() lacks 3 of 120 frames" in caplog.text and "singular" not in caplog.text
    far = Trajectory(path.stamps, np.linalg.inv(path.poses))
    results_of(SEQUENCE, SimpleNamespace(), record, far, None)
    assert "estimate() and trajectory() are 47.6 m apart" in caplog.text
    record.covariances = [np.zeros((6, 6))] * N
    results_of(SEQUENCE, SimpleNamespace(), record, path, None)
    assert "singular covariance for 119 of 120 poses" in caplog.text


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


@pytest.mark.parametrize("corrected", [False, True])
def test_where_the_rig_s_correction_moves_the_path_nothing_is_torn(corrected):
    """Speed on a drive changes with the disparities' error at once; images were said to be missing."""
    record, model = RunRecord(), RigModel(StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.5, 320, 240))
    no = RigCorrection(model, np.zeros(len(model.names)))
    for k in range(N):
        pose = exp(np.array([0, 0, 0, 0, 0, 1.45 * k if k < 5 else 1.45 * 4 + 1.2 * (k - 4)]))
        revision = Revision(no, no) if corrected and k == 5 else None
        record.add(k, result_of(k, FrameStatus.TRACKED, pose, np.eye(6), revision=revision))
    said = motion_doubt(record, models_for("driving").motion, driving=True)
    assert bool(said) != corrected and ("images are missing" in said) != corrected
