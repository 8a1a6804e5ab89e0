"""What follows from paired trials in plain words: what may be concluded, how sure that is, and what cannot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.compare.measure import COMPLETED
from slam.compare.statistics import FEWEST, LEVEL, Difference, Verdict

_STRENGTH = {
    Verdict.CERTAIN: f"certain at the level of {round(100 * LEVEL)} %",
    Verdict.LIKELY: "likely, not certain",
    Verdict.HINT: "a hint, no more",
    Verdict.SINGLE: "in one trial, which cannot say whether that is chance",
}
_VERB = {Verdict.CERTAIN: "is", Verdict.LIKELY: "seems", Verdict.HINT: "seems", Verdict.SINGLE: "was"}


def headline(differences: Sequence[Difference], reference: str, other: str) -> str:
    """One line on two back ends: who is better in what, by how much and how surely, and what remains open."""
    parts = []
    for verdict, strength in _STRENGTH.items():
        for winner, wins in ((other, True), (reference, False)):
            own = [d for d in differences if d.verdict is verdict and d.better is wins]
            if own:
                parts.append(f"{winner} {_VERB[verdict]} better in {_listed([_brief(d) for d in own])}: {strength}.")
    rest = [_name(d) for d in differences if d.verdict in (Verdict.OPEN, Verdict.EQUAL)]
    if rest:
        parts.append(f"No difference can be concluded in {_listed(rest)}.")
    missing = [_name(d) for d in differences if d.verdict is Verdict.NONE]
    if missing:
        parts.append(f"Nothing to compare in {_listed(missing)}.")
    return " ".join(parts)


def sentence(d: Difference, reference: str, other: str) -> str:
    """What may be said of a difference, in plain words, in the unit in which the figure is shown."""
    label, unit = d.metric.label, d.metric.unit and f" {d.metric.unit}"
    if d.verdict is Verdict.NONE:
        return f"{label}: nothing to compare, no trial in which both {reference} and {other} have it."
    trials = "one trial" if d.pairs == 1 else f"{d.pairs} trials"
    first, second = (other, reference) if d.better else (reference, other)
    values = {reference: d.metric.show(d.reference), other: d.metric.show(d.other)}
    against = f"{values[first]} against {values[second]}{unit}"
    if d.verdict is Verdict.EQUAL:
        return f"{label}: equal in {trials}, {values[reference]}{unit}."
    if d.better is None:
        return f"{label}: {reference} {values[reference]}, {other} {values[other]}{unit}, mean of {trials}."
    if d.verdict is Verdict.SINGLE:
        return f"{label}: {first} was better, {against}, {_STRENGTH[d.verdict]}."
    if d.verdict is Verdict.OPEN:
        nothing = "one" if d.metric.better == "one" else "zero"
        return (
            f"{label}: no difference can be concluded, {first} {against}, mean of {trials}; {_interval(d)} holds "
            f"{nothing}."
        )
    how = f"{against}{_share(d)}, in {d.wins} of {trials}; {_interval(d)}, p = {d.p:.2g}"
    return f"{label}: {first} {_VERB[d.verdict]} better than {second}, {how}: {_STRENGTH[d.verdict]}."


def failures(runs: dict[str, int], trials: int) -> str:
    """Which back ends failed how often; empty where none did."""
    counts = [f"{n} of {trials} of {name}" for name, n in runs.items() if n]
    if not counts:
        return ""
    return (
        f"Runs failed, {', '.join(counts)}: a trial in which either failed is no pair, and the other figures speak of "
        "the pairs alone."
    )


def caution(trials: int) -> str:
    """What so many trials can show at best; empty where they are enough to be certain of something."""
    if trials >= FEWEST:
        return ""
    if trials == 1:
        return (
            "One trial cannot tell a difference from chance: synthetic worlds have as many as are asked for (--trials, "
            f"{FEWEST} or more), a recorded sequence has one."
        )
    return (
        f"With {trials} trials nothing can be certain: even where all agree, chance alone does as much in "
        f"{100 * 2 / 2**trials:.2g} % of such comparisons. It takes {FEWEST} or more (--trials)."
    )


def shown_mean(d: Difference) -> str:
    """The mean difference for people; of figures that should be one, the ratio of the factors by which they are off."""
    return f"× {10**d.mean:.3f}" if d.metric.better == "one" and np.isfinite(d.mean) else d.metric.show(d.mean)


def shown_interval(d: Difference, between: str = " … ") -> str:
    """The bounds of its interval, with as many digits as the larger one needs; a dash where there is none."""
    if not np.isfinite(d.low):
        return "–"
    if d.metric.better == "one":
        return f"{10**d.low:.3f}{between}{10**d.high:.3f}"
    low, high = d.metric.scale * d.low, d.metric.scale * d.high
    largest = max(abs(low), abs(high))
    digits = max(0, 2 - int(np.floor(np.log10(largest)))) if largest > 0 else 0
    return f"{low:.{digits}f}{between}{high:.{digits}f}".replace("-", "−")


def _interval(d: Difference) -> str:
    what = f"{round(100 * LEVEL)} % interval"
    if d.metric.better == "one":
        what += " of the ratio of the factors by which they are off"
    return f"{what} {shown_interval(d, ' to ')}{d.metric.unit and f' {d.metric.unit}'}"


def _name(d: Difference) -> str:
    """A label that can stand in a list."""
    return d.metric.label.replace(", ", " ").removesuffix(" (1 is honest)")


def _brief(d: Difference) -> str:
    return f"{_name(d)}{_share(d)}"


def _share(d: Difference) -> str:
    """By how much of the worse one the better one is lower."""
    return f" ({100 * abs(d.mean) / max(d.reference, d.other):.2g} % less)" if d.metric.better == "lower" else ""


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def worth_saying(d: Difference) -> bool:
    """Whether a summary speaks of it: not of runs that all came to their end."""
    return d.metric.main and not (d.metric is COMPLETED and d.verdict is Verdict.EQUAL)
