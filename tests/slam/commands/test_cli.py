from __future__ import annotations

import subprocess
import sys

import pytest

from slam.commands.run import require_no_recording
from slam.errors import SlamError
from slam.sequences import open_sequence
from slam.worlds.export import write_euroc


def in_a_new_process(*arguments, **more):
    command = [sys.executable, "-m", "slam", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, **more)


def fails_with_one_line(done, *words):
    assert done.returncode == 2, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    for word in words:
        assert str(word) in lines[0]


def test_a_folder_that_is_missing_or_empty(slam_command, tmp_path):
    (tmp_path / "empty").mkdir()
    fails_with_one_line(in_a_new_process("run", tmp_path / "nowhere", "--out", tmp_path / "out"), "nowhere")
    fails_with_one_line(slam_command("run", tmp_path / "empty", "--out", tmp_path / "out"), "empty")


def test_a_recording_is_no_place_for_a_run_and_no_trial_is_no_comparison(slam_command, tmp_path):
    euroc = tmp_path / "euroc"
    write_euroc(open_sequence("synthetic:desk?frames=3&width=160&height=120"), euroc)
    before = sorted(euroc.rglob("*"))
    for words in (["run", "synthetic:desk?frames=1"], ["compare", "synthetic:desk?frames=1"], ["demo"]):
        fails_with_one_line(slam_command(*words, "--out", euroc, "--overwrite"), "holds a recording (format euroc)")
    assert sorted(euroc.rglob("*")) == before
    runs = tmp_path / "runs"
    for name in ("left", "right"):  # a run's folder may have any name
        (runs / name).mkdir(parents=True)
        (runs / name / "summary.json").touch()
        (runs / name / "summary.png").touch()
    require_no_recording(runs)
    (runs / "left" / "summary.json").unlink()
    with pytest.raises(SlamError, match="holds a recording"):
        require_no_recording(runs)
    none = slam_command("compare", "synthetic:desk", "--trials", 0, "--out", tmp_path / "out")
    fails_with_one_line(none, "trials must be 1 or more")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--backend", "foo"], ["foo", "ekf", "smoother"]),
        (["--set", "backend.colour=1"], ["colour"]),
        (["--frames", "40"], ["A:B; 0:40 are the first 40"]),
        (["--frames", "7:9"], ["7:9"]),
    ],
)
def test_unknown_names_and_keys(slam_command, tmp_path, arguments, words):
    fails_with_one_line(slam_command("run", "synthetic:desk?frames=3", "--out", tmp_path / "out", *arguments), *words)
