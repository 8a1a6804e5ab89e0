"""Write the table of rooms and their imports in ``docs/architecture.md``: ``python docs/make_architecture.py``.

A room is a folder directly under ``slam``, or one of the packages ``frontends`` and ``backends``; the modules in
``slam`` itself make up the room ``slam``. Imports inside functions and for type checking count as well.
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


def imported(files: list[Path], known: dict[str, list[Path]]) -> set[str]:
    """Rooms that some modules import from; all imports of this code are absolute."""
    found = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for package, _, rest in (name.partition(".") for name in names):
                inner = rest.partition(".")[0]
                found |= {inner if package == "slam" and inner in known else package} & set(known)
    return found


def table(root: Path) -> str:
    """Room, duty and imports as a Markdown table."""
    known = rooms(root)
    lines = ["| room | its duty | imports from |", "| --- | --- | --- |"]
    for room, files in known.items():
        init = next(f for f in files if f.name == "__init__.py")
        duty = (ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))) or "–").splitlines()[0]
        targets = ", ".join(f"`{other}`" for other in known if other != room and other in imported(files, known))
        lines.append(f"| `{room}` | {duty} | {targets or '–'} |")
    return "\n".join(lines)


def page(text: str, root: Path) -> str:
    """The page with its table rebuilt."""
    before, after = text.partition(START)[0], text.partition(END)[2]
    return f"{before}{START}\n\n{table(root)}\n\n{END}{after}"


if __name__ == "__main__":
    path = ROOT / PAGE
    path.write_text(page(path.read_text(encoding="utf-8"), ROOT), encoding="utf-8")
