"""What follows from paired trials, for people: in sentences, and in rows of tables on the terminal and in reports."""

from __future__ import annotations

import numpy as np

from slam.compare.plan import REPLAY
from slam.compare.statistics import ALPHA, Difference, Verdict, fewest
from slam.compare.tables import Group
from slam.run.results import Metric, verdict

#: What a verdict means that says better or worse.
STRENGTH = {
    Verdict.CERTAIN: f"certain (Holm-adjusted p ≤ {ALPHA:g})",
    Verdict.LIKELY: f"likely (p ≤ {ALPHA:g}, not after Holm's adjustment)",
    Verdict.SINGLE: "in one trial, which cannot say whether that is chance",
}

_TRIFLE = 0.01  # of the larger value: a smaller difference is no headline


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
    """Which back end is better than the first in what, a sentence for each other one.

    Said is what can be told apart, of the main figures. Then come the runs that failed, if any.
    """
    reference, *others = group.runs
    sure, found = (Verdict.CERTAIN, Verdict.LIKELY), []
    for other in others:
        every = [group.compared[metric.key][other] for metric in group.metrics if metric.main]
        told = [d for d in every if d.verdict in sure and not _is_trifle(d)]
        parts = []
        for better, first, second in ((True, other, reference), (False, reference, other)):
            names = [f"{d.metric.label.partition(' (')[0]} ({d.verdict.value})" for d in told if d.better is better]
            if names:
                parts.append(f"{first} is better than {second} in {', '.join(names)}")
        found.append(f"{'; '.join(parts) or f'No difference between {reference} and {other} can be concluded'}.")
    if counts := [f"{n} of {group.trials} of {backend}" for backend in group.runs if (n := group.failures(backend))]:
        failed = "a trial in which either failed is no pair, and is in no other figure."
        found.append(f"Runs failed, {', '.join(counts)}: {failed}")
    return found


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
