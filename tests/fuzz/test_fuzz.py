"""Hostile input for every part that reads any.

A class of inputs is a generator of cases. A case is made of its number alone, so each can be had again. It holds where
what is promised is kept: a result, or a `SlamError` of one line, within `harness.SECONDS` of processor time and a
bounded memory, with nothing printed. ``FUZZ=0:1000 pytest tests/fuzz`` tries so many of every class.
"""

import os

import pytest

from tests.fuzz import bookkeeping, readers, saved
from tests.fuzz.harness import run_case, warm_up

SUBJECTS = tuple(subject for module in (readers, saved, bookkeeping) for subject in module.SUBJECTS)
ASKED = range(*map(int, os.environ.get("FUZZ", "0:0").split(":")))


@pytest.mark.parametrize("subject", SUBJECTS, ids=[s.name.replace(" ", "_") for s in SUBJECTS])
@pytest.mark.parametrize("part", ["first", pytest.param("rest", marks=pytest.mark.slow)])
def test_what_is_promised_of_hostile_input(subject, part):
    if subject.runs:
        warm_up()
    first = -(-subject.short // 4)
    numbers = range(first) if part == "first" else ASKED or range(first, subject.short)
    failed = {number: text for number in numbers if (text := run_case(subject, number))}
    assert not failed, f"cases {list(failed)} of {len(numbers)}, of which the first:\n{next(iter(failed.values()))}"
