"""The table of classes and counts for the documentation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.harness import Subject

BEGIN, END = "<!-- counts: written by python -m tests.fuzz --page -->", "<!-- end of counts -->"


@dataclass(frozen=True)
class Tally:
    """How many cases of a class were run, and how many failed."""

    subject: Subject
    cases: int
    failed: int


def write_page(page: Path, tallies: Sequence[Tally], seed: int) -> None:
    """Replace the table on a page, which is between two marks."""
    rows = [
        f"| {t.subject.name} | {t.subject.inputs} | {t.subject.promise} | {t.cases} | {t.failed} |" for t in tallies
    ]
    total = f"| together | | | {sum(t.cases for t in tallies)} | {sum(t.failed for t in tallies)} |"
    head = ["| class | inputs | what is promised | cases | failed |", "| --- | --- | --- | ---: | ---: |"]
    table = "\n".join([BEGIN, "", *head, *rows, total, "", f"Seed {seed}.", "", END])
    text = page.read_text(encoding="utf-8")
    if BEGIN not in text or END not in text:
        raise SystemExit(f"{page}: no place for the table: {BEGIN} … {END}")
    page.write_text(
        re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: table, text, flags=re.S), encoding="utf-8"
    )
