from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.compare import trial
from slam.compare.plan import Trial
from slam.compare.sweep import RUNS, is_done, read_run
from slam.compare.trial import COMPLETED, keep_result
from slam.errors import SlamError


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


def test_what_was_run_with_other_settings_frames_or_versions_is_not_done(tmp_path, monkeypatch):
    """It lies there where a comparison that replaces another one was interrupted."""
    trial = Trial("synthetic:desk?frames=5", "ekf", settings=("frontend.features=100",))
    keep_result(trial, tmp_path / RUNS / trial.folder, COMPLETED, {"ate_online_m": 0.1})
    assert is_done(trial, tmp_path)
    monkeypatch.setattr("slam.compare.sweep.versions", lambda: {"numpy": "0.1"})
    assert not is_done(trial, tmp_path)
    monkeypatch.undo()
    other = replace(trial, settings=("frontend.features=900",))
    assert not is_done(other, tmp_path) and not is_done(replace(trial, stop=3), tmp_path)


def test_a_figure_that_is_no_number_is_none_of_the_run(tmp_path):
    """A camera that stands has no drift by distance."""
    trial = Trial("synthetic:desk?frames=5", "ekf")
    keep_result(trial, tmp_path / RUNS / trial.folder, COMPLETED, {"segment_percent": np.nan, "ate_online_m": 0.1})
    assert read_run(trial, tmp_path).metrics == {"completed": 1.0, "ate_online_m": 0.1}
