from __future__ import annotations

import sys

import pytest

from slam import registry
from slam.config import SystemConfig
from slam.errors import ConfigurationError, SlamError, UnknownNameError
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels
from slam.sequences import open_sequence


@pytest.mark.parametrize(
    ("sequence", "meant"),
    [
        ("synthetic:asle", "'aisle'"),
        ("synthetic:aisle?frmes=3", "'frames'"),
        ("aisle", "'synthetic:aisle'?"),
        ("aisle?frames=3", "'synthetic:aisle?frames=3'?"),
    ],
)
def test_a_world_is_suggested(sequence, meant):
    with pytest.raises(SlamError, match=r"did you mean") as raised:
        open_sequence(sequence)
    assert f"did you mean {meant}" in str(raised.value)


@pytest.mark.parametrize(("name", "suggested"), [("ailse", True), ("recordings", False), ("data/ailse", False)])
def test_a_missing_folder_is_no_world_but_by_a_slip(name, suggested):
    with pytest.raises(SlamError) as raised:
        open_sequence(name)
    assert ("did you mean" in str(raised.value)) == suggested


def test_a_back_end_by_its_module_in_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "my_own_module.py").write_text(
        "class Mine:\n    def __init__(self, rig, models=None):\n        self.rig = rig\n    extract = print\n"
    )
    (tmp_path / "a_broken_module.py").write_text("class Mine(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert registry.create("frontends", "my_own_module:Mine", "rig").rig == "rig"
    assert sys.path[-1] == str(tmp_path)  # last: nothing that is installed is replaced
    for name in (
        "my_own_module:Other",
        "my_own_module:",
        ":Mine",
        "no_module_of_this_name:Mine",
        "a_broken_module:Mine",
    ):
        with pytest.raises(UnknownNameError, match=f"back end '{name}' cannot be loaded"):
            registry.resolve("backends", name)
    with pytest.raises(UnknownNameError, match=f"looked for in {tmp_path}, where `slam` runs"):
        registry.resolve("backends", "no_module_of_this_name:Mine")


def test_no_models_are_the_default_ones():
    rig = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)
    assert registry.create("backends", "ekf", rig, models=None).models == EstimatorModels()


FOREIGN = """
class Nothing:
    def __init__(self, rig): pass
class Raises:
    def __init__(self, rig): raise RuntimeError("no way")
class Quits:
    def __init__(self, rig): raise SystemExit(0)
class Deeper:
    def __init__(self, rig): len(3)
class Plain:
    def __init__(self, rig, models=None, window=5): pass
number = 3
"""


def test_modules_and_classes_of_elsewhere_that_fail_get_one_line(tmp_path, monkeypatch):
    (tmp_path / "foreign_classes.py").write_text(FOREIGN)
    (tmp_path / "module_that_raises.py").write_text("\nundefined\n")
    (tmp_path / "module_that_quits.py").write_text("raise SystemExit(0)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(UnknownNameError, match=r"NameError: .*undefined.* \(module_that_raises.py, line 2\)"):
        registry.create("backends", "module_that_raises:Mine", "rig")
    with pytest.raises(UnknownNameError, match=r"SystemExit: 0 \(module_that_quits.py, line 1\)"):
        registry.create("backends", "module_that_quits:Mine", "rig")
    cases = {
        "Nothing": "is none: it lacks predict, update",
        "Raises": r"cannot be created: RuntimeError: no way \(foreign_classes.py, line 5\)",
        "Quits": "cannot be created: SystemExit",
        "number": "cannot be created: TypeError: 'int' object is not callable",
        "Deeper": r"cannot be created: TypeError: .*\(foreign_classes.py, line 9\)",
    }
    for name, words in cases.items():
        with pytest.raises(ConfigurationError, match=words):
            registry.create("backends", f"foreign_classes:{name}", "rig")
    words = r"foreign_classes:Plain': unknown option 'windo' \(did you mean 'window'\?\); known: window"
    with pytest.raises(ConfigurationError, match=words):
        registry.create("backends", "foreign_classes:Plain", "rig", windo=3)
    with pytest.raises(ConfigurationError, match=r"foreign_classes:Nothing' has no options, got 'windo'"):
        registry.create("backends", "foreign_classes:Nothing", "rig", windo=3)
    with pytest.raises(ConfigurationError, match="does not take the argument models"):
        registry.create("backends", "foreign_classes:Nothing", "rig", models=3)


@pytest.mark.parametrize(
    ("setting", "meant"),
    [
        ("map.max_landmark=3", "'max_landmarks'"),
        ("mpa.max_landmarks=3", "'map.max_landmarks'"),
        ("mapp.gird=3", "'map'"),
        ("max_landmarks=3", "'map.max_landmarks'"),
        ("map.max_speed=3", "'objects.max_speed'"),  # not that of the models, which cannot be set
    ],
)
def test_a_setting_is_suggested(setting, meant):
    with pytest.raises(SlamError) as raised:
        SystemConfig().with_settings([setting])
    assert f"did you mean {meant}?" in str(raised.value)
