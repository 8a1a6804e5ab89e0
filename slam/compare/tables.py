"""What follows from paired trials: as data, in CSV files, and for people in sentences and rows of tables.

The files have the same bytes however and wherever the trials were run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare.plan import Plan
from slam.compare.statistics import Difference, difference, mean_of, reach
from slam.compare.trial import Run
from slam.files import read_object, write_text
from slam.geometry.se3 import Array
from slam.geometry.stamps import pair
from slam.run.results import (
    COMPARED,
    DOUBTED,
    METRICS,
    RATIOS,
    Metric,
    errors_of_truth,
    number,
    verdict,
    verdict_of_run,
)
from slam.run.run_data import RunData
from slam.run.run_files import csv_number, csv_rows

DIFFERENCE_COLUMNS = (
    "sequence", "mode", "figure", "reference", "other", "pairs", "missing", "mean_reference", "mean_other",
    "difference", "low", "high", "verdict",
)  # fmt: skip
_HARDLY, _FEW = 5.0, 8  # times the scatter that no estimators differ by; trials that show less with three back ends
RUN_COLUMNS = ("sequence", "mode", "seed", "backend", "outcome")


@dataclass(frozen=True)
class Group:
    """Runs that are compared with each other: one sequence and mode."""

    sequence: str
    mode: str
    runs: dict[str, list[Run]]  # by back end, each in the order of seeds
    # each other back end against the first, by key of the figure and by back end; none with one back end
    compared: dict[str, dict[str, Difference]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What the runs share, in words."""
        return f"{self.sequence}, {self.mode}"

    @property
    def trials(self) -> int:
        """Number of trials of each back end."""
        return len(next(iter(self.runs.values())))

    @property
    def metrics(self) -> list[Metric]:
        """The figures that at least one run has; no word of doubt where there is none."""
        every = [run.metrics for runs in self.runs.values() for run in runs]
        spare = {"path_m"} if self.has_truth else set()
        known = [m for m in COMPARED if m.key not in spare and any(m.key in found for found in every)]
        return [m for m in known if m.key != DOUBTED or any(found.get(DOUBTED) for found in every)]

    @property
    def has_truth(self) -> bool:
        """Whether a true path is known."""
        return any("ate_online_m" in run.metrics for runs in self.runs.values() for run in runs)

    def values(self, backend: str, key: str) -> Array:
        """A figure by trial (N,), NaN where the run failed or has none."""
        return np.array([run.metrics.get(key, np.nan) for run in self.runs[backend]], float)

    def mean_and_sd(self, backend: str, metric: Metric) -> tuple[float, float]:
        """`mean_of` a figure and the standard deviation about it of the runs that have it; NaN where unknown."""
        values = self.values(backend, metric.key)
        values = values[np.isfinite(values)]
        mean, spare = mean_of(metric, values), len(values) - 1
        return mean, float(np.sqrt(np.square(values - mean).sum() / spare)) if spare > 0 else float("nan")

    @property
    def first_metrics(self) -> list[Metric]:
        """Of these those of the first table: the main ones, and those in which a back end is better or worse."""
        told = {key for key, each in self.compared.items() for d in each.values() if d.verdict in ("better", "worse")}
        known = {m.key for m in self.metrics}
        judged = next((key for key in RATIOS if key in known), "")
        return [m for m in self.metrics if "main" in m.shown or m.key in told or m.key == judged]

    def failures(self, backend: str) -> int:
        """Number of runs that failed."""
        return sum(not run.completed for run in self.runs[backend])


def groups(plan: Plan, runs: Sequence[Run]) -> list[Group]:
    """The runs, sorted by what they share, in the plan's order, and compared: all intervals hold together."""
    found = []
    for head in product(plan.sequences, plan.modes):
        own = [run for run in runs if (run.trial.sequence, run.trial.mode) == head]
        found.append(Group(*head, {b: [run for run in own if run.trial.backend == b] for b in plan.backends}))
    first, *others = plan.backends
    places = [(group, m, other) for group in found for m in group.metrics for other in others]
    tests = sum(bool(m.better) for _, m, _ in places)
    for group, m, other in places:
        d = difference(m, group.values(first, m.key), group.values(other, m.key), tests)
        group.compared.setdefault(m.key, {})[other] = d
    return found


def write_tables(every: Sequence[Group], runs: Sequence[Run], out: Path) -> None:
    """Write runs.csv and differences.csv; times, in which no two runs agree, are in each run's ``summary.json``."""
    lines: list[tuple[object, ...]] = [(*RUN_COLUMNS, *(metric.key for metric in COMPARED))]
    for run in runs:
        t, values = run.trial, (csv_number(run.metrics.get(metric.key, np.nan)) for metric in COMPARED)
        lines.append((t.sequence, t.mode, t.seed, t.backend, run.outcome, *values))
    write_text(out / "runs.csv", csv_rows(lines))
    lines = [DIFFERENCE_COLUMNS]
    for group in every:
        for key, compared in group.compared.items():
            for other, d in compared.items():
                head = group.sequence, group.mode, key, next(iter(group.runs)), other, d.pairs, d.missing
                lines.append((*head, *map(csv_number, (d.reference, d.other, d.mean, d.low, d.high)), d.verdict))
    write_text(out / "differences.csv", csv_rows(lines))


def row(group: Group, metric: Metric) -> list[dict[str, str]]:
    """A row of a group's table: a cell for each back end, the reference first.

    A cell has texts: ``mean`` and ``sd`` of its trials; ``verdict``, ``difference`` and ``interval``, how it lies
    against the reference. The mean difference has the digits that the wider bound of its interval needs. Of figures
    that should be one it is the ratio of the factors by which they are off.
    """
    cells = []
    for backend in group.runs:
        mean, sd = group.mean_and_sd(backend, metric)
        cell = {"mean": metric.show(mean), "sd": f"± {metric.show(sd, mean)}" if np.isfinite(mean + sd) else ""}
        cell |= {"verdict": "", "difference": "", "interval": ""}
        if (d := group.compared.get(metric.key, {}).get(backend)) is not None:
            known, numbers = bool(np.isfinite(d.low)), (d.mean, d.low, d.high)
            if metric.better == "one" and d.pairs:
                shown = [number(10.0 ** min(max(value, -99.0), 99.0)) for value in numbers]
                shown[0] = f"× {shown[0]}"
            else:
                shown = [metric.show(value, max(abs(d.low), abs(d.high)) if known else None) for value in numbers]
            interval = " … ".join(shown[1:]) if known else ""
            cell |= {"verdict": d.verdict, "difference": shown[0], "interval": interval}
        cells.append(cell)
    return cells


def heads(group: Group) -> list[str]:
    """Names of the back ends for the head of a table; the one that others are compared with is marked."""
    first, *others = group.runs
    return [f"{first} (reference)" if others else first, *others]


def sentences(group: Group) -> list[str]:
    """`in_short` of each back end but the first, or how far they are apart without truth, and the runs that failed."""
    first, *others = group.runs
    found = []
    if all(group.failures(backend) == group.trials for backend in group.runs):
        found.append("No run completed.")
    elif not group.has_truth:
        few = "Too few images have a true pose" if "truth=" in group.sequence else "No true path is known"
        found.append(f"{few} (see the option truth=FILE): nothing tells which path is better.")
        apart = ((other, distance_apart(group.runs[first], group.runs[other])) for other in others)
        found += [
            f"Final paths of {first} and {other} are {number(1e3 * d)} mm apart (RMS)." for other, d in apart if d >= 0
        ]
    else:
        judged = [other for other in others if group.trials not in (group.failures(first), group.failures(other))]
        found = [in_short([group.compared[m.key][other] for m in group.metrics], first, other) for other in judged]
    if line := truth_line(group):
        found.append(line)
    if counts := [f"{n} of {group.trials} of {backend}" for backend in group.runs if (n := group.failures(backend))]:
        failed = "a trial in which either failed is no pair, and is in no other figure."
        found.append(f"Runs failed, {', '.join(counts)}: {failed}")
    return found


def distance_apart(reference: Sequence[Run], other: Sequence[Run]) -> float:
    """RMS distance [m] between the final paths of two back ends, which begin together; NaN where there are none."""
    squares: list[float] = []
    for runs in zip(reference, other):
        if all(run.trusted for run in runs):
            paths = [RunData.read(run.folder, "").final for run in runs]
            rows = pair(paths[0].stamps, paths[1].stamps, 1e-6)
            between = (paths[0].positions - paths[1].positions[rows])[rows >= 0]
            squares += np.sum(between**2, axis=1).tolist()
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def in_short(differences: Sequence[Difference], reference: str, other: str) -> str:
    """Which of two back ends is better in what, in one sentence: in all figures that can be told apart."""
    parts = []
    for word, first, second in (("better", other, reference), ("worse", reference, other)):
        judged = [d.metric.label for d in differences if d.verdict == word]
        names = list(dict.fromkeys(label.partition(" (")[0] for label in judged))
        if names:
            parts.append(f"{first} is better than {second} in {', '.join(names)}")
    return f"{'; '.join(parts) or f'No difference between {reference} and {other} can be concluded'}."


def honesty(group: Group) -> list[str]:
    """Whether the covariances of each back end hold, by the means over its runs; where that is open, why."""
    said = {}
    for backend in group.runs:
        known = {key for run in group.runs[backend] for key in run.metrics}
        means = {m.key: group.mean_and_sd(backend, m)[0] for m in METRICS if m.key in known}
        said[backend] = verdict(means, group.trials - group.failures(backend))
        if not said[backend] and (summary := _summary(group.runs[backend])):
            said[backend] = verdict_of_run(summary)
    return [f"{backend}: {text}." for backend, text in said.items() if text]


def truth_line(group: Group) -> str:
    """Which frames of the first run have a true pose, and which errors of its own; empty where none has."""
    summary = next(filter(None, map(_summary, group.runs.values())), {})
    errors, known = errors_of_truth(summary), (summary.get("accuracy") or {}).get("online", {}).get("poses with truth")
    if not errors or known is None:
        return ""
    return f"{known:.0f} of {summary['frames']} frames have a true pose; its own errors that are counted: {errors}."


def _summary(runs: Sequence[Run]) -> dict[str, Any]:
    """What the first run that came to its end says; empty where none did."""
    run = next((run for run in runs if run.completed and (run.folder / "summary.json").is_file()), None)
    return {} if run is None else read_object(run.folder / "summary.json")


def caution(plan: Plan, trials: int) -> str:
    """What so many trials of a sequence can show at best; empty where nothing is compared."""
    tests = len(plan.sequences) * len(plan.modes) * (len(plan.backends) - 1) * sum(bool(m.better) for m in COMPARED)
    if not tests:
        return ""
    if trials == 1:
        return "One trial cannot tell a difference from chance; a recorded sequence has no more, worlds have --trials."
    if (least := reach(trials, tests)) > _HARDLY:
        return f"{trials} trials can hardly show any difference; take --trials {_FEW} or more."
    return f"With {trials} trials differences below {least:.2g} times their scatter from trial to trial may be chance."
