"""Write the table of rooms in ``docs/architecture.md``: ``python docs/make_architecture.py``.

A room is a folder directly under ``slam``, or one of the packages ``frontends`` and ``backends``; the modules in
``slam`` itself make up the room ``slam``.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = Path("docs/architecture.md")
START, END = "<!-- rooms: written by docs/make_architecture.py -->", "<!-- end of rooms -->"


def rooms(root: Path) -> dict[str, list[Path]]:
    """The rooms by name, with their modules."""
    folders = [*sorted((root / "slam").iterdir()), root / "backends", root / "frontends"]
    found = {folder.name: sorted(folder.rglob("*.py")) for folder in folders if (folder / "__init__.py").exists()}
    return {"slam": [f for f in sorted((root / "slam").glob("*.py")) if f.name != "__main__.py"], **found}


def table(root: Path) -> str:
    """Room and duty as a Markdown table."""
    lines = ["| room | its duty |", "| --- | --- |"]
    for room, files in rooms(root).items():
        init = next(f for f in files if f.name == "__init__.py")
        duty = (ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))) or "–").splitlines()[0]
        lines.append(f"| `{room}` | {duty} |")
    return "\n".join(lines)


def page(text: str, root: Path) -> str:
    """The page with its table rebuilt."""
    before, after = text.partition(START)[0], text.partition(END)[2]
    return f"{before}{START}\n\n{table(root)}\n\n{END}{after}"


if __name__ == "__main__":
    path = ROOT / PAGE
    path.write_text(page(path.read_text(encoding="utf-8"), ROOT), encoding="utf-8")
