"""The short form of every class of inputs; ``python -m tests.fuzz`` runs more."""

from __future__ import annotations

import os

import numpy as np
import pytest

from slam.errors import SlamError
from tests.fuzz.__main__ import SUBJECTS
from tests.fuzz.bookkeeping import MENDED, keep_books
from tests.fuzz.harness import Broken, Subject, run_case, warm_up


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


@pytest.mark.parametrize("seed", MENDED)
def test_what_bookkeeping_found_stays_mended(seed, tmp_path):
    keep_books(np.random.default_rng(seed), tmp_path)


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
    assert words in run_case(Subject("x", case), 0, 0).signature
