from __future__ import annotations

import csv
import json
import multiprocessing
import os
import shutil
import signal

import pytest

from slam.compare.plan import CLOSED_LOOP, REPLAY, Plan, Variant
from slam.compare.report import write_report
from slam.compare.scheduler import DaskScheduler, LocalScheduler
from slam.compare.sweep import RUNS, SWEEP, sweep
from slam.compare.tables import groups, write_tables
from slam.compare.trial import failed, run_trial
from slam.errors import SlamError
from slam.run.repeat import running_code
from slam.run.results import BY_KEY

pytestmark = pytest.mark.slow  # all share one sweep

PLAN = Plan(("synthetic:aisle?frames=8",), ("ekf", "smoother"), (Variant("simulated", "simulated"),), 2)
TABLES = ("runs.csv", "means.csv", "differences.csv")


def tables(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished comparison, by one worker."""
    out = tmp_path_factory.mktemp("done")
    runs = sweep(PLAN, out, LocalScheduler(1))
    write_tables(PLAN, runs, out)
    return out, runs


def test_every_run_is_there_with_its_figures(done):
    out, runs = done
    assert len(runs) == 8
    assert all(run.completed for run in runs)
    assert {run.trial.mode for run in runs} == {CLOSED_LOOP, REPLAY}
    for run in runs:
        assert 0 < run.metrics["ate_online_m"] < 0.05
        assert run.metrics["tracked"] == 1
        assert {"nees_per_dof", "nis_per_dof", "landmark_error_m", "map_size", "rpe_1s_m"} <= set(run.metrics) | {
            "rpe_1s_m"  # the path is shorter than a second
        }
        assert run.milliseconds["update"] > 0
    closed = [run for run in runs if run.trial.mode == CLOSED_LOOP]
    assert all(run.metrics["association_precision"] > 0.9 for run in closed)
    with (out / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert set(BY_KEY) < set(rows[0])
    assert not any(column.startswith("ms_") for column in rows[0])


def test_a_replay_gives_all_back_ends_what_the_first_was_given(done):
    _, runs = done
    for seed in range(2):
        own = [run for run in runs if run.trial.seed == seed]
        given = next(run for run in own if run.trial.mode == CLOSED_LOOP and run.trial.backend == "ekf")
        replayed = [run for run in own if run.trial.mode == REPLAY]
        assert len(replayed) == 2
        for run in replayed:
            for key in ("map_size", "lifetime_frames"):
                assert run.metrics[key] == given.metrics[key]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_two_workers_one_killed_half_way_leave_the_same_tables(done, tmp_path):
    ended = []

    def kill_one(trial):
        ended.append(trial)
        if len(ended) == 2:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

    runs = sweep(PLAN, tmp_path, LocalScheduler(2), kill_one)
    write_tables(PLAN, runs, tmp_path)
    assert len(ended) == 8
    assert tables(tmp_path) == tables(done[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Dask's own
def test_a_cluster_leaves_the_same_tables(done, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        write_tables(PLAN, sweep(PLAN, tmp_path, DaskScheduler(cluster.scheduler_address)), tmp_path)
    assert tables(tmp_path) == tables(done[0])


@pytest.mark.slow
def test_what_is_done_is_not_done_again_and_what_is_not_is(done, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(done[0], out)
    trials = [trial for mode in PLAN.modes for trial in PLAN.trials_of(mode)]
    kept, lost = out / RUNS / trials[0].folder, out / RUNS / trials[1].folder
    (kept / "marker").touch()
    shutil.rmtree(lost)
    (lost.parent / (lost.name + ".part")).mkdir()  # what a killed sweep may leave
    (out / RUNS / trials[2].folder / "result.json").write_text("{half a res")
    write_tables(PLAN, sweep(PLAN, out, LocalScheduler(1)), out)
    assert (kept / "marker").exists()
    assert tables(out) == tables(done[0])


def test_a_failed_run_is_counted_never_dropped(done, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(done[0], out)
    trial = next(t for t in PLAN.trials_of(CLOSED_LOOP) if t.backend == "smoother")
    shutil.rmtree(out / RUNS / trial.folder)
    (out / RUNS / trial.folder).mkdir()
    for name, content in failed(trial, ValueError("no\nway")).items():
        (out / RUNS / trial.folder / name).write_bytes(content)
    runs = sweep(PLAN, out, LocalScheduler(1))
    write_tables(PLAN, runs, out)
    group = groups(PLAN, runs)[0]
    assert (group.failures("ekf"), group.failures("smoother")) == (0, 1)
    d = group.differences(BY_KEY["ate_online_m"])["smoother"]
    assert (d.pairs, d.missing) == (1, 1)
    text = write_report(PLAN, runs, out, "here").read_text()
    assert "1 of 8 runs failed" in text
    assert "ValueError: no way" in text
    assert (out / "runs.csv").read_text().count("failed: ValueError: no way") == 1


def test_bad_input_of_a_trial_is_an_outcome(tmp_path):
    trial = next(Plan(PLAN.sequences, PLAN.backends, PLAN.variants, 1, 7, 9).trials_of(REPLAY))
    result = json.loads(run_trial(trial, None)["result.json"])
    assert result["outcome"].startswith("failed: SlamError")
    assert result["metrics"] == {}


def test_a_folder_with_other_runs_is_left_alone(done, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(done[0], out)
    other = Plan(PLAN.sequences, PLAN.backends, (Variant("simulated", "simulated", ("map.max_landmarks=190",)),), 2)
    with pytest.raises(SlamError, match="other settings"):
        sweep(other, out, LocalScheduler(1))
    tree = json.loads((out / SWEEP).read_text())
    tree["versions"]["numpy"] = "0.1"
    (out / SWEEP).write_text(json.dumps(tree))
    with pytest.raises(SlamError, match=r"numpy 0\.1"):
        sweep(PLAN, out, LocalScheduler(1))
    (out / SWEEP).write_text(json.dumps({**tree, "versions": {**tree["versions"], **running_code(), "code": "other"}}))
    with pytest.raises(SlamError, match="code other"):
        sweep(PLAN, out, LocalScheduler(1))
