from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slam.compare import trial
from slam.compare.plan import Trial
from slam.compare.sweep import RUNS, is_done, read_run
from slam.compare.trial import COMPLETED, keep_result
from slam.data import CommonError, Estimate, FrameResult, FrameStatus, StereoFeatures, UpdateReport, UpdateStatus
from slam.errors import SlamError
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.se3 import exp
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.run.results import figures
from slam.run.summary import RunRecord, results_of

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
    assert found["nees_per_dof"] == pytest.approx(honest / 6)
    assert found["tracked"] == pytest.approx(97 / 120)


@pytest.mark.parametrize("mode", ["closed loop", "replay"])
def test_a_run_knows_the_kind_of_motion_of_its_sequence(mode, tmp_path, monkeypatch):
    """Drives were doubted as too fast for a hand."""
    kinds = []

    def stopped(sequence, options, *others, **more):
        kinds.append(options.kind)
        raise SlamError("enough")

    for name in ("run", "run_recording"):
        monkeypatch.setattr(trial, name, stopped)
    monkeypatch.setattr(trial, "load_recording", lambda path: path)
    drive = Trial("synthetic:street?frames=2", "ekf", mode=mode)
    trial.run_trial(drive, tmp_path, None if mode == "closed loop" else tmp_path / "recording.npz")
    assert kinds == ["driving"]


def test_what_was_run_with_other_settings_or_frames_is_not_done(tmp_path):
    """It lies there where a comparison that replaces another one was interrupted."""
    trial = Trial("synthetic:desk?frames=5", "ekf", settings=("frontend.features=100",))
    keep_result(trial, tmp_path / RUNS / trial.folder, COMPLETED, {"ate_online_m": 0.1})
    assert is_done(trial, tmp_path)
    other = replace(trial, settings=("frontend.features=900",))
    assert not is_done(other, tmp_path) and not is_done(replace(trial, stop=3), tmp_path)


def test_a_figure_that_is_no_number_is_none_of_the_run(tmp_path):
    """A camera that stands has no drift by distance."""
    trial = Trial("synthetic:desk?frames=5", "ekf")
    keep_result(trial, tmp_path / RUNS / trial.folder, COMPLETED, {"segment_percent": np.nan, "ate_online_m": 0.1})
    assert read_run(trial, tmp_path).metrics == {"completed": 1.0, "ate_online_m": 0.1}


def test_a_path_that_lacks_frames_is_said(caplog):
    """Of a back end of one's own; the frames were left out of the final error without a word."""
    path, covariances = estimated()
    record = RunRecord(stamps=path.stamps.tolist(), poses=list(path.poses), covariances=list(covariances))
    record.measured, record.common = [True] * N, [CommonError()] * N
    record.milliseconds, record.times = [{}] * N, path.stamps.tolist()
    results_of(SEQUENCE, SimpleNamespace(), record, path.select(np.arange(N - 3)), None)
    assert "trajectory() lacks 3 of 120 frames" in caplog.text
