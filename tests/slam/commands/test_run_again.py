from __future__ import annotations

import json

import pytest

from tests.scripts import command

WORLD = "synthetic:aisle?frames=6&width=160&height=120"
SAME = ("trajectory.txt", "trajectory_final.txt", "landmarks.csv", "objects.csv", "truth.txt", "schema.json")


@pytest.mark.slow
def test_a_run_is_repeated_byte_for_byte_and_says_what_was_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = ["--set", "map.max_landmarks=300", "--kind", "driving"]
    configs = []
    for name in ("first", "again"):
        command("run", WORLD, "--frames", "1:5", *settings, "--out", name, "-q", "--no-picture")
        configs.append(json.loads((tmp_path / name / "config.json").read_text()))
    for name in SAME:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    one, other = configs
    assert one.pop("command").startswith("slam") and one["folder"] == str(tmp_path)
    assert (one["kind"], one["frames"], one["settings"]["map"]["max_landmarks"]) == ("driving", [1, 5], 300)
    del other["command"]
    assert one == other
