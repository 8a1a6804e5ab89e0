"""How much faster a comparison is with more workers: wall time of the same sweep of short trials, and their ratio.

    python benchmarks/compare.py [--trials N] [--workers N] [--rounds N]

Needs a quiet machine with as many free cores as workers: other work changes the ratio in either direction. The CPU time
of the workers, which is printed as well, says how much was wanted: equal for both, but for the start of the workers.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slam.compare.plan import SIMULATED, Plan, Variant
from slam.compare.scheduler import LocalScheduler
from slam.compare.sweep import check, sweep
from slam.compare.tables import write_tables


def seconds(plan: Plan, workers: int) -> tuple[float, float, bytes]:
    """Wall time and the workers' CPU time [s] of the sweep, start of the workers included, and its table of runs."""
    with TemporaryDirectory() as folder:
        out = Path(folder)
        began, used = time.perf_counter(), children()
        runs = sweep(plan, out, LocalScheduler(workers))
        elapsed = time.perf_counter() - began
        write_tables(plan, runs, out)
        return elapsed, children() - used, (out / "runs.csv").read_bytes()


def children() -> float:
    """CPU time [s] of processes that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--frames", type=int, default=120, help="of a trial; starting a worker takes about two seconds")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    world = f"synthetic:aisle?frames={arguments.frames}"
    plan = Plan((world,), ("ekf",), (Variant(SIMULATED, SIMULATED),), arguments.trials, replay=False)
    check(plan)  # loads the packages, for both alike
    seconds(replace(plan, trials=1), 1)  # compiles what is not in the cache
    times: dict[int, list[float]] = {1: [], arguments.workers: []}
    tables = set()
    for _ in range(arguments.rounds):
        for workers, own in times.items():
            elapsed, used, table = seconds(plan, workers)
            own.append(elapsed)
            tables.add(table)
            print(f"{workers} workers: {elapsed:.1f} s, CPU {used:.1f} s", flush=True)
    ratio = min(times[1]) / min(times[arguments.workers])
    same = "equal" if len(tables) == 1 else "NOT equal"
    print(f"{arguments.workers} workers are {ratio:.2f} times one; the tables are {same}")
    return 0 if len(tables) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
