"""The short form of every class of inputs; ``python -m tests.fuzz`` runs more."""

from __future__ import annotations

import pytest

from tests.fuzz.__main__ import SUBJECTS
from tests.fuzz.harness import run_case, warm_up


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
