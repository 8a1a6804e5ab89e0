"""Tables of the experiments: Markdown for the results page, and the same cells as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def markdown(header: Sequence[str], rows: Sequence[Sequence[Any]], texts: int = 1) -> str:
    """A Markdown table; the first `texts` columns stand left, numbers with a fraction have two digits of it."""
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * texts + " ---: |" * (len(header) - texts)]
    return "\n".join(lines + ["| " + " | ".join(map(_cell, row)) + " |" for row in rows])


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def write_json(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """A list of rows, each by the names of its columns; no folder is needed before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([dict(zip(header, row)) for row in rows], indent=2) + "\n", encoding="utf-8")
