"""``python -m tests.fuzz``: many cases of every class, with counts, and the failures by kind."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections import Counter

from tests.fuzz.catalogue import SUBJECTS
from tests.fuzz.harness import Failure, Subject, run_case, warm_up


def main() -> int:
    """Exit status 1 where a case failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=200, help="of each class (default %(default)s)")
    parser.add_argument("--minutes", type=float, help="for all classes together, in place of --cases")
    parser.add_argument("--only", default="", help="classes by name, with commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="one case by its number, with its traceback")
    arguments = parser.parse_args()
    logging.getLogger("slam").addHandler(logging.NullHandler())
    logging.getLogger("slam").propagate = False
    names = [name for name in arguments.only.split(",") if name]
    unknown = set(names) - {s.name for s in SUBJECTS}
    if unknown:
        parser.error(f"unknown class {min(unknown)}; known: {', '.join(s.name for s in SUBJECTS)}")
    chosen = [s for s in SUBJECTS if not names or s.name in names]
    warm_up()
    if arguments.case is not None:
        failures = [run_case(s, arguments.seed, arguments.case) for s in chosen]
        print("\n".join(f.detail for f in failures if f) or "holds")
        return int(any(failures))
    share = None if arguments.minutes is None else 60 * arguments.minutes / len(chosen)
    failed = [_run(s, arguments.seed, arguments.cases, share) for s in chosen]
    print(f"{len(chosen)} classes, {sum(failed)} cases failed")
    return int(any(failed))


def _run(subject: Subject, seed: int, cases: int, seconds: float | None) -> int:
    """Cases of one class, by number or for a time; how many failed."""
    started = time.monotonic()
    failures: list[Failure] = []
    number = 0
    while number < cases if seconds is None else time.monotonic() - started < seconds:
        failure = run_case(subject, seed, number)
        number += 1
        if failure is not None:
            failures.append(failure)
    print(f"{subject.name}: {number} cases, {len(failures)} failed, {time.monotonic() - started:.0f} s", flush=True)
    kinds = Counter(f.signature for f in failures)
    for signature, count in kinds.most_common():
        first = next(f.number for f in failures if f.signature == signature)
        print(f"  {count} × {signature} (first: --only {subject.name} --case {first})", flush=True)
    return len(failures)


if __name__ == "__main__":
    sys.exit(main())
