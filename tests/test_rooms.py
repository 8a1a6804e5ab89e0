"""Imports run one way, between packages and between the rooms of `slam`, in no circle; each brings what it needs."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SLAM = ROOT / "slam"

#: What a room may import, besides itself and "base". Modules at the root of `slam` are four rooms: "base", which needs
#: no other; "data", what everybody passes on; "system"; and "outside", the package itself with its public names.
MAY_IMPORT = {
    "base": set(),
    "runtime": set(),
    "kernels": {"runtime"},
    "geometry": {"kernels", "runtime"},
    "data": {"geometry"},
    "window": {"data", "geometry", "kernels", "runtime"},
    "tracks": {"window", "data", "geometry", "kernels", "runtime"},
    "calibration": {"tracks", "window", "data", "geometry", "kernels", "runtime"},
    "atlas": {"tracks", "window", "data", "geometry", "runtime"},
    "bodies": {"window", "tracks", "data", "geometry", "kernels", "runtime"},
    "papers": {"bodies", "tracks", "data", "geometry", "runtime"},
    "worlds": {"data", "geometry"},
    "sequences": {"worlds", "data", "geometry"},
    "evaluation": {"data", "geometry"},
    "input": {"tracks", "data", "geometry", "runtime"},
    "system": {"papers", "bodies", "atlas", "tracks", "calibration", "input", "data", "geometry", "runtime"},
    "run": {
        "system", "calibration", "bodies", "atlas", "tracks", "window", "input", "sequences", "worlds", "evaluation",
        "data", "geometry", "runtime",
    },
    "compare": {"run", "system", "input", "sequences", "worlds", "evaluation", "data", "geometry", "bodies"},
    "testing": {"system", "worlds", "data", "geometry"},
    "commands": {
        "compare", "run", "calibration", "bodies", "system", "sequences", "worlds", "evaluation", "data", "geometry",
        "runtime",
    },
    "outside": {"run", "system", "atlas", "calibration", "sequences", "data", "geometry", "runtime"},
}  # fmt: skip

#: The root's modules by room; all others are "base".
ROOT_ROOMS = {
    "data": {"checks", "third_party", "guarded", "data", "interfaces", "models", "object_data"},
    "system": {"system", "session", "tracker", "config"},
    "commands": {"__main__"},
    "outside": {"__init__"},
}


def room_of(module: str) -> str:
    """The room of a module such as ``slam.geometry.se3``."""
    name = module.split(".")[1] if "." in module else "__init__"
    if (SLAM / name).is_dir():
        return name
    return next((room for room, names in ROOT_ROOMS.items() if name in names), "base")


def modules(*packages: str) -> dict[str, Path]:
    """All modules of some packages by dotted name."""
    found = {}
    for file in (file for package in packages for file in sorted((ROOT / package).rglob("*.py"))):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = file
    return found


@cache
def named(file: Path) -> list[tuple[str, set[str]]]:
    """What a file imports, also inside functions and for types alone: each module, and the names taken from it."""
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    whole = [(alias.name, set()) for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return whole + [(n.module or "", {a.name for a in n.names}) for n in nodes if isinstance(n, ast.ImportFrom)]


def imports(known: dict[str, Path]) -> dict[str, set[str]]:
    """For every module those of the known ones that it imports."""
    found: dict[str, set[str]] = {}
    for name, file in known.items():
        found[name] = set()
        for module, parts in named(file):
            inside = {f"{module}.{part}" for part in parts} & set(known)
            itself = {module} & set(known) if len(inside) < len(parts) or not parts else set()
            found[name] |= inside | itself
    return found


def test_no_room_imports_from_a_wrong_one():
    wrong = [
        f"{name} ({room_of(name)}) imports {target} ({room_of(target)})"
        for name, targets in imports(modules("slam")).items()
        for target in sorted(targets)
        if room_of(target) not in {room_of(name), "base", *MAY_IMPORT[room_of(name)]}
    ]
    assert not wrong, "\n".join(wrong)


def test_no_circle_of_rooms():
    below: set[str] = {"base"}
    for room, others in MAY_IMPORT.items():  # in this order each imports only from those before it
        assert others <= below, f"{room} imports {', '.join(sorted(others - below))}"
        below.add(room)


def test_no_circle_of_imports():
    graph = imports(modules("slam", "backends", "frontends"))
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done and name in graph:
            for target in sorted(graph[name] - {name}):
                visit(target, (*path, name))
            done.add(name)

    for name in sorted(graph):
        visit(name, ())


def test_no_module_has_more_than_400_lines():
    files = modules("slam", "backends", "frontends")
    assert not [name for name, file in files.items() if len(file.read_text(encoding="utf-8").splitlines()) > 400]


ALLOWED = {"slam": {"slam"}, "frontends": {"slam", "frontends"}, "backends": {"slam", "backends"}}
OURS = {*ALLOWED, "tests", "experiments", "benchmarks"}


@pytest.mark.parametrize("package", ALLOWED)
def test_packages_import_one_way_and_gtsam_and_numba_stay_in_their_place(package):
    for file in modules(package).values():
        place, names = file.relative_to(ROOT).as_posix(), {name.partition(".")[0] for name, _ in named(file)}
        assert names & OURS <= ALLOWED[package], place
        assert not names & {"gtsam", "gtsam_unstable"} or place.startswith(("backends/smoother", "backends/batch")), (
            place
        )
        assert "numba" not in names or place == "slam/runtime/compilation.py", place


EKF_RUN = """
import slam, numpy as np
system = slam.StereoSlam(slam.StereoRig.rectified_pair(300, 160, 120, 0.12, 320, 240), "surf", "ekf")
image = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
for k in range(2):
    system.process(image, image[:, ::-1], 0.1 * k)
"""
HEAVY = {"scipy", "cv2", "gtsam", "numba", "typer", "rich", "matplotlib", "backends", "frontends"}
LOADS = {
    "import slam": HEAVY,
    "import backends, frontends; backends.names(); frontends.names()": {"gtsam", "numba", "scipy", "cv2"},
    EKF_RUN: {"gtsam", "gtsam_unstable"},
}


@pytest.mark.parametrize("code", LOADS, ids=["slam", "names", "ekf"])
def test_nothing_heavy_is_loaded_before_it_is_used(code):
    listing = f"{code}\nimport sys; print(' '.join({{m.partition('.')[0] for m in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", listing], capture_output=True, text=True, cwd=ROOT, check=True)
    assert not set(done.stdout.split()) & LOADS[code]
