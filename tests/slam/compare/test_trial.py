from dataclasses import replace

import pytest
from typer.testing import CliRunner

from slam.commands.cli import app
from slam.compare import trial
from slam.compare.plan import REPLAY, Plan, Trial
from slam.compare.sweep import RUNS, is_done
from slam.compare.trial import COMPLETED, Run
from slam.config import SystemConfig
from slam.files import read_object
from slam.sequences import open_sequence
from slam.worlds.export import write_euroc


def test_what_was_run_with_other_settings_frames_or_versions_is_not_done(tmp_path, monkeypatch):
    """It lies there where a comparison that replaces another one was interrupted."""
    trial = Trial("synthetic:desk?frames=5", "ekf", settings=("frontend.features=100",))
    plan = Plan((trial.sequence,), ("ekf",))
    Run(trial, COMPLETED, {"ate_online_m": 0.1}, {}, tmp_path / RUNS / trial.folder).keep()
    assert is_done(plan, trial, tmp_path)
    monkeypatch.setattr("slam.compare.sweep.versions", lambda: {"numpy": "0.1"})
    assert not is_done(plan, trial, tmp_path)
    monkeypatch.undo()
    other = replace(trial, settings=("frontend.features=900",))
    assert not is_done(replace(plan, replay=True), trial, tmp_path)  # there is no recording to replay
    assert not is_done(plan, other, tmp_path) and not is_done(plan, replace(trial, stop=3), tmp_path)


def test_a_trial_has_the_settings_of_its_sequence_s_kind(tmp_path):
    street = Trial("synthetic:street?frames=3", "ekf", frontend="simulated", settings=("map.max_landmarks=120",))
    trial.run_trial(street, tmp_path)
    assert read_object(tmp_path / "result.json")["outcome"] == COMPLETED
    config, expected = read_object(tmp_path / "config.json"), SystemConfig.for_kind("driving", None)
    assert config["kind"] == "driving"
    settings = SystemConfig.from_json(config["settings"])
    assert settings.objects == expected.objects and settings.map == replace(expected.map, max_landmarks=120)


@pytest.mark.slow
def test_a_run_that_began_again_has_figures_and_its_cause_and_no_recording(tmp_path):
    """By a baseline 33 times too long nothing is tracked, and back end follows back end."""
    drive = write_euroc(open_sequence("synthetic:desk?frames=9&baseline=0.075"), tmp_path / "drive")
    camera = "fx: 260\nfy: 260\ncx: 160\ncy: 120\nbaseline: 2.5\n"
    (tmp_path / "far.yaml").write_text(camera)
    tape = tmp_path / "tape.npz"
    tape.write_text("of an earlier run")
    wrong = f"{drive}?calibration={tmp_path}/far.yaml"
    ended = CliRunner().invoke(
        app, ["run", wrong, "--out", str(tmp_path / "out"), "--record", str(tape), "--overwrite"]
    )
    assert ended.exit_code == 1 and not tape.exists()
    assert "likely cause" in ended.stderr and ended.stderr.splitlines()[-1].startswith(f"slam: {tape}: not written")
    given = Trial(wrong, "ekf")
    trial.run_trial(given, tmp_path / "closed", tape)
    trial.run_trial(replace(given, mode=REPLAY), tmp_path / "replay", tape)
    closed, again = (read_object(tmp_path / name / "result.json") for name in ("closed", "replay"))
    assert closed["outcome"] == COMPLETED and closed["metrics"]["tracked"] < 0.5
    assert "began again" in again["outcome"]
