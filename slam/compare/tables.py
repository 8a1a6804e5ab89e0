"""The tables of a comparison as data, and as CSV files: the same bytes however and wherever the trials were run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from slam.compare.plan import Plan, Variant
from slam.compare.statistics import Difference, adjusted, difference
from slam.compare.sweep import Run
from slam.files import write_text
from slam.geometry.se3 import Array
from slam.run.outputs import csv_rows
from slam.run.results import COMPARED, Metric

DIFFERENCE_COLUMNS = (
    "sequence", "variant", "mode", "figure", "reference", "other", "pairs", "missing", "mean_reference", "mean_other",
    "difference", "low", "high", "p", "p_holm", "other_lower", "other_higher", "verdict",
)  # fmt: skip
RUN_COLUMNS = ("sequence", "variant", "frontend", "mode", "seed", "backend", "outcome")


@dataclass(frozen=True)
class Group:
    """Runs that are compared with each other: one sequence, variant and mode."""

    sequence: str
    variant: Variant
    mode: str
    runs: dict[str, list[Run]]  # by back end, each in the order of seeds
    # each other back end against the first, by key of the figure and by back end; p adjusted over all figures of all
    # groups; none with one back end
    compared: dict[str, dict[str, Difference]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What the runs share, in words."""
        variant = "" if self.variant.name == "surf" else f", {self.variant.name}"
        return f"{self.sequence}{variant}, {self.mode}"

    @property
    def trials(self) -> int:
        """Number of trials of each back end."""
        return len(next(iter(self.runs.values())))

    @property
    def metrics(self) -> list[Metric]:
        """The figures that at least one run has."""
        keys = {key for runs in self.runs.values() for run in runs for key in run.metrics}
        return [metric for metric in COMPARED if metric.key in keys]

    def values(self, backend: str, key: str) -> Array:
        """A figure by trial (N,), NaN where the run failed or has none."""
        return np.array([run.metrics.get(key, np.nan) for run in self.runs[backend]], float)

    def mean_and_sd(self, backend: str, key: str) -> tuple[float, float]:
        """Mean and standard deviation of a figure over the runs that have it; NaN where unknown."""
        values = self.values(backend, key)
        values = values[np.isfinite(values)]
        mean = float(values.mean()) if len(values) else float("nan")
        return mean, float(values.std(ddof=1)) if len(values) > 1 else float("nan")

    def failures(self, backend: str) -> int:
        """Number of runs that failed."""
        return sum(not run.completed for run in self.runs[backend])


def groups(plan: Plan, runs: Sequence[Run]) -> list[Group]:
    """The runs, sorted by what they share, in the plan's order, and compared: the tests of all are one family."""
    found = []
    for head in product(plan.sequences, plan.variants, plan.modes):
        own = [run for run in runs if (run.trial.sequence, run.trial.variant, run.trial.mode) == head]
        found.append(Group(*head, {b: [run for run in own if run.trial.backend == b] for b in plan.backends}))
    places = [(group, m, other) for group in found for m in group.metrics for other in plan.backends[1:]]
    alone = [difference(m, group.values(plan.backends[0], m.key), group.values(b, m.key)) for group, m, b in places]
    for (group, m, other), d in zip(places, adjusted(alone)):
        group.compared.setdefault(m.key, {})[other] = d
    return found


def count_tests(every: Sequence[Group]) -> int:
    """Tests that p is adjusted for; with one trial of everything, as many as there would be with more."""
    found = [d for group in every for by_name in group.compared.values() for d in by_name.values()]
    return sum(d.varies for d in found) or sum(d.better is not None for d in found)


def most_tests(plan: Plan) -> int:
    """Tests of a plan if all figures that have a better are known, and vary: its trials should be enough for them."""
    figures = sum(bool(metric.better) for metric in COMPARED)
    return len(plan.sequences) * len(plan.variants) * len(plan.modes) * (len(plan.backends) - 1) * figures


def write_tables(every: Sequence[Group], runs: Sequence[Run], out: Path) -> None:
    """Write runs.csv and differences.csv; times, in which no two runs agree, are in each run's ``summary.json``."""
    lines: list[tuple[object, ...]] = [(*RUN_COLUMNS, *(metric.key for metric in COMPARED))]
    for run in runs:
        t, values = run.trial, (_number(run.metrics.get(metric.key, np.nan)) for metric in COMPARED)
        lines.append((t.sequence, t.variant.name, t.variant.frontend, t.mode, t.seed, t.backend, run.outcome, *values))
    write_text(out / "runs.csv", csv_rows(lines))
    lines = [DIFFERENCE_COLUMNS]
    for group in every:
        for key, compared in group.compared.items():
            for other, d in compared.items():
                head = group.sequence, group.variant.name, group.mode, key, next(iter(group.runs)), other
                numbers = map(_number, (d.reference, d.other, d.mean, d.low, d.high, d.p, d.p_holm))
                lines.append((*head, d.pairs, d.missing, *numbers, d.lower, d.higher, d.verdict.value))
    write_text(out / "differences.csv", csv_rows(lines))


def _number(value: float) -> str:
    """A number for a CSV cell; empty where there is none."""
    return f"{value:.9g}" if np.isfinite(value) else ""
