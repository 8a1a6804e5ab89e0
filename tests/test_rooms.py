"""Imports between the rooms of `slam` run one way, and in no package in a circle."""

from __future__ import annotations

import ast
from pathlib import Path

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
    "tracks": {"data", "geometry", "kernels", "runtime"},
    "calibration": {"data", "geometry", "kernels", "runtime"},
    "atlas": {"tracks", "window", "data", "geometry", "runtime"},
    "bodies": {"window", "tracks", "data", "geometry", "kernels", "runtime"},
    "papers": {"bodies", "tracks", "data", "geometry", "runtime"},
    "worlds": {"data", "geometry"},
    "sequences": {"worlds", "data", "geometry"},
    "evaluation": {"data", "geometry"},
    "input": {"tracks", "data", "geometry", "runtime"},
    "system": {"papers", "bodies", "atlas", "tracks", "calibration", "input", "data", "geometry", "runtime"},
    "run": {
        "system", "calibration", "bodies", "atlas", "tracks", "input", "sequences", "worlds", "evaluation", "data",
        "geometry", "runtime",
    },
    "compare": {"run", "system", "sequences", "worlds", "evaluation", "data", "geometry", "bodies"},
    "testing": {"system", "worlds", "data", "geometry"},
    "commands": {
        "compare", "run", "bodies", "system", "sequences", "worlds", "evaluation", "data", "geometry", "runtime",
    },
    "outside": {"run", "system", "atlas", "calibration", "sequences", "data", "geometry", "runtime"},
}  # fmt: skip

#: The root's modules by room; all others are "base".
ROOT_ROOMS = {
    "data": {"checks", "third_party", "data", "interfaces", "models", "object_data"},
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


def imports(known: dict[str, Path]) -> dict[str, set[str]]:
    """For every module those of the known ones that it imports, also inside functions and for types alone."""
    found: dict[str, set[str]] = {}
    for name, file in known.items():
        found[name] = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names if alias.name in known}
            elif isinstance(node, ast.ImportFrom) and node.module in known:
                whole = {f"{node.module}.{alias.name}" for alias in node.names}
                inside = whole & set(known)
                found[name] |= inside if len(inside) == len(whole) else {node.module, *inside}
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


def test_every_room_says_what_it_is_for():
    for room in MAY_IMPORT:
        if (SLAM / room).is_dir():
            lines = ast.get_docstring(ast.parse((SLAM / room / "__init__.py").read_text(encoding="utf-8"))) or ""
            assert len(lines.splitlines()) >= 2 and "import" in lines.lower(), f"slam/{room}/__init__.py"
