"""All numeric constants of the algorithms: what each is, and what happens at half and at twice its value.

    python experiments/parameters.py [--page docs/parameters.md] [--sensitivity FILE]

Writes the page from the constants' own comments and from what `experiments/sensitivity.py` measured, where its table is
given. A constant's comment says what it is, its unit in brackets, and where it comes from.
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

#: Where constants that shape an estimate are; worlds, readers, reports and commands have none.
ROOMS = ("slam/geometry", "slam/tracking", "slam/mapping", "slam/calibration", "slam/objects", "backends", "frontends")

INTRODUCTION = """# Parameters

Every number in the algorithms that is not a setting, with what it is and where it comes from. Settings are listed by
`slam run --help` and in the [reference](running.md). The table is made by `python experiments/parameters.py`.
"""

SENSITIVITY = """\
The columns ½ and 2 say what happens where the number is half and twice as large: the error of the camera's position,
and that of the bodies' motion, each as a ratio to the error with the default. It is the worse of both back ends, and
the geometric mean over short runs of {cases} (`python experiments/sensitivity.py`).
Under small perturbations of the pixels the errors scatter by factors of {camera:.2f} and {bodies:.2f}: a number whose
ratios lie within does not matter there.

{counts}

- "same": the same bytes. Such a number is kept if it guards against input that these runs do not have (degenerate
  geometry, wrong matches, a kidnapped camera, overflow), or if it only trades time: most iterations, sizes of blocks.
- "fails": a run did not end, or lost the camera or the bodies.
- "not read": none of these runs comes to the code that reads the number, as that for faults and long runs.
- Empty: not measured, as it is compiled into a kernel, read on import, part of the front end{rest}.
"""


@dataclass(frozen=True)
class Parameter:
    """A constant at the top of a module.

    Attributes:
        file: path from the root of the project.
        name: of the constant.
        value: a number or a tuple of numbers.
        comment: what its author says of it.
    """

    file: str
    name: str
    value: Any
    comment: str

    @property
    def module(self) -> str:
        """Dotted name of the module."""
        return self.file.removesuffix(".py").replace("/", ".")


def find(root: Path = ROOT) -> list[Parameter]:
    """All constants of the algorithms, by file and line."""
    files = [file for room in ROOMS for file in sorted((root / room).rglob("*.py"))]
    return [parameter for file in files for parameter in _of_file(file, file.relative_to(root).as_posix())]


def _of_file(file: Path, name: str) -> list[Parameter]:
    text = file.read_text(encoding="utf-8")
    comments = _comments(file)
    found = []
    for node in ast.parse(text).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        names = [target] if isinstance(target, ast.Name) else getattr(target, "elts", [])
        values = [node.value] if isinstance(target, ast.Name) else getattr(node.value, "elts", [])
        for each, value in zip(names, values):
            number = _number(value)
            if number is not None and isinstance(each, ast.Name) and each.id == each.id.upper():
                found.append(Parameter(name, each.id, number, _comment(comments, node.lineno, node.end_lineno)))
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


def _comments(file: Path) -> dict[int, tuple[str, bool]]:
    """Comments by line, and whether they have the line for themselves."""
    with tokenize.open(file) as lines:
        tokens = tokenize.generate_tokens(lines.readline)
        return {
            t.start[0]: (t.string.lstrip("#: ").strip(), not t.line[: t.start[1]].strip())
            for t in tokens
            if t.type == tokenize.COMMENT
        }


def _comment(comments: dict[int, tuple[str, bool]], first: int, last: int | None) -> str:
    """The comment behind a statement, else the lines of comment right above it."""
    for line in range(first, (last or first) + 1):
        if line in comments and not comments[line][1]:
            return comments[line][0]
    above: list[str] = []
    line = first - 1
    while line in comments and comments[line][1]:
        above.insert(0, comments[line][0])
        line -= 1
    return " ".join(above)


def page(parameters: list[Parameter], sensitivity: dict[str, Any]) -> str:
    """The page as Markdown."""
    ratios = sensitivity.get("ratios", {})
    lines = [INTRODUCTION]
    if ratios:
        rest = "" if sensitivity["complete"] else ", or to be run still"
        cases = ", ".join(f"`{case}`" for case in sensitivity["cases"])
        counts = _counts([ratios.get(f"{p.module}:{p.name}") for p in parameters], sensitivity["scatter"])
        lines.append(SENSITIVITY.format(cases=cases, rest=rest, counts=counts, **sensitivity["scatter"]))
    titles = ["file", "name", "value", "what it is", *(["½", "2"] if ratios else [])]
    rule = ["---", "---", "---:", "---", *(["---:", "---:"] if ratios else [])]
    for room in ROOMS:
        chosen = [p for p in parameters if p.file.startswith(room + "/")]
        if not chosen:
            continue
        lines += [f"## {room}\n", _row(titles), _row(rule)]
        for p in chosen:
            measured = ratios.get(f"{p.module}:{p.name}", [{}, {}]) if ratios else []
            cells = [p.file.removeprefix(room + "/"), f"`{p.name}`", str(p.value), p.comment.replace("|", "\\|")]
            lines.append(_row([*cells, *map(_ratio, measured)]))
        lines.append("")
    return "\n".join(lines)


def _counts(measured: list[list[dict[str, Any]] | None], scatter: dict[str, float]) -> str:
    """How many numbers matter, in a sentence."""
    known = [m for m in measured if m]
    kinds = [{value for side in m for value in side.values()} for m in known]
    texts = [{value for value in values if isinstance(value, str)} for values in kinds]
    same, unread = (sum(values == {word} for values in kinds) for word in ("same", "not read"))
    fails = sum("fails" in words for words in texts)
    within = [
        all(isinstance(v, str) or 1 / scatter[k] <= v <= scatter[k] for s in m for k, v in s.items()) for m in known
    ]
    small = sum(within) - same - unread - sum(w and "fails" in t for w, t in zip(within, texts))
    more = len(known) - unread - same - small - fails
    return (
        f"Of {len(measured)} numbers {len(known)} are measured; {unread} of these are not read in these runs.\n"
        f"At half or twice its value, {same} change nothing, {small} change errors by less than the scatter, {more}\n"
        f"by more, and {fails} make a run fail."
    )


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
    arguments.page.write_text(page(find(), table), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
