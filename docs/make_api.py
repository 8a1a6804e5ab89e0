"""Lists of what the API pages hold, with links to the sources, so that they can be read where no site is built.

    python docs/make_api.py

Everything between a line ``::: module`` and the next one is written anew; the site leaves it out (`notebook_links`).
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((Path(__file__).parent / "api").glob("*.md"))


def listed(name: str) -> str:
    """A module in a sentence, and the names of its public classes and functions, in the order of its source."""
    module = import_module(name)
    own = [
        thing
        for key, thing in vars(module).items()
        if not key.startswith("_") and callable(thing) and getattr(thing, "__module__", "") == name
    ]
    names = ", ".join(f"`{thing.__name__}`" for thing in own if inspect.getdoc(thing))
    first = (inspect.getdoc(module) or "").partition("\n")[0]
    source = Path(inspect.getsourcefile(module) or "").resolve().relative_to(ROOT).as_posix()
    return f"[`{name}`](../../{source}): {first}" + (f" Holds {names}." if names else "")


def written(page: str) -> str:
    """A page with the lists of its modules as they are now."""
    head, *parts = re.split(r"^::: ", page, flags=re.MULTILINE)
    names = [part.split()[0] for part in parts]
    return head + "\n".join(f"::: {name}\n\n{listed(name)}\n" for name in names)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(written(path.read_text(encoding="utf-8")), encoding="utf-8")
