"""The list of numeric constants is that of the code, and each says what it is."""

from __future__ import annotations

from pathlib import Path

from experiments.parameters import find

DOCS = Path(__file__).parent.parent / "docs"


def test_every_constant_says_what_it_is():
    silent = [f"{p.file}: {p.name}" for p in find() if not p.comment]
    assert not silent, "\n".join(silent)
