"""What follows from paired trials, for people: in sentences, and in rows of tables on the terminal and in reports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from slam.compare.plan import REPLAY
from slam.compare.statistics import ALPHA, Difference, Verdict, fewest
from slam.compare.tables import Group, mean_and_sd
from slam.run.results import COMPLETED, Metric, verdict

#: What a verdict means that says better or worse.
STRENGTH = {
    Verdict.CERTAIN: f"certain (Holm-adjusted p ≤ {ALPHA:g})",
    Verdict.LIKELY: f"likely (p ≤ {ALPHA:g}, not after Holm's adjustment)",
    Verdict.SINGLE: "in one trial, which cannot say whether that is chance",
}

_TRIFLE = 0.01  # of the larger value: a smaller difference is no headline


def row(group: Group, metric: Metric) -> tuple[str, list[dict[str, Any]]]:
    """A row of a group's table: its label, and a cell for each back end, the reference first.

    A cell has texts: ``mean`` and ``sd`` of its trials; ``verdict``, ``direction`` and ``badge``, how it lies against
    the reference and how sure that is; ``difference``, ``interval``, ``p`` and ``p_holm``. ``failed`` counts runs.
    """
    cells: list[dict[str, Any]] = []
    for backend in group.runs:
        d = group.differences(metric).get(backend)
        if metric is COMPLETED:
            failed = group.failures(backend)
            cell = {"mean": f"{group.trials - failed} of {group.trials}", "sd": "", "failed": failed}
        else:
            mean, sd = (metric.scale * value for value in mean_and_sd(group.finite(backend, metric.key)))
            known = np.isfinite(mean + sd)
            cell = {"mean": shown(mean), "sd": f"± {shown(sd, mean)}" if known else "", "failed": 0}
        cells.append(cell | ({"badge": "", "direction": ""} if d is None else _against(d)))
    return metric.label if metric is COMPLETED else metric.title, cells


def _against(d: Difference) -> dict[str, Any]:
    """How a back end lies against the reference, in words."""
    direction = "" if d.better is None or d.verdict not in STRENGTH else "better" if d.better else "worse"
    word = d.verdict.value
    if direction and _is_trifle(d):
        word, direction = "less than 1 %", ""
    badge = f"{direction}: {word}" if direction else word
    p, p_holm = (shown_p(p) if d.varies else "–" for p in (d.p, d.p_holm))
    difference, interval = _difference(d)
    return {
        "verdict": word, "direction": direction, "badge": badge, "difference": difference, "interval": interval,
        "p": p, "p_holm": p_holm,
    }  # fmt: skip


def sentences(group: Group) -> list[str]:
    """`in_short` of each back end but the reference."""
    first, *others = group.runs
    return [in_short([group.differences(metric)[other] for metric in group.metrics], first, other) for other in others]


def in_short(differences: Sequence[Difference], reference: str, other: str) -> str:
    """Which of two back ends is better in what, in one sentence: in the main figures that can be told apart."""
    sure = (Verdict.CERTAIN, Verdict.LIKELY)
    told = [d for d in differences if d.metric.main and d.verdict in sure and not _is_trifle(d)]
    parts = []
    for better, first, second in ((True, other, reference), (False, reference, other)):
        if names := [f"{_name(d.metric)} ({d.verdict.value})" for d in told if d.better is better]:
            parts.append(f"{first} is better than {second} in {', '.join(names)}")
    return f"{'; '.join(parts) or f'No difference between {reference} and {other} can be concluded'}."


def failed(group: Group) -> str:
    """Which runs failed; empty where none did."""
    counts = [f"{n} of {group.trials} of {backend}" for backend in group.runs if (n := group.failures(backend))]
    text = f"Runs failed, {', '.join(counts)}: a trial in which either failed is no pair, and is in no other figure."
    return text if counts else ""


def honesty(group: Group) -> list[str]:
    """Whether the covariances of each back end hold, by the means over its runs."""
    said = {}
    for backend in group.runs:
        keys = dict.fromkeys(key for run in group.runs[backend] for key in run.metrics)
        means = {key: mean_and_sd(group.finite(backend, key))[0] for key in keys}
        said[backend] = verdict(means, group.trials - group.failures(backend))
    return [f"{backend}: {text}." for backend, text in said.items() if text]


def _is_trifle(d: Difference) -> bool:
    """Whether two means are so near that nobody would choose by them, however sure their difference is.

    Of shares such as that of tracked frames what they lack counts: 99.2 % is not equal to 100 %.
    """
    if shown(d.metric.scale * d.reference) == shown(d.metric.scale * d.other):
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


# ------------------------------------------------------------------------------------------- numbers for people


def shown(value: float, like: float | None = None) -> str:
    """A number with the digits that show three of `like`, or of itself, six behind the point at most; else a dash."""
    if not np.isfinite(value):
        return "–"
    like = abs(value if like is None else like)
    digits = min(6, max(0, 2 - int(np.floor(np.log10(like))))) if like else 0
    return f"{value:.{digits}f}".replace("-", "−")


def _difference(d: Difference) -> tuple[str, str]:
    """The mean difference and its interval, with the digits that the wider bound needs; a dash for none.

    Of figures that should be one it is the ratio of the factors by which they are off.
    """
    bounds = (d.low, d.high) if np.isfinite(d.low) else ()
    if d.metric.better == "one" and np.isfinite(d.mean):
        return f"× {10**d.mean:.3f}", " … ".join(f"{10**bound:.3f}" for bound in bounds) or "–"
    widest = max((d.metric.scale * abs(bound) for bound in bounds), default=None)
    mean = shown(d.metric.scale * d.mean, widest) if bounds else d.metric.show(d.mean)
    return mean, " … ".join(shown(d.metric.scale * bound, widest) for bound in bounds) or "–"


def shown_p(p: float) -> str:
    """A p-value for people; a dash where there is none."""
    if not np.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def _name(metric: Metric) -> str:
    """A label that can stand in a list."""
    return metric.label.replace(", ", " ").partition(" (")[0]
