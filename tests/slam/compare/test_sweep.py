import csv
import json
import multiprocessing
import os
import shutil
import signal
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest

from slam.compare.plan import CLOSED_LOOP, REPLAY, Plan
from slam.compare.report import write_report
from slam.compare.sweep import RUNS, SWEEP, check, sweep
from slam.compare.tables import groups, write_tables
from slam.compare.trial import Run, run_trial
from slam.errors import SlamError
from slam.run.results import COMPARED
from tests.scripts import command

pytestmark = pytest.mark.slow  # all share one sweep

PLAN = Plan(("synthetic:aisle?frames=8",), ("ekf", "smoother"), "simulated", trials=2, replay=True)
TABLES = ("runs.csv", "differences.csv")


def tables(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


def swept(out, workers, on_done=None):
    """The runs of the plan; their tables are written."""
    runs = sweep(PLAN, out, workers, on_done)
    write_tables(groups(PLAN, runs), runs, out)
    return runs


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished comparison, by one worker."""
    out = tmp_path_factory.mktemp("done")
    return out, swept(out, 1)


@pytest.fixture
def again(done, tmp_path):
    """A copy of it."""
    return Path(shutil.copytree(done[0], tmp_path / "again"))


def test_every_run_is_there_with_its_figures(done):
    out, runs = done
    assert len(runs) == 8
    assert all(run.completed for run in runs)
    assert {run.trial.mode for run in runs} == {CLOSED_LOOP, REPLAY}
    for run in runs:
        assert 0 < run.metrics["ate_online_m"] < 0.05
        assert run.metrics["tracked"] == 1
        assert {"ratio_start", "nis_per_dof", "landmark_error_m", "map_size"} <= set(run.metrics)
        assert run.milliseconds["update"] > 0
    closed = [run for run in runs if run.trial.mode == CLOSED_LOOP]
    assert all(run.metrics["association_precision"] > 0.9 for run in closed)
    with (out / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert {metric.key for metric in COMPARED} < set(rows[0])


def troubled(trial, folder, recording=None):
    """`run_trial` that kills its process where the back end is "ekf", and has a defect where it is "iekf"."""

    def defect(*arguments):
        raise ZeroDivisionError("a defect")

    if trial.backend == "ekf":
        os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))
    with patch("slam.compare.trial._run", defect) if trial.backend == "iekf" else nullcontext():
        run_trial(trial, folder, recording)


def test_a_defect_is_an_outcome_and_a_worker_that_is_killed_ends_it_with_what_is_done_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("slam.compare.sweep.run_trial", troubled)
    words = ["compare", "synthetic:desk?frames=4", "--frontend", "simulated", "--trials", "1"]
    words += ["--workers", "1", "--out", str(tmp_path / "out"), "--backends"]
    with pytest.raises(SlamError, match="a worker process ended"):
        command(*words, "smoother,iekf,ekf")
    assert not multiprocessing.active_children()
    outcomes = {p.parts[-3]: json.loads(p.read_text())["outcome"] for p in tmp_path.rglob("result.json")}
    assert outcomes == {"smoother": "completed", "iekf": "failed: ZeroDivisionError: a defect"}


@pytest.mark.parametrize("frames", ["3:1", "4:9"])
def test_frames_that_there_are_none_of_are_refused_before_anything_is_run_or_written(frames, tmp_path):
    out = tmp_path / "out"
    words = ["compare", "synthetic:desk?frames=4", "--frontend", "simulated", "--trials", "1", "--out", str(out)]
    with pytest.raises(SlamError, match=f"frames {frames} asked for"):
        command(*words, "--backends", "ekf", "--frames", frames)
    assert not out.exists()


def test_what_is_done_is_not_done_again_and_what_is_not_is(done, again):
    kept, lost, damaged = (again / RUNS / trial.folder for trial in PLAN.every[:3])
    (kept / "marker").touch()
    shutil.rmtree(lost)
    (lost.parent / (lost.name + ".part")).mkdir()  # what a killed sweep may leave
    (damaged / "result.json").write_text("{half a res")
    swept(again, 1)
    assert (kept / "marker").exists()
    assert tables(again) == tables(done[0])


def test_a_failed_run_is_counted_never_dropped(again):
    trial = next(t for t in PLAN.trials_of(CLOSED_LOOP) if t.backend == "smoother")
    Run.failed(trial, again / RUNS / trial.folder, ValueError("no\nway")).keep()
    runs = swept(again, 1)
    group = groups(PLAN, runs)[0]
    assert (group.failures("ekf"), group.failures("smoother")) == (0, 1)
    d = group.compared["ate_online_m"]["smoother"]
    assert (d.pairs, d.missing) == (1, 1)
    text = write_report(PLAN, groups(PLAN, runs), runs, again).read_text()
    assert "1 of 8 runs failed" in text
    assert "ValueError: no way" in text
    assert (again / "runs.csv").read_text().count("failed: ValueError: no way") == 1


def test_a_folder_with_other_runs_is_left_alone(again):
    settings = replace(PLAN, settings=("map.max_landmarks=190",))
    for other in (settings, replace(PLAN, trials=PLAN.trials - 1), replace(PLAN, backends=PLAN.backends[:1])):
        with pytest.raises(SlamError, match="more or other runs"):
            check(other, again)
    (again / SWEEP).unlink()
    with pytest.raises(SlamError, match="is there already"):
        check(PLAN, again)
