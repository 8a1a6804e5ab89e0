"""Hostile input for every part that reads any: many cases of every class, with counts, and the failures by kind.

A class of inputs is a generator of cases. A case is made of a seed and its number alone, so each can be had again. It
holds where what is promised is kept: a result, or a `SlamError` of one line, within `harness.SECONDS` of processor time
and a bounded memory, with nothing printed. `test_fuzz.py` is the short form.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections import Counter

from tests.fuzz import bookkeeping, readers, saved
from tests.fuzz.harness import run_case, warm_up

SUBJECTS = tuple(subject for module in (readers, saved, bookkeeping) for subject in module.SUBJECTS)


def main() -> int:
    """Exit status 1 where a case failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=200, help="of each class (default %(default)s)")
    parser.add_argument("--only", choices=[s.name for s in SUBJECTS], action="append", help="a class by name")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="one case by its number, with its traceback")
    given = parser.parse_args()
    logging.getLogger("slam").addHandler(logging.NullHandler())
    logging.getLogger("slam").propagate = False
    chosen, failed = [s for s in SUBJECTS if not given.only or s.name in given.only], 0
    warm_up()
    for subject in chosen:
        numbers, started = range(given.cases) if given.case is None else [given.case], time.monotonic()
        failures = [failure for number in numbers if (failure := run_case(subject, given.seed, number))]
        if given.case is not None:
            print(failures[0].detail if failures else "holds")
        print(f"{subject.name}: {len(numbers)} cases, {len(failures)} failed, {time.monotonic() - started:.0f} s")
        first = {failure.signature: failure.number for failure in reversed(failures)}
        for signature, count in Counter(f.signature for f in failures).most_common():
            print(f"  {count} × {signature} (first: --only '{subject.name}' --case {first[signature]})", flush=True)
        failed += len(failures)
    print(f"{len(chosen)} classes, {failed} cases failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
