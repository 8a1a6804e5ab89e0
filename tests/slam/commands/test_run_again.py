from __future__ import annotations

import json

import pytest

from tests.scripts import command

WORLD = "synthetic:aisle?frames=6&width=160&height=120"
SAME = ("trajectory.txt", "trajectory_final.txt", "landmarks.csv", "objects.csv", "truth.txt", "schema.json")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words):
    command("run", *words, "-q", "--no-picture")


@pytest.mark.slow
def test_a_run_is_repeated_byte_for_byte(here):
    settings = ["--set", "map.max_landmarks=300", "--set", "frontend.max_depth=Infinity"]
    run(WORLD, "--frames", "1:5", *settings, "--out", "first")
    run(WORLD, "--frames", "1:5", *settings, "--out", "again")
    for name in SAME:
        assert (here / "first" / name).read_bytes() == (here / "again" / name).read_bytes(), name
    one, other = (json.loads((here / folder / "config.json").read_text()) for folder in ("first", "again"))
    assert one["command"].startswith("slam")
    assert {**one, "command": ""} == {**other, "command": ""}


def test_the_command_and_the_places_of_its_files_are_kept(here):
    run(WORLD, "--save-map", "desk.map", "--out", "first")
    run(WORLD, "--map", "desk.map", "--mono", "--frames", "0:3", "--kind", "driving", "--out", "second")
    tree = json.loads((here / "second" / "config.json").read_text())
    assert (tree["prior_map"], tree["mono"], tree["kind"]) == (str(here / "desk.map"), True, "driving")
    assert tree["settings"]["map"]["monocular"] and tree["frames"] == [0, 3]
