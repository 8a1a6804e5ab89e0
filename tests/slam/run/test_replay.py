import json
from dataclasses import replace

import numpy as np
import pytest

import slam
from experiments.simulated_recording import true_recording
from slam.calibration.model import Revision, RigCorrection, RigModel
from slam.config import SystemConfig
from slam.data import FrameStatus
from slam.errors import SequenceError
from slam.run.recording import RecordedFrame, Recording, load_recording, save_recording
from slam.run.replay import Replay
from slam.system import StereoSlam

FRAMES, NONE = 12, np.zeros(0, np.int64)


@pytest.fixture(scope="module")
def desk():
    return slam.open_sequence(f"synthetic:desk?frames={FRAMES}")


@pytest.fixture(scope="module")
def recording(desk):
    return true_recording(desk)


def recorded_of(results, system):
    return Recording("desk", system.rig, system.config.models, tuple(map(RecordedFrame.of, results)))


def replay(recording, backend):
    return [result for _, result in Replay(recording, backend).run()]


def online(results):
    return np.array([r.estimate.T_world_left for r in results])


@pytest.mark.parametrize("rig", ["rectified", "toedin"])
def test_a_run_replayed_into_the_same_back_end_is_the_same_run(rig):
    desk = slam.open_sequence(f"synthetic:desk?frames={FRAMES}&rig={rig}")
    config = SystemConfig.for_kind("handheld", None).with_settings(["models.pixel_sigma=0.5"])  # the world's
    system = StereoSlam(desk.rig, None, "ekf", config=config)
    results = [system.process_features(desk.observations(k)) for k in range(FRAMES)]
    recorded = recorded_of(results, system)
    again = replay(recorded, StereoSlam(desk.rig, None, "ekf", config=config).backend)
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


def test_what_was_corrected_in_a_run_is_corrected_in_its_replay(desk, recording, tmp_path, monkeypatch):
    model, z = RigModel(desk.rig), np.array([[200.0, 100.0, 180.0]])
    shift = np.array([float(name == "right_cx") for name in model.names]) / model.focal  # of uR by 1 px
    before, first, second = (RigCorrection(model, offset * shift) for offset in (0.0, 0.3, 0.2))
    revisions = {8: Revision(before, first), 11: Revision(first, second)}
    frames = tuple(replace(frame, revision=revisions.get(k)) for k, frame in enumerate(recording))
    save_recording(replace(recording, frames=frames), tmp_path / "run.npz")
    again, backend, given = load_recording(tmp_path / "run.npz"), StereoSlam(desk.rig, None, "smoother").backend, {}
    monkeypatch.setattr(backend, "revise", lambda mend: given.update({len(backend.trajectory()): mend(z)}))
    kept = [RecordedFrame.of(result).revision for result in replay(again, backend)]
    assert [k for k in range(FRAMES) if kept[k] is not None] == list(given) == list(revisions)
    for k, mended in given.items():
        np.testing.assert_array_equal(mended, revisions[k].rows(z))
    assert given[8][0, 2] == pytest.approx(180.3, abs=0.02) and given[11][0, 2] == pytest.approx(179.9, abs=0.02)
    assert len(replay(again, StereoSlam(desk.rig, None, "ekf").backend)) == FRAMES


def test_a_landmark_may_leave_in_the_frame_in_which_it_is_added(desk, recording):
    first, *others = recording.frames
    (gone,) = first.added.ids[:1]
    rest = (replace(f, observed=f.observed.select(f.observed.ids != gone), removed=NONE) for f in others)
    frames = (replace(first, removed=np.array([gone])), *rest)
    system = Replay(replace(recording, frames=frames), StereoSlam(desk.rig, None, "ekf").backend)
    last = [result for _, result in system.run()][-1]
    assert gone not in system.estimate().ids and len(system.estimate().ids) == last.map_size


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
    "an earlier one, of other arrays": (lambda a: {**headed(version=2)(a), "rows": a["pixels"]}, "of version 2; this"),
    "another file of arrays": (lambda a: {"pixels": a["pixels"]}, "is no recording"),
    "no pixels": (lambda a: {name: array for name, array in a.items() if name != "pixels"}, "lacks 'pixels'"),
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
