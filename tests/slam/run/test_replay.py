from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import slam
from experiments.simulated_recording import true_recording
from slam.calibration.posterior import RigPosterior
from slam.config import SystemConfig
from slam.data import FrameStatus
from slam.errors import MeasurementError, SequenceError
from slam.run.recording import RecordedFrame, Recording, load_recording, save_recording
from slam.run.replay import replay
from slam.system import StereoSlam

FRAMES = 12


@pytest.fixture(scope="module")
def desk():
    return slam.open_sequence(f"synthetic:desk?frames={FRAMES}")


@pytest.fixture(scope="module")
def recording(desk):
    return true_recording(desk)


def recorded_of(results, system):
    return Recording("desk", system.rig, system.config.models, tuple(map(RecordedFrame.of, results)))


def online(results):
    return np.array([r.estimate.T_world_left for r in results])


@pytest.mark.parametrize("rig", ["rectified", "toedin"])
def test_a_run_replayed_into_the_same_back_end_is_the_same_run(rig):
    desk = slam.open_sequence(f"synthetic:desk?frames={FRAMES}&rig={rig}")
    config = SystemConfig.for_kind("handheld", None).with_settings(["models.pixel_sigma=0.5"])  # the world's
    system = StereoSlam(desk.rig, None, "ekf", config=config)
    results = [system.process_features(desk.observations(k)) for k in range(FRAMES)]
    recorded = recorded_of(results, system)
    again = list(replay(recorded, StereoSlam(desk.rig, None, "ekf", config=config).backend))
    # Not the last bit: the pose on which all agree was found there among more candidates.
    np.testing.assert_allclose(online(again), online(results), atol=1e-9)
    for ours, theirs in zip(again, results):
        assert (ours.status, ours.map_size) == (theirs.status, theirs.map_size)
        assert (ours.predicted, ours.index) == (theirs.predicted, theirs.index)
        for name in ("matched", "added", "erased"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        np.testing.assert_array_equal(ours.report.used, theirs.report.used)
    assert again[0].status is FrameStatus.STARTED and again[-1].status is FrameStatus.TRACKED
    require_same_frames(recorded_of(again, system), recorded)


def require_same_frames(one, other):
    for a, b in zip(one, other, strict=True):
        assert (a.number, a.stamp) == (b.number, b.stamp)
        np.testing.assert_array_equal(a.removed, b.removed)
        for name in ("ids", "uv_left", "uv_right"):
            np.testing.assert_array_equal(getattr(a.observed, name), getattr(b.observed, name))
            np.testing.assert_array_equal(getattr(a.added, name), getattr(b.added, name))


def test_what_was_mended_in_a_run_is_mended_in_its_replay(desk, tmp_path, monkeypatch):
    offsets = {8: 0.3, 11: 0.2}  # what the self-calibration believes from a frame on [px]
    system = StereoSlam(desk.rig, None, "smoother")
    calibration, results = system.calibration, []
    monkeypatch.setattr(calibration, "observe", lambda *_: None)
    monkeypatch.setattr(calibration, "_motion_agrees", lambda: True)
    column = calibration.model.names.index("right_cx")
    for k in range(FRAMES):
        if k in offsets:
            mean, tight = np.zeros(len(calibration.model.names)), 1e-9 * np.eye(len(calibration.model.names))
            mean[column] = offsets[k] / calibration.model.focal
            calibration._own = RigPosterior(mean, tight)
        results.append(system.process_features(desk.observations(k)))
    revisions = [r.revision for r in results]
    assert [k for k, r in enumerate(revisions) if r is not None] == [8, 11]
    save_recording(recorded_of(results, system), tmp_path / "run.npz")
    recorded = load_recording(tmp_path / "run.npz")
    backend, given = StereoSlam(desk.rig, None, "smoother").backend, []
    z = np.array([[200.0, 100.0, 180.0]])
    monkeypatch.setattr(backend, "revise", lambda mend: given.append((len(backend.trajectory()), mend(z))))
    again = [r.revision for r in replay(recorded, backend)]
    assert [k for k, _ in given] == [8, 11]
    for k, mended in given:
        np.testing.assert_array_equal(mended, revisions[k].rows(z))
        np.testing.assert_array_equal(again[k].after.parameters, revisions[k].after.parameters)
    assert given[0][1][0, 2] == pytest.approx(180.3, abs=0.02)
    assert len(list(replay(recorded, StereoSlam(desk.rig, None, "ekf").backend))) == FRAMES


def test_a_file_holds_it_all(recording, tmp_path):
    save_recording(recording, tmp_path / "run.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]
    again = load_recording(tmp_path / "run.npz")
    assert (again.name, again.models) == (recording.name, recording.models)
    assert (again.rig.left, again.rig.right) == (recording.rig.left, recording.rig.right)
    np.testing.assert_array_equal(again.rig.b, recording.rig.b)
    require_same_frames(again, recording)
    np.testing.assert_array_equal(again.ground_truth.poses, recording.ground_truth.poses)


def headed(**more):
    return lambda a: {**a, "header": json.dumps(json.loads(str(a["header"])) | more)}


def rows(column, change):
    """The rows with a column changed."""

    def spoil(a):
        changed = a["rows"].copy()
        changed[:, column] = change(changed[:, column])
        return {**a, "rows": changed}

    return spoil


FAULTS = {
    "a later version": (headed(version=4), "version 4"),
    "time runs back": (lambda a: {**a, "stamps": a["stamps"][::-1]}, "stamps must be finite and increase"),
    "an unknown landmark": (rows(2, lambda ids: ids + np.arange(len(ids))), "not in the map"),
    "a landmark twice": (rows(2, lambda ids: ids * 0), "stands twice"),
    "an unknown setting": (headed(models={"motion": {}, "objects": {}, "haste": 1}), "haste"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damaged_files_are_refused_in_one_line(recording, tmp_path, fault):
    spoil, words = FAULTS[fault]
    save_recording(recording, tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        np.savez(tmp_path / "bad.npz", **spoil({key: file[key] for key in file.files}))
    with pytest.raises(SequenceError, match=words) as caught:
        load_recording(tmp_path / "bad.npz")
    assert "bad.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_recordings_are_checked_when_made(recording):
    with pytest.raises(MeasurementError, match="removed"):
        first, *others = recording.frames
        replace(recording, frames=(replace(first, removed=np.array([10**6])), *others))
