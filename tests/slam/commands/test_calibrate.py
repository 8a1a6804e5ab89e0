import json

import numpy as np
import pytest

import slam
from slam.calibration import RigModel, RigPosterior
from slam.errors import SlamError
from slam.run.calibrating import _judged
from tests.scripts import command

WORLD = "synthetic:aisle?frames=6&speed=16&turn_error=1"
QUIET = ("-q", "--no-picture")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What two recordings of one rig leave, and what is printed; too few frames to tell how good it is."""
    folder = tmp_path_factory.mktemp("made")
    return folder, command("calibrate", WORLD, f"{WORLD}&seed=1", "--out", folder / "rig.json", status=1)


def test_two_recordings_of_one_rig(made):
    folder, printed = made
    tree = json.loads((folder / "rig.json").read_text())
    assert [one["frames"] for one in tree["recordings"]] == [6, 6]
    turn = [row for row in tree["parameters"] if row["name"] in ("pitch", "yaw", "roll")]
    assert all(abs(row["mean"] + 1e-3) < 3 * row["sigma"] for row in turn)
    assert any(abs(row["mean"]) > 1e-4 for row in turn)
    assert all(row["sigma"] < 1.01 * usual for row, usual in zip(tree["parameters"], tree["usual"], strict=True))
    assert tree["agreement"].startswith("The recordings agree")
    assert tree["agreement"] in " ".join(printed.split())
    assert not tree["judgement"] and "no two views" in tree["warnings"][0]  # a few frames say nothing of disparities
    assert "left out" not in printed and "above" not in printed  # what their rows say is in the file


@pytest.mark.parametrize(
    ("off", "sigma", "apart", "word"),
    [
        (0.01, 0.001, 1.0, "This is good"),
        (0.2, 0.01, 1.0, "This is worth correcting"),
        (0.2, 0.09, 1.0, "too uncertain to be worth correcting"),  # two standard deviations make many runs worse
        (0.2, 0.01, None, "One recording alone does not tell"),
        (0.2, 0.01, 4.0, "which do not agree"),
        (3.0, 0.01, 1.0, "This is bad"),
    ],
)
def test_a_correction_is_advised_only_where_it_is_expected_to_help(off, sigma, apart, word):
    model = RigModel(slam.open_sequence(WORLD).rig)
    shift = np.array([float(name == "right_cx") for name in model.names]) / model.focal  # of all disparities by 1 px
    posterior = RigPosterior(off * shift, sigma**2 * np.outer(shift, shift))
    differing = None if apart is None else np.array([np.nan, apart])
    words, worth = _judged(model, posterior, 0.4, 100.0, differing)
    assert worth == (word in ("This is worth correcting", "This is bad"))  # only then it is said how to use it
    assert f"{off:.2f} ± {sigma:.2f} px in disparity" in words and word in words


def test_it_is_the_prior_of_a_run(made, tmp_path):
    folder, _ = made
    file = folder / "rig.json"
    command("run", WORLD, "--calibration", file, "--frames", "0:2", "--out", tmp_path / "first", *QUIET)
    found = json.loads((tmp_path / "first" / "summary.json").read_text())["self_calibration"]["parameters"]
    expected = json.loads(file.read_text())["parameters"]
    assert [row["mean"] for row in found] == [row["mean"] for row in expected]
    command("run", WORLD, "--calibration", tmp_path / "first", "--frames", "0:1", "--out", tmp_path / "third", *QUIET)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", WORLD, "--calibration", "none.json"], r"none\.json"),
        (["run", "synthetic:aisle?frames=3&width=200", "--calibration", "{rig}"], "of another rig: width"),
        (["calibrate", WORLD, "synthetic:aisle?frames=3&baseline=0.2"], "not the rig of"),
        (["calibrate", WORLD, "--set", "self_calibration.enabled=false"], "enabled"),
        (["calibrate", "synthetic:desk?frames=1"], "no recording"),
        (["calibrate", WORLD, "--out", "{rig}"], "is there already"),
        (["calibrate", WORLD, WORLD], "given twice"),  # it would count as two recordings that agree
    ],
)
def test_bad_input_is_one_line(made, words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [word.replace("{rig}", str(made[0] / "rig.json")) for word in words]
    with pytest.raises(SlamError, match=message):
        command(*words, "-q")
