"""For the API pages: ``left, right: …`` in a docstring documents two names, which are then shown in a row each."""

from __future__ import annotations

import re
from typing import Any

import griffe

#: Names in one line of a section, and their description, which may go on in lines that are indented further.
_NAMES = re.compile(r"^    (\w+(?:, \w+)+): (.*(?:\n {5,}.*)*)", re.MULTILINE)


class SplitNames(griffe.Extension):
    """Gives each of several names that share a line one of its own, with the same description."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of a class, function or module before it is taken apart."""
        if obj.docstring is not None:
            obj.docstring.value = _NAMES.sub(_split, obj.docstring.value)


def _split(found: re.Match[str]) -> str:
    return "\n".join(f"    {name}: {found[2]}" for name in found[1].split(", "))
