"""Back ends and front ends by name where the user's folder has packages of the same names."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam import registry
from slam.errors import UnknownNameError

ROOT = Path(__file__).resolve().parents[2]
_RESOLVE = "from slam import registry; registry.resolve({role!r}, {name!r})"


@pytest.fixture
def folder(tmp_path):
    for package in ("backends", "frontends", "mypackage"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
        (tmp_path / package / "mytoy.py").write_text("class Toy:\n    def __init__(self, rig, models=None): ...\n")
    return tmp_path


def _said(folder, *words, path=(ROOT,)):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    done = subprocess.run([sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True)
    return done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""


@pytest.mark.parametrize(("role", "name"), [("backends", "ekf"), ("frontends", "surf")])
def test_a_folder_that_hides_ours_is_named(folder, role, name):
    said = _said(folder, "-c", _RESOLVE.format(role=role, name=name))
    assert f"{folder / role} hides slam's own `{role}`: rename it" in said


@pytest.mark.slow
def test_python_m_slam_is_not_hidden_and_finds_a_package_in_the_folder(folder):
    run = ("-m", "slam", "run", "synthetic:desk?frames=3", "--out", "out", "--frontend", "nothing", "--backend")
    assert "unknown front end 'nothing'" in _said(folder, *run, "ekf")
    assert "it lacks predict" in _said(
        folder, "-m", "slam", "run", "synthetic:desk?frames=3", "--out", "out", "--backend", "mypackage.mytoy:Toy"
    )


def test_a_back_end_by_its_module_in_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "my_own_module.py").write_text(
        "class Mine:\n    def __init__(self, rig, models=None):\n        self.rig = rig\n    extract = print\n"
    )
    (tmp_path / "a_broken_module.py").write_text("class Mine(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert registry.create("frontends", "my_own_module:Mine", "rig").rig == "rig"
    assert sys.path[-1] == str(tmp_path)  # last: nothing that is installed is replaced
    for name in ("my_own_module:Other", "my_own_module:", ":Mine", "a_broken_module:Mine"):
        with pytest.raises(UnknownNameError, match=f"back end '{name}' cannot be loaded"):
            registry.resolve("backends", name)
    with pytest.raises(UnknownNameError, match=r"no attribute 'mine' \(did you mean 'Mine'\?\)"):
        registry.resolve("backends", "my_own_module:mine")
    with pytest.raises(UnknownNameError, match=f"looked for in {tmp_path}, where `slam` runs"):
        registry.resolve("backends", "no_module_of_this_name:Mine")
