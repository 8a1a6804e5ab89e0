"""Kernels are compiled once, again where a helper in another file has changed, and loaded where nothing has."""

import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from slam.runtime.compilation import kernel, stamp

ROOT = Path(__file__).parents[3]

HELPERS = """
from slam.runtime.compilation import helper
{number}
@helper
def _deeper(x):
    return {factor} * x
@helper
def scaled(x):
    return _deeper(x)
"""
CALLER = """
from slam.kernels.probe import NUMBER, scaled
from slam.runtime.compilation import kernel
@kernel
def times(x):
    return scaled(x) + NUMBER
"""
ASK = """
from slam.tracks.probe_kernels import times
print(times(10.0), sum(times.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path):
    """A copy of what kernels need, with a kernel in one room that calls a helper in another."""
    for room in ("runtime", "kernels", "tracks"):
        shutil.copytree(ROOT / "slam" / room, tmp_path / "slam" / room, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "slam/__init__.py").touch()
    shutil.copy(ROOT / "slam/errors.py", tmp_path / "slam/errors.py")
    (tmp_path / "slam/tracks/__init__.py").write_text("")
    (tmp_path / "slam/tracks/probe_kernels.py").write_text(CALLER)
    return tmp_path


def result(package: Path, factor: float, number: str, **variables: str) -> tuple[float, int]:
    """What the kernel gives with such helpers in a new process, and how often it was loaded from the cache."""
    (package / "slam/kernels/probe.py").write_text(HELPERS.format(factor=factor, number=f"NUMBER = {number}"))
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1", **variables}
    run = [sys.executable, "-c", ASK]
    out = subprocess.run(run, env=environment, cwd=package, capture_output=True, text=True, check=True).stdout.split()
    return float(out[0]), int(out[1])


@pytest.mark.slow
@pytest.mark.parametrize("where", ["in_tree", "cache_dir"])
def test_a_change_of_a_helper_in_another_file_compiles_its_callers_again(package, where):
    folder = {} if where == "in_tree" else {"NUMBA_CACHE_DIR": str(package / "cache")}
    assert result(package, 2.0, "1.0", **folder) == (21.0, 0)
    assert result(package, 2.0, "1.0", **folder) == (21.0, 1)
    assert result(package, 3.0, "1.0", **folder) == (31.0, 0)
    assert result(package, 3.0, "1.5", **folder) == (31.5, 0)


def test_every_kernel_stands_below_its_helpers():
    """A stamp is taken where a kernel is defined: helpers further below would not be in it, and it would be stale."""
    kernels, wrong = 0, []
    for root in ("slam", "backends", "frontends"):
        package = importlib.import_module(root)
        for found in pkgutil.walk_packages(package.__path__, f"{root}."):
            if found.name.endswith("__main__"):
                continue
            for name, value in list(vars(importlib.import_module(found.name)).items()):
                file = getattr(getattr(value, "_cache", None), "_cache_file", None)
                function = getattr(value, "py_func", None)
                if file is not None and function is not None and function.__module__ == found.name:
                    kernels += 1
                    if file._source_stamp[1] != stamp(function, kernel):
                        wrong.append(f"{found.name}.{name}")
    assert kernels > 40 and not wrong


WARM_UP = """
import sys
from slam.run.warm_up import warm_up
warm_up()
assert warm_up() == 0.0
rooms = ("slam.", "frontends.", "backends.")
values = [v for name, module in list(sys.modules.items()) if name.startswith(rooms) for v in vars(module).values()]
kernels = {v for v in values if getattr(getattr(v, "stats", None), "cache_path", None)}
assert len(kernels) > 50
print(*(f"{k.py_func.__module__}.{k.__name__}" for k in kernels if len(k.signatures) != 1))
"""


@pytest.mark.slow
def test_after_warming_up_nothing_is_left_to_compile_or_to_load_and_each_kernel_is_compiled_once():
    done = subprocess.run([sys.executable, "-c", WARM_UP], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.split(), "never called, or compiled for several types or layouts of arrays"
