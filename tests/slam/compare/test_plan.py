from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from slam.commands.cli import app
from slam.compare.plan import CLOSED_LOOP, Plan
from slam.compare.tables import groups, sentences
from slam.compare.trial import Run
from slam.errors import ConfigurationError
from slam.geometry.trajectory import Trajectory

WORLDS = ("synthetic:aisle?frames=30", "synthetic:box")


def test_trials_are_paired_and_have_folders_of_their_own():
    plan = Plan((*WORLDS, "/data/kitti/00", "/data/kitti/01"), ("ekf", "smoother"), trials=3)
    trials = list(plan.trials_of(CLOSED_LOOP))
    assert len(trials) == 2 * (3 + 3 + 1 + 1)
    assert len({t.folder for t in trials}) == len(trials)
    assert trials[2].source == "synthetic:aisle?frames=30&seed=1"
    assert next(t.source for t in trials if "box" in t.sequence) == "synthetic:box?seed=0"
    assert trials[-1].source == "/data/kitti/01"
    long = "x" * 80  # names that differ in odd characters, or early, alone
    names = ("synthetic:box?box=1", "synthetic:box?box_1", f"/a/{long}", f"/b/{long}")
    assert len({t.folder for t in Plan(names, ("ekf",)).trials_of(CLOSED_LOOP)}) == 4


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (((), ("ekf",)), "no sequence"),
        ((WORLDS, ()), "no back end"),
        ((WORLDS, ("ekf", "ekf")), "twice"),
        ((("synthetic:box?seed=3",), ("ekf",)), "seed"),
        ((("/data",), ("ekf",), "simulated"), "worlds alone"),
        ((WORLDS, ("ekf",), "surf", (), 0), "trials must be 1 or more"),
    ],
)
def test_bad_plans(arguments, word):
    with pytest.raises(ConfigurationError, match=word):
        Plan(*arguments)


@pytest.mark.parametrize("told", [{}, {"doubted": 1.0}])
def test_without_a_true_path_the_distance_between_the_paths_is_told_and_doubt_is_a_status(told, tmp_path, monkeypatch):
    plan, runs = Plan(("drive",), ("ekf", "smoother")), []
    for trial, x in zip(plan.every, (0.0, 0.5)):
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 0, 3] = x
        paths = SimpleNamespace(final=Trajectory(np.arange(3.0), poses))
        runs.append((Run(trial, "completed", {"path_m": 1.0} | told, {}, tmp_path / trial.folder), paths))
    by_folder = {run.folder: paths for run, paths in runs}
    monkeypatch.setattr("slam.compare.tables.RunData.read", lambda folder, name: by_folder[folder])
    (group,) = groups(plan, [run for run, _ in runs])
    said = sentences(group)
    assert said[0].startswith("No true path is known")
    assert said[1:] == ([] if told else ["Final paths of ekf and smoother are 500 mm apart (RMS)."])
    monkeypatch.setattr("slam.commands.compare.compare", lambda *given: [run for run, _ in runs])
    ended = CliRunner().invoke(app, ["compare", "drive", "--out", str(tmp_path / "out")])
    assert ended.exit_code == len(told)
