"""The short form of every class of inputs; ``python -m tests.fuzz`` runs more."""

from __future__ import annotations

import os

import pytest

from slam.errors import SlamError
from tests.fuzz.catalogue import SUBJECTS
from tests.fuzz.harness import Broken, Subject, run_case, warm_up
from tests.fuzz.page import BEGIN, END, Tally, write_page


@pytest.fixture(scope="module", autouse=True)
def _warm():
    warm_up()


@pytest.mark.parametrize("subject", SUBJECTS, ids=[s.name.replace(" ", "_") for s in SUBJECTS])
@pytest.mark.parametrize("part", ["first", pytest.param("rest", marks=pytest.mark.slow)])
def test_what_is_promised_of_hostile_input(subject, part):
    first = -(-subject.short // 4)
    numbers = range(first) if part == "first" else range(first, subject.short)
    failures = [f for number in numbers if (f := run_case(subject, 0, number)) is not None]
    assert not failures, "\n".join(f"case {f.number}: {f.signature}" for f in failures)


def _wait(rng, folder):
    os.mkfifo(folder / "pipe")
    (folder / "pipe").read_bytes()


def _print(rng, folder):
    os.write(2, b"libpng error")


def _break(rng, folder):
    raise Broken("no promise")


def _two_lines(rng, folder):
    raise type("TwoLines", (SlamError,), {"__str__": lambda self: "one\ntwo"})


CASES = [(_wait, "waits for ever"), (_print, "printed"), (_break, "no promise"), (_two_lines, "is no line")]


@pytest.mark.parametrize(("case", "words"), CASES)
def test_the_harness_notices(case, words, monkeypatch):
    monkeypatch.setattr("tests.fuzz.harness.BLOCKED", 0.3)
    assert words in run_case(Subject("x", "", "", case), 0, 0).signature


def test_the_table_of_counts_is_put_in_its_place(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"before\n\n{BEGIN}\nstale\n{END}\n\nafter\n")
    for _ in range(2):
        write_page(page, [Tally(SUBJECTS[0], 5, 1), Tally(SUBJECTS[1], 7, 0)], 3)
    text = page.read_text()
    assert text.startswith("before") and text.endswith("after\n") and "stale" not in text
    assert "| together | | | 12 | 1 |" in text and text.count(BEGIN) == 1
