"""The lists of the API pages: ``python docs/make_api.py`` writes each name's link and the first line of its docstring.

A list can be read where no site is built; for the site, `hooks` puts the whole documentation of a name in its place.
"""

from __future__ import annotations

import inspect
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ROW = re.compile(r"^- \[?`([\w.]+)`.*", re.MULTILINE)  #: where a name is new, it stands alone in backticks


def documented(name: str) -> Any:
    """The module, class or function of a dotted name."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        module, _, attribute = name.rpartition(".")
        return getattr(documented(module), attribute)


def row(found: re.Match[str]) -> str:
    """The line of a name."""
    thing = documented(found[1])
    first = (inspect.getdoc(thing) or "").partition("\n")[0]
    file = getattr(thing, "__file__", None) or sys.modules[thing.__module__].__file__ or ""
    return f"- [`{found[1]}`](../../{Path(file).resolve().relative_to(ROOT).as_posix()}): {first}"


if __name__ == "__main__":
    for path in sorted((ROOT / "docs" / "api").glob("*.md")):
        path.write_text(ROW.sub(row, path.read_text(encoding="utf-8")), encoding="utf-8")
