"""The list of numeric constants is that of the code, and each says what it is."""

from __future__ import annotations

import json
from pathlib import Path

from experiments.parameters import find, page

DOCS = Path(__file__).parent.parent / "docs"


def test_the_page_is_current():
    file = DOCS / "sensitivity.json"
    table = json.loads(file.read_text()) if file.exists() else {}
    assert (DOCS / "parameters.md").read_text(encoding="utf-8") == page(find(), table), "run experiments/parameters.py"


def test_every_constant_says_what_it_is():
    silent = [f"{p.file}: {p.name}" for p in find() if not p.comment]
    assert not silent, "\n".join(silent)
