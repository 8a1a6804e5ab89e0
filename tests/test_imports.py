"""What importing loads: imports run one way, and a back end brings only what it needs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def modules_after(code: str) -> set[str]:
    """Top-level modules loaded after running code in a fresh interpreter."""
    listing = f"{code}\nimport sys; print(' '.join({{m.partition('.')[0] for m in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", listing], capture_output=True, text=True, cwd=ROOT, check=True)
    return set(done.stdout.split())


def test_import_slam_loads_numpy_and_nothing_else_that_is_heavy():
    loaded = modules_after("import slam")
    heavy = {"scipy", "cv2", "gtsam", "numba", "pydantic", "typer", "rich", "matplotlib", "backends", "frontends"}
    assert not loaded & heavy


def test_choosing_ekf_leaves_gtsam_unloaded():
    code = (
        "import slam, numpy as np\n"
        "rig = slam.StereoRig.rectified_pair(300, 160, 120, 0.12, 320, 240)\n"
        "system = slam.StereoSlam(rig, 'surf', 'ekf')\n"
        "image = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)\n"
        "system.process(slam.StereoFrame(0, 0.0, image, image[:, ::-1]))\n"
        "system.process(slam.StereoFrame(1, 0.1, image, image[:, ::-1]))\n"
    )
    assert not {m for m in modules_after(code) if m.startswith("gtsam")}


def test_listing_names_imports_no_back_end():
    loaded = modules_after("import backends, frontends; backends.names(); frontends.names()")
    assert not loaded & {"gtsam", "numba", "scipy", "cv2"}


ALLOWED = {"slam": {"slam"}, "frontends": {"slam", "frontends"}, "backends": {"slam", "backends"}}


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package):
    for file in (ROOT / package).rglob("*.py"):
        ours = {"slam", "frontends", "backends", "tests", "experiments", "benchmarks"}
        assert imported(file) & ours <= ALLOWED[package], file


def test_gtsam_and_numba_stay_in_their_place():
    for package in ALLOWED:
        for file in (ROOT / package).rglob("*.py"):
            place = file.relative_to(ROOT).as_posix()
            names = imported(file)
            if names & {"gtsam", "gtsam_unstable"}:
                assert place.startswith(("backends/smoother", "backends/batch")), place
            if "numba" in names:
                assert place == "slam/runtime/compilation.py", place


def imported(file: Path) -> set[str]:
    """Top-level names of all imports in a file."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.partition(".")[0])
    return found
