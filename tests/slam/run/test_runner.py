import csv
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from slam.atlas.config import AtlasConfig
from slam.atlas.map_io import load_map
from slam.commands.ending import Stopped, catch_signals, ended_by_signals
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.errors import SequenceError, SlamError
from slam.geometry.trajectory import Trajectory
from slam.run import schema
from slam.run.options import RunOptions
from slam.run.recording import load_recording
from slam.run.run_data import RunData
from slam.run.run_record import RunRecord
from slam.run.runner import run
from slam.sequences import open_sequence
from slam.system import StereoSlam
from tests.failing_runs import FRAMES, Features, Scripted

WORLD = "synthetic:aisle?frames=12"
WITH_TRUTH = set(schema.FILES) - {"summary.png"}  # that one is the command's


def options(out, backend="ekf", **more):
    return RunOptions(backend, "surf", SystemConfig.for_kind("handheld"), out, **more)


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_landmarks_that_have_left_the_map_are_kept_where_they_were(tmp_path, monkeypatch):
    monkeypatch.setattr(AtlasConfig, "keyframe_distance", 0.05)
    few = SystemConfig.for_kind("handheld").with_settings(["map.max_landmarks=80"])
    run(open_sequence("synthetic:aisle?frames=30&speed=6"), RunOptions("ekf", "surf", few, tmp_path))
    data = RunData.read(tmp_path, "a")
    assert len(data.old) > 10
    away = np.linalg.norm(data.old - data.online.positions.mean(axis=0), axis=1)
    assert 0.5 < np.median(away) < 6.0  # on the shelves


def test_why_no_path_can_be_trusted_is_the_cause_of_lost_frames(tmp_path, monkeypatch):
    """Of images whose distortion the calibration leaves out it was the time between them."""
    monkeypatch.setattr(StereoSlam, "doubt", "a lens distortion that is not in the calibration")
    monkeypatch.setattr(StereoSlam, "warnings", ["frames are 0.8 s apart", StereoSlam.doubt])
    nothing = SimpleNamespace(extract=lambda frame: StereoFeatures.empty(frame.stamp))
    summary = run(open_sequence("synthetic:aisle?frames=3"), options(tmp_path), frontend=nothing)
    assert summary["tracking"].endswith(f"likely cause: {summary['doubt']}")


def test_a_run_leaves_its_files(tmp_path):
    seen = []
    summary = run(open_sequence(WORLD), options(tmp_path, "smoother"), seen.append)
    assert {p.name for p in tmp_path.iterdir()} == WITH_TRUTH
    assert len(seen) == 12
    online = Trajectory.read_tum(tmp_path / "trajectory.txt")
    assert len(online) == len(Trajectory.read_tum(tmp_path / "trajectory_final.txt")) == 12
    rows, landmarks = rows_of(tmp_path / "frames.csv"), rows_of(tmp_path / "landmarks.csv")
    assert [r["status"] for r in rows] == ["started"] + ["tracked"] * 11
    assert [int(r["frame"]) for r in rows] == list(range(12))
    P = {name: float(rows[-1][name]) for name in ("c00", "c11", "c22", "c33", "c44", "c55")}
    sd = {name: float(rows[-1][f"sd_{name}"]) for name in ("rotation", "x", "y", "z")}
    assert sd["rotation"] ** 2 == pytest.approx(P["c00"] + P["c11"] + P["c22"], rel=1e-6)
    assert sum(sd[axis] ** 2 for axis in "xyz") == pytest.approx(P["c33"] + P["c44"] + P["c55"], rel=1e-6)
    assert len(landmarks) == summary["landmarks"] == int(rows[-1]["map_size"])
    assert all(float(r["cxx"]) > 0 for r in landmarks)
    assert json.loads((tmp_path / "summary.json").read_text()) == json.loads(json.dumps(summary))
    assert summary["ended"] == "completed"
    assert summary["accuracy"]["online"]["ATE RMSE [m]"] < 0.01
    assert "NIS per degree of freedom" in summary["consistency"]
    assert summary["versions"]["numpy"] == np.__version__
    config = json.loads((tmp_path / "config.json").read_text())
    assert (config["backend"], config["kind"], config["frames"]) == ("smoother", "", [0, None])
    assert config["settings"]["map"]["max_landmarks"] == SystemConfig().map.max_landmarks


def test_a_fault_half_way_keeps_what_was_done(tmp_path):
    to_write = options(tmp_path / "out", record=tmp_path / "tape.npz", save_map=tmp_path / "map")
    with pytest.raises(SlamError, match="disk gone"):
        run(Scripted(SequenceError("disk gone"), 3), to_write, frontend=Features())
    assert {p.name for p in (tmp_path / "out").iterdir()} == WITH_TRUTH - {"truth.txt"}
    assert len(Trajectory.read_tum(tmp_path / "out" / "trajectory.txt")) == 3
    assert "disk gone" in json.loads((tmp_path / "out" / "summary.json").read_text())["ended"]
    assert len(load_map(tmp_path / "map"))
    assert len(load_recording(tmp_path / "tape.npz")) == 3


@pytest.fixture
def signals():
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, signal.SIG_DFL) for number in numbers]
    yield
    for number, handler in zip(numbers, before):
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("frames", [2, FRAMES])
def test_a_summary_says_which_signal_ended_the_run_before_its_last_frame(tmp_path, signals, number, frames):
    catch_signals()
    record, done = RunRecord(), []

    def on_frame(result):
        done.append(result)
        if len(done) == frames:
            signal.raise_signal(number)

    with pytest.raises(Stopped) as stopped, ended_by_signals(tmp_path, record) as until:
        run(Scripted(None, 0), options(tmp_path), on_frame, Features(), until=until, record=record)
    said = "ended by the user" if number == signal.SIGINT else f"stopped: {signal.Signals(number).name}"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (len(done), summary["frames"]) == (frames, frames)
    assert summary["ended"] == (said if frames < FRAMES else "completed")
    assert stopped.value.number == number and stopped.value.leaves.startswith("frames done so far are kept")


def test_a_run_that_is_stopped_at_once_in_its_first_frame_says_that_there_is_none(tmp_path):
    record, second = RunRecord(), Stopped(signal.SIGINT)
    with pytest.raises(Stopped) as stopped, ended_by_signals(tmp_path, record) as until:
        run(Scripted(second, 0), options(tmp_path), None, Features(), until=until, record=record)
    assert stopped.value.leaves == "no frame was done yet" and not list(tmp_path.iterdir())


def test_a_second_signal_stops_at_once(tmp_path, signals):
    catch_signals()
    with pytest.raises(Stopped, match="SIGTERM"), ended_by_signals(tmp_path, RunRecord()) as until:
        signal.raise_signal(signal.SIGINT)
        assert until.is_set()
        signal.raise_signal(signal.SIGTERM)
        pytest.fail("it is waited for")


def test_a_signal_that_is_to_be_ignored_is(tmp_path, signals):
    """As `nohup` has it."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    catch_signals()
    with ended_by_signals(tmp_path, RunRecord()) as until:
        signal.raise_signal(signal.SIGHUP)
        assert not until.is_set()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_keeps_its_frames(tmp_path, kill):
    command = [sys.executable, "-m", "slam", "run", "synthetic:desk?frames=2000&width=128&height=96", "--quiet"]
    # A shell that starts the tests in the background has them ignore SIGINT, and what they start would too.
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    out = tmp_path / "out"
    process = subprocess.Popen([*command, "--out", str(out)], stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    deadline = time.time() + 600  # where nothing is compiled yet and other processes run
    path = out / "trajectory.txt"
    while time.time() < deadline and (not path.exists() or path.read_text().count("\n") < 5):
        time.sleep(0.02)
    process.send_signal(kill)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == (-9 if kill is signal.SIGKILL else 128 + kill), errors
    assert len(Trajectory.read_tum(path)) >= 5
    if (final := out / "trajectory_final.txt").exists():  # what a kill leaves in part is beside its place
        assert len(Trajectory.read_tum(final)) >= 5
    assert None not in rows_of(out / "frames.csv")[-1].values() and json.loads((out / "config.json").read_text())
    if kill is not signal.SIGKILL:
        assert f"stopped by {kill.name}; frames done so far are kept: `slam plot" in errors
        assert json.loads((out / "summary.json").read_text())["ended"] == "ended by the user"
        assert (out / "landmarks.csv").exists()
