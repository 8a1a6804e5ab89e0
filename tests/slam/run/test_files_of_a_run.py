"""Files of a run where they cannot all be written, and runs that end badly."""

import json
import resource
import signal
import stat
from contextlib import contextmanager

import numpy as np
import pytest

from slam.atlas.map_io import load_map
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.files import whole_file
from slam.run import runner
from slam.run.options import RunOptions
from slam.run.recording import load_recording
from tests.failing_runs import Features, Scripted

LAST = ("trajectory_final.txt", "landmarks.csv", "summary.json")


@contextmanager
def disk_of(size):
    """Files can grow to `size` bytes: as on a full disk, writes fail, or are cut short."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def run(tmp_path, sequence=None, watches=(), **more):
    options = RunOptions("ekf", "none", SystemConfig(), tmp_path / "out", **more)
    return runner.run(sequence or Scripted(None, 0), options, frontend=Features(), watches=watches)


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "a"
    path.write_text("before")
    path.chmod(0o640)
    with pytest.raises(ZeroDivisionError), whole_file(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    with pytest.raises(SlamError, match="cannot be written: File too large"), disk_of(10), whole_file(path) as file:
        file.write(bytes(10_000))
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]
    with whole_file(path) as file:
        file.write(b"after")
    assert path.read_text() == "after" and stat.S_IMODE(path.stat().st_mode) == 0o640
    with whole_file(tmp_path / "new" / "folder" / "b") as file:
        file.write(b"made")
    assert (tmp_path / "new" / "folder" / "b").read_text() == "made"


def test_a_disk_that_fills_up_half_way(tmp_path, caplog):
    """Rows before are there, and the small last files too; each that failed is said in a line."""
    out = tmp_path / "out"

    def fill(frame, result, system):
        if frame.index == 3:  # frames.csv can grow no more
            hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
            resource.setrlimit(resource.RLIMIT_FSIZE, ((out / "frames.csv").stat().st_size + 10, hard))

    with pytest.raises(SlamError, match=r"out: File too large$"), disk_of(10**6):
        run(tmp_path, watches=[fill])
    assert "summary.json: cannot be written: File too large" in caplog.text
    assert (out / "trajectory.txt").read_text().count("\n") == 4
    assert (out / "frames.csv").read_text().count("\n") == 5
    assert (out / "landmarks.csv").read_text().count("\n") > 1
    assert not (out / "summary.json").exists()


@pytest.mark.parametrize("bad", [*LAST, "a.npz", "a.map"])
def test_one_last_file_that_fails_loses_no_other(tmp_path, bad):
    record, save_map = tmp_path / "a.npz", tmp_path / "a.map"
    place = tmp_path / "out" / bad if bad in LAST else tmp_path / bad

    class Late(Scripted):
        def frames(self, start=0, stop=None):
            yield from super().frames()
            place.mkdir()  # in its place, when the run has begun

    with pytest.raises(SlamError, match=bad) as caught:
        run(tmp_path, Late(None, 0), record=record, save_map=save_map)
    assert str(caught.value).count("cannot be written") <= 2
    others = [p for p in (*(tmp_path / "out" / n for n in LAST), record, save_map) if p.name != bad]
    assert all(p.is_file() and p.stat().st_size for p in others)
    if bad != "summary.json":
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["ended"] == "completed" and bad in summary["failures"][0]
    if bad != "a.npz":
        assert len(load_recording(record)) == 5
    if bad != "a.map":
        assert len(load_map(save_map))


@pytest.mark.parametrize("few", [0, 2])
def test_a_recording_begins_where_enough_is_seen(tmp_path, few):
    """What it is replayed into then starts there, as the run's back end has."""

    class Covered(Features):
        def extract(self, frame):
            features = super().extract(frame)
            return features.select(np.arange(few)) if frame.index < 2 else features

    options = RunOptions("ekf", "none", SystemConfig(), tmp_path / "out", record=tmp_path / "a.npz")
    runner.run(Scripted(None, 0), options, frontend=Covered())
    assert [frame.number for frame in load_recording(tmp_path / "a.npz")] == [2, 3, 4]


@pytest.mark.parametrize("there", [False, True])
def test_a_run_that_is_refused_before_its_first_frame_leaves_what_was_there(tmp_path, there):
    """Its files were in the way of the same command with the fault mended."""
    out, tape = tmp_path / "new" / "out", tmp_path / "a.npz"
    if there:
        out.mkdir(parents=True)
        (out / "notes.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    options = RunOptions("ekf", "none", SystemConfig(), out, record=tape)
    with pytest.raises(SlamError, match="swapped"):
        runner.run(Scripted(SlamError("left and right look swapped"), 0), options, frontend=Features())
    assert sorted(tmp_path.rglob("*")) == before
