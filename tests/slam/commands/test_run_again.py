from __future__ import annotations

import json
import shutil

import pytest

from slam.errors import SlamError
from slam.run.options import load
from tests.scripts import command

WORLD = "synthetic:aisle?frames=6&width=160&height=120"
SAME = ("trajectory.txt", "trajectory_final.txt", "landmarks.csv", "objects.csv", "truth.txt", "schema.json")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A tiny recording on disk."""
    folder = tmp_path_factory.mktemp("recordings")
    command("render", WORLD, "--out", folder / "rendered", "-q")
    return folder / "rendered"


def run(*words):
    command("run", *words, "-q", "--no-picture")


@pytest.mark.slow
def test_a_run_is_repeated_byte_for_byte(here):
    settings = ["--set", "map.max_landmarks=300", "--set", "frontend.max_depth=Infinity"]
    run(WORLD, "--frames", "1:5", *settings, "--out", "first")
    run("--config", "first/config.json", "--out", "again")
    for name in SAME:
        assert (here / "first" / name).read_bytes() == (here / "again" / name).read_bytes(), name
    one, other = (json.loads((here / folder / "config.json").read_text()) for folder in ("first", "again"))
    assert one["command"].startswith("slam")
    assert {**one, "command": ""} == {**other, "command": ""}
    assert one["settings"]["frontend"]["max_depth"] == "Infinity"  # JSON has no number for it


def test_what_is_said_beside_the_config_holds(here):
    run(WORLD, "--frames", "0:3", "--set", "map.max_landmarks=301", "--out", "first")
    words = ["--backend", "smoother", "--frames", "1:3", "--set", "map.restart_after=4"]
    run("--config", "first", *words, "--out", "other")
    tree = json.loads((here / "other" / "config.json").read_text())
    assert (tree["backend"], tree["frames"]) == ("smoother", [1, 3])
    assert (tree["settings"]["map"]["max_landmarks"], tree["settings"]["map"]["restart_after"]) == (301, 4)
    assert tree["settings"]["backend"] == {}


def test_a_recording_is_found_again_or_given_anew(here, recording):
    shutil.copytree(recording, here / "data")
    run("data?kind=driving", "--frames", "0:2", "--out", "out")
    found, _ = load(here / "out/config.json")
    assert (found.source, found.kind) == (f"{here / 'data'}?kind=driving", "driving")
    (here / "data").rename(here / "elsewhere")
    with pytest.raises(SlamError, match=r"data\?kind=driving is no longer there: give its new place"):
        command("run", "--config", "out")
    run("elsewhere", "--config", "out", "--out", "third")
    assert load(here / "third")[0].config == found.config


def test_a_prior_map_is_found_again(here):
    run(WORLD, "--save-map", "desk.map", "--out", "first")
    run(WORLD, "--map", "desk.map", "--mono", "--frames", "0:3", "--out", "second")
    before, _ = load(here / "second")
    assert before.mono
    assert before.prior_map == here / "desk.map"
    assert before.config.map.monocular
    run("--config", "second", "--out", "third")
    assert (here / "second/trajectory.txt").read_bytes() == (here / "third/trajectory.txt").read_bytes()


GOOD = {"frames": [0, None], "settings": {}, "frontend": "surf", "backend": "ekf"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, r"config\.json: there is no such file"),
        ("", r"config\.json: no valid JSON"),
        ("{}", r"not the config\.json"),
        ("[]", r"config\.json: must hold an object, not list"),
        ("[" * 50_000, r"config\.json: no valid JSON"),
        (json.dumps(GOOD).replace("0", "1e999"), r"not the config\.json"),
        (json.dumps(GOOD | {"settings": {"colour": 1}}), "colour"),
        ('{"command": "slam replay a.npz"}', r"that of a replay; repeat it with: slam replay a\.npz"),
        (json.dumps(GOOD), "--kind does not go with --config"),
    ],
)
def test_a_bad_config_is_one_line(tmp_path, text, words):
    if text is not None:
        (tmp_path / "config.json").write_text(text)
    with pytest.raises(SlamError, match=words):
        command("run", WORLD, "--config", tmp_path, "--kind", "driving")
    with pytest.raises(SlamError, match="name a sequence"):
        command("run")
