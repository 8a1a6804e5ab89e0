"""What an experiment leaves: a Markdown table for the results page, the same cells as JSON, and a picture."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np


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


def show(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]], texts: int = 1, words: str = "") -> None:
    """Print a table, with words below it, and write its cells to a JSON file."""
    print(markdown(header, rows, texts) + (f"\n\n{words}" if words else ""), flush=True)
    write_json(path, header, rows)


Runs = Callable[[set[tuple[str, ...]]], Iterator[Sequence[Any]]]


def resumed(path: Path, header: Sequence[str], keys: Sequence[str], runs: Runs) -> list[dict[str, str]]:
    """All rows of a CSV file with this header, after those that are missing were appended to it one by one.

    `keys` are the columns that tell a run from the others; `runs` makes the missing rows, given the keys of the others.
    """

    def read() -> list[dict[str, str]]:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_text(",".join(header) + "\n", encoding="utf-8")
    with path.open("a", newline="", encoding="utf-8") as file:
        for row in runs({tuple(row[key] for key in keys) for row in read()}):
            csv.writer(file).writerow(row)
            file.flush()
    return read()


@contextmanager
def picture(path: Path, width: float, height: float, rows: int = 1, columns: int = 1, **shared: Any) -> Iterator[Any]:
    """Panels (rows, columns) of a picture so large [in], which is written to `path` at the end; no folder is needed."""
    from matplotlib.figure import Figure

    figure = Figure((width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    yield axes if min(rows, columns) > 1 else np.ravel(axes)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})
