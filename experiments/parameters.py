"""All numeric constants of the algorithms: what each is, and what happens at half and at twice its value.

    python experiments/parameters.py [--page docs/parameters.md] [--sensitivity FILE]

Writes the page from the constants' own comments and from what `experiments/sensitivity.py` measured, where its table is
given; constants that are gone are taken out of that table. A constant's comment says what it is, its unit in brackets,
and where it comes from.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

#: Where constants that shape an estimate are; worlds, readers, reports and commands have none.
ROOMS = (
    "slam/kernels", "slam/geometry", "slam/input", "slam/tracks", "slam/window", "slam/atlas", "slam/calibration",
    "slam/bodies", "backends", "frontends",
)  # fmt: skip

INTRODUCTION = """# Parameters

The named numbers in the algorithms that are not settings (`slam settings` lists those): how many there are of each
kind, and the choices that change a result. Reasons are in the code. Made by `python experiments/parameters.py`.
"""

#: What kinds of numbers there are; a constant's comment begins with its kind, and is a choice where it does not.
KINDS = {
    "choice": "a threshold, a prior or a share that was chosen",
    "derived": "a quantile of χ² of the probability named with it",
    "paper": "as published",
    "fixed": "the size of a state, the form of a file, the fewest points that give a pose",
    "guard": "a bound of what is believed: what lies beyond is broken input",
    "numerics": "iterations, tolerances, terms that keep a matrix invertible",
    "cost": "how much time or memory something may take",
}

SENSITIVITY = """\
The columns ½ and 2 are for half and twice the number: errors of the camera's position and of the bodies' motion, over
the default's; the worst back end, geometric mean over short runs of {cases} (older ones: without the last two; `python
experiments/sensitivity.py`). A number changes a result where that is beyond the scatter under small perturbations of
the pixels, factors of {camera:.2f} and {bodies:.2f}, or a run fails.
"""

#: What a number does at half or twice its value, by column of the summary.
OUTCOMES = ("changes a result", "does not", "not measured")


@dataclass(frozen=True)
class Parameter:
    """A constant at the top of a module."""

    file: str  # path from the root of the project
    name: str  # of the constant
    value: Any  # a number or a tuple of numbers
    comment: str  # what its author says of it
    kind: str  # one of `KINDS`
    place: tuple[int, int, int]  # of the value in the file: line from 0, first column, column behind

    @property
    def key(self) -> str:
        """Dotted name of the module, and the constant's own."""
        return f"{self.file.removesuffix('.py').replace('/', '.')}:{self.name}"


def find(root: Path = ROOT) -> list[Parameter]:
    """All constants of the algorithms, by file and line."""
    files = [file for room in ROOMS for file in sorted((root / room).rglob("*.py"))]
    return [parameter for file in files for parameter in _of_file(file, file.relative_to(root).as_posix())]


def _of_file(file: Path, name: str) -> list[Parameter]:
    lines = file.read_text(encoding="utf-8").splitlines()
    found = []
    for node in ast.parse("\n".join(lines)).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        names = [target] if isinstance(target, ast.Name) else getattr(target, "elts", [])
        values = [node.value] if isinstance(target, ast.Name) else getattr(node.value, "elts", [])
        for each, value in zip(names, values):
            number = _number(value)
            if number is not None and isinstance(each, ast.Name) and each.id == each.id.upper():
                comment = _comment(lines, node.lineno, node.end_lineno)
                kind, colon, rest = comment.partition(": ")
                known = bool(colon) and kind in KINDS
                place = value.lineno - 1, value.col_offset, value.end_col_offset or 0
                text, kind = (rest, kind) if known else (comment, "choice")
                found.append(Parameter(name, each.id, number, text, kind, place))
    return found


def _number(node: ast.expr) -> Any:
    """A number, or a tuple of numbers; None for anything else."""
    try:
        value = ast.literal_eval(node)
    except ValueError:
        return None
    parts = value if isinstance(value, tuple) else (value,)
    good = parts and all(isinstance(p, (int, float)) and not isinstance(p, bool) for p in parts)
    return value if good else None


def _comment(lines: list[str], first: int, last: int | None) -> str:
    """The comment behind a statement in lines `first` to `last`, else the lines of comment right above it."""
    for line in lines[first - 1 : last]:
        if behind := re.search(r"#:? *(.*)", line):
            return behind[1].strip()
    above: list[str] = []
    for line in lines[first - 2 :: -1]:
        if not line.startswith("#"):
            break
        above.insert(0, line.lstrip("#: ").strip())
    return " ".join(above)


def page(parameters: list[Parameter], sensitivity: dict[str, Any]) -> str:
    """The page as Markdown: how many numbers of each kind there are, and the choices that change a result."""
    ratios, scatter = sensitivity.get("ratios", {}), sensitivity.get("scatter", {})
    measured = {p: ratios.get(p.key) for p in parameters}
    lines = [INTRODUCTION, _row(["kind", "what it is", "numbers", *OUTCOMES])]
    lines.append(_row(["---", "---", "---:", *["---:"] * len(OUTCOMES)]))
    for kind, meaning in KINDS.items():
        chosen = [p for p in parameters if p.kind == kind]
        outcomes = [_outcome(measured[p], scatter) for p in chosen]
        lines.append(_row([kind, meaning, str(len(chosen)), *(str(outcomes.count(o)) for o in OUTCOMES)]))
    if ratios:
        cases = ", ".join(f"`{case}`" for case in sensitivity["cases"])
        lines += ["", SENSITIVITY.format(cases=cases, **scatter)]
    lines += ["## Choices", "", _row(["name", "value", "what it is", "½", "2"]), "| --- | ---: | --- | ---: | ---: |"]
    file = ""
    for p in (p for p in parameters if p.kind == "choice" and _outcome(measured[p], scatter) == OUTCOMES[0]):
        if p.file != file:
            file = p.file
            lines.append(_row([f"**{file}**", "", "", "", ""]))
        text = re.split(r"(?<!\d)[.:;]\s", p.comment)[0].removesuffix(".").replace("|", "\\|")
        lines.append(_row([f"`{p.name}`", str(p.value), text, *map(_ratio, measured[p] or [{}, {}])]))
    return "\n".join(lines) + "\n"


def _outcome(measured: list[dict[str, Any]] | None, scatter: dict[str, float]) -> str:
    """What a number does at half or twice its value, the worse of both: one of `OUTCOMES`."""
    if not measured:
        return "not measured"
    values = [(k, v) for side in measured for k, v in side.items()]
    beyond = (isinstance(v, float) and not 1 / scatter[k] <= v <= scatter[k] for k, v in values)
    return OUTCOMES[0] if any(beyond) or "fails" in (v for _, v in values) else OUTCOMES[1]


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _ratio(measured: dict[str, float | str]) -> str:
    """The ratios of the camera's and the bodies' errors, or one word where that says it all."""
    values = [f"{v:.2f}" if isinstance(v, float) else str(v) for v in map(measured.get, ("camera", "bodies")) if v]
    return values[0] if values and values[0] in ("same", "fails", "not read") else " / ".join(values)


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "parameters.md")
    parser.add_argument("--sensitivity", type=Path, default=ROOT / "docs" / "sensitivity.json")
    arguments = parser.parse_args()
    table = json.loads(arguments.sensitivity.read_text()) if arguments.sensitivity.exists() else {}
    parameters = find()
    if table:
        present = {p.key for p in parameters}
        table["ratios"] = {name: each for name, each in table["ratios"].items() if name in present}
        arguments.sensitivity.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    arguments.page.write_text(page(parameters, table), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
