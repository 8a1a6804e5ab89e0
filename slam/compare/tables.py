"""What follows from paired trials: as data, in CSV files, and for people in sentences and rows of tables.

The files have the same bytes however and wherever the trials were run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from slam.compare.plan import REPLAY, Plan, Variant
from slam.compare.statistics import ALPHA, Difference, Verdict, adjusted, difference, fewest
from slam.compare.sweep import Run
from slam.files import write_text
from slam.geometry.se3 import Array
from slam.run.outputs import csv_rows
from slam.run.results import COMPARED, Metric, verdict

DIFFERENCE_COLUMNS = (
    "sequence", "variant", "mode", "figure", "reference", "other", "pairs", "missing", "mean_reference", "mean_other",
    "difference", "low", "high", "p", "p_holm", "other_lower", "other_higher", "verdict",
)  # fmt: skip
RUN_COLUMNS = ("sequence", "variant", "frontend", "mode", "seed", "backend", "outcome")

#: What a verdict means that says better or worse.
STRENGTH = {
    Verdict.CERTAIN: f"certain (Holm-adjusted p ≤ {ALPHA:g})",
    Verdict.LIKELY: f"likely (p ≤ {ALPHA:g}, not after Holm's adjustment)",
    Verdict.SINGLE: "in one trial, which cannot say whether that is chance",
}

_TRIFLE = 0.01  # of the larger value: a smaller difference is no headline


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


def row(group: Group, metric: Metric) -> list[dict[str, str]]:
    """A row of a group's table: a cell for each back end, the reference first.

    A cell has texts: ``mean`` and ``sd`` of its trials; ``verdict``, ``direction`` and ``badge``, how it lies against
    the reference and how sure that is; ``difference``, ``interval``, ``p`` and ``p_holm``.
    """
    cells = []
    for backend in group.runs:
        mean, sd = group.mean_and_sd(backend, metric.key)
        known = np.isfinite(mean + sd)
        cell = {"mean": metric.show(mean), "sd": f"± {metric.show(sd, mean)}" if known else ""}
        d = group.compared.get(metric.key, {}).get(backend)
        cells.append(cell | ({"badge": "", "direction": ""} if d is None else _against(d)))
    return cells


def _against(d: Difference) -> dict[str, str]:
    """How a back end lies against the reference, in words.

    The mean difference has the digits that the wider bound of its interval needs. Of figures that should be one it is
    the ratio of the factors by which they are off.
    """
    direction = "" if d.better is None or d.verdict not in STRENGTH else "better" if d.better else "worse"
    word = d.verdict.value
    if direction and _is_trifle(d):
        word, direction = "less than 1 %", ""
    known = bool(np.isfinite(d.low))
    if d.metric.better == "one" and np.isfinite(d.mean):
        mean, *bounds = (f"{10**value:.3f}" for value in (d.mean, d.low, d.high))
        mean = f"× {mean}"
    else:
        widest = max(abs(d.low), abs(d.high)) if known else None
        mean, *bounds = (d.metric.show(value, widest) for value in (d.mean, d.low, d.high))
    p, p_holm = (shown_p(p) if d.varies else "–" for p in (d.p, d.p_holm))
    return {
        "verdict": word, "direction": direction, "badge": f"{direction}: {word}" if direction else word,
        "difference": mean, "interval": " … ".join(bounds) if known else "–", "p": p, "p_holm": p_holm,
    }  # fmt: skip


def sentences(group: Group) -> list[str]:
    """`in_short` of each back end but the first, and the runs that failed, if any."""
    first, *others = group.runs
    found = [
        in_short([group.compared[metric.key][other] for metric in group.metrics], first, other) for other in others
    ]
    if counts := [f"{n} of {group.trials} of {backend}" for backend in group.runs if (n := group.failures(backend))]:
        failed = "a trial in which either failed is no pair, and is in no other figure."
        found.append(f"Runs failed, {', '.join(counts)}: {failed}")
    return found


def in_short(differences: Sequence[Difference], reference: str, other: str) -> str:
    """Which of two back ends is better in what, in one sentence: in the main figures that can be told apart."""
    sure = (Verdict.CERTAIN, Verdict.LIKELY)
    told = [d for d in differences if d.metric.main and d.verdict in sure and not _is_trifle(d)]
    parts = []
    for better, first, second in ((True, other, reference), (False, reference, other)):
        names = [f"{d.metric.label.partition(' (')[0]} ({d.verdict.value})" for d in told if d.better is better]
        if names:
            parts.append(f"{first} is better than {second} in {', '.join(names)}")
    return f"{'; '.join(parts) or f'No difference between {reference} and {other} can be concluded'}."


def honesty(group: Group) -> list[str]:
    """Whether the covariances of each back end hold, by the means over its runs."""
    said = {}
    for backend in group.runs:
        keys = dict.fromkeys(key for run in group.runs[backend] for key in run.metrics)
        means = {key: group.mean_and_sd(backend, key)[0] for key in keys}
        said[backend] = verdict(means, group.trials - group.failures(backend))
    return [f"{backend}: {text}." for backend, text in said.items() if text]


def _is_trifle(d: Difference) -> bool:
    """Whether two means are so near that nobody would choose by them, however sure their difference is.

    Of shares such as that of tracked frames what they lack counts: 99.2 % is not equal to 100 %.
    """
    if d.metric.show(d.reference) == d.metric.show(d.other):
        return True
    limit = _TRIFLE * max(abs(d.reference), abs(d.other))
    if d.metric.better == "higher" and d.metric.unit == "%":
        limit = min(limit, 0.5 * (1 - min(d.reference, d.other)))
    return bool(abs(d.other - d.reference) < limit)


def caution(trials: int, tests: int) -> str:
    """What so many trials of a sequence can show at best; empty where nothing is tested, or one test can be certain.

    Said before the trials are run, and with the same numbers after them; `tests` is `slam.compare.tables.most_tests`.
    """
    enough = fewest(tests)
    if not tests or trials >= enough:
        return ""
    more = f"{enough} trials are enough for all figures (--trials {enough})."
    if trials == 1:
        return f"One trial cannot tell a difference from chance: a recorded sequence has no more. In worlds {more}"
    if trials < fewest(1):
        return f"With {trials} trials nothing can be certain, even where all agree. {more}"
    return f"With {trials} trials only few figures can be told apart for certain. {more}"


def measurements(mode: str, reference: str) -> str:
    """Which measurements the back ends were given, for captions."""
    if mode == REPLAY:
        return f"Replay: all back ends are given the measurements of {reference}'s closed loop"
    return "Closed loop: each back end's predictions choose its matches"


def shown_p(p: float) -> str:
    """A p-value for people; a dash where there is none."""
    if not np.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"
