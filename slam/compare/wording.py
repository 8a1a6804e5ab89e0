"""What follows from paired trials in plain words: what may be concluded, how sure that is, and what cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.compare.plan import REPLAY
from slam.compare.statistics import ALPHA, Difference, Verdict, certain_of, fewest
from slam.compare.tables import Group, mean_and_sd
from slam.run.results import number, verdict

#: What a verdict means that says better or worse.
STRENGTH = {
    Verdict.CERTAIN: f"certain (Holm-adjusted p ≤ {ALPHA:g})",
    Verdict.LIKELY: f"likely (p ≤ {ALPHA:g}, not after Holm's adjustment)",
    Verdict.SINGLE: "in one trial, which cannot say whether that is chance",
}
_WORDS = {Verdict.SINGLE: "one trial", Verdict.NONE: "no pair", Verdict.UNTESTED: ""}

_TRIFLE = 0.01  # of the larger value: a smaller difference is no headline
_FACTOR = 3.0  # between two means, from which on it is said as a factor


@dataclass(frozen=True)
class Line:
    """A line of a headline."""

    text: str  # who, and which figures; the badge says the rest
    direction: str  # "better" or "worse", of the other back end against the reference; empty where neither
    verdict: Verdict  # how sure that is

    @property
    def badge(self) -> str:
        """Direction and strength in two words."""
        return badge(self.verdict, self.direction)


@dataclass(frozen=True)
class Conclusions:
    """What can be said of a group, in the report and on the terminal."""

    name: str  # of the group
    verdict: list[str]  # which back end is better in what, a sentence for each but the reference
    failed: str  # which runs failed; empty where none did
    headlines: list[Line]  # what is certain and likely, and which main figures are open
    honesty: list[str]  # one per back end, on its covariances


def conclusions(group: Group) -> Conclusions:
    """What can be said of a group."""
    first, *others = group.runs
    own = {other: [group.differences(metric)[other] for metric in group.metrics] for other in others}
    counts = [f"{n} of {group.trials} of {b}" for b in group.runs if (n := group.failures(b))]
    failed = (
        f"Runs failed, {', '.join(counts)}: a trial in which either failed is no pair, and the other figures speak of "
        "the pairs alone."
    )
    means = {b: {m.key: mean_and_sd(group.finite(b, m.key))[0] for m in group.metrics} for b in group.runs}
    honesty = {b: verdict(means[b], group.trials - group.failures(b)) for b in group.runs}
    variant = "" if group.variant.name == "surf" else f", {group.variant.name}"
    return Conclusions(
        f"{group.sequence}{variant}, {group.mode}",
        [in_short(differences, first, other) for other, differences in own.items()],
        failed if counts else "",
        [line for other, differences in own.items() for line in _headlines(differences, other)],
        [f"{backend}: {text}." for backend, text in honesty.items() if text],
    )


def badge(sure: Verdict, direction: str) -> str:
    """A verdict in two words: direction and strength."""
    word = _WORDS.get(sure, sure.value)
    return f"{direction}: {word}" if direction else word


def direction(d: Difference) -> str:
    """Whether the other back end is better or worse, as a badge says it; empty where nothing can be said."""
    if d.better is None or d.verdict not in STRENGTH:
        return ""
    return "better" if d.better else "worse"


def _headlines(differences: Sequence[Difference], other: str) -> list[Line]:
    """What the other back end does better and worse than the reference, the surest first, and what remains open.

    All that is certain or likely is named, in both directions; of the rest the main figures, but for those
    that are perfect in every run.
    """
    lines = []
    tested = [d for d in differences if direction(d) and (d.metric.main or d.verdict is not Verdict.SINGLE)]
    for sure in STRENGTH:
        for way in ("better", "worse"):
            if own := [d for d in tested if (d.verdict, direction(d)) == (sure, way) and not is_trifle(d)]:
                lines.append(Line(f"{other}: {'; '.join(map(_brief, own))}", way, sure))
    if trifles := [_name(d) for d in tested if is_trifle(d)]:
        lines.append(Line(f"{other}: less than {100 * _TRIFLE:g} % apart: {', '.join(trifles)}", "", Verdict.EQUAL))
    perfect = [d.metric.better == "higher" and d.reference == 1 and d.verdict is Verdict.EQUAL for d in differences]
    rest = [d for d, ideal in zip(differences, perfect) if d.metric.main and not ideal]
    for kept, of in ((Verdict.OPEN, (Verdict.OPEN, Verdict.EQUAL)), (Verdict.NONE, (Verdict.NONE,))):
        if names := [_name(d) for d in rest if d.verdict in of]:
            lines.append(Line(f"{other}: {', '.join(names)}", "", kept))
    return lines or [Line(f"{other}: errors (the true path is not known)", "", Verdict.NONE)]


def in_short(differences: Sequence[Difference], reference: str, other: str) -> str:
    """Which of two back ends is better in what, in one sentence: in the main figures that can be told apart."""
    sure = (Verdict.CERTAIN, Verdict.LIKELY)
    told = [d for d in differences if d.metric.main and d.verdict in sure and not is_trifle(d)]
    parts = []
    for better, first, second in ((True, other, reference), (False, reference, other)):
        if names := [f"{_name(d)} ({d.verdict.value})" for d in told if d.better is better]:
            parts.append(f"{first} is better than {second} in {', '.join(names)}")
    return f"{'; '.join(parts) or f'No difference between {reference} and {other} can be concluded'}."


def is_trifle(d: Difference) -> bool:
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
    """What so many trials can show at best; empty where nothing is tested, or one of so many tests can be certain.

    Said before the trials are run, and with the same numbers after them.

    Args:
        trials: of the sequence that has most.
        tests: that the plan can come to, see `slam.compare.tables.most_tests`.
    """
    enough = fewest(tests)
    if not tests or trials >= enough:
        return ""
    more = f"{enough} trials are enough for all figures (--trials {enough})."
    if trials == 1:
        return (
            "One trial cannot tell a difference from chance: a recorded sequence has one, synthetic worlds have as "
            f"many as are asked for. {more}"
        )
    if trials < fewest(1):
        chance = f"chance alone does as much in {200 / 2**trials:.2g} % of such comparisons"
        return f"With {trials} trials nothing can be certain: even where all agree, {chance}. {more}"
    few = certain_of(trials)
    at_most = "a single figure is" if few == 1 else f"up to {few} figures are"
    return f"With {trials} trials a difference that has the same sign in all is certain where {at_most} tested. {more}"


def measurements(mode: str, reference: str) -> str:
    """Which measurements the back ends were given, for captions."""
    if mode == REPLAY:
        return f"Replay: all back ends are given the measurements of {reference}'s closed loop"
    return "Closed loop: each back end steers its own data association"


# ------------------------------------------------------------------------------------------- numbers for people


def shown(value: float, like: float | None = None) -> str:
    """A number with the digits that show three of `like`, or of itself, six behind the point at most; else a dash."""
    if not np.isfinite(value):
        return "–"
    like = abs(value if like is None else like)
    digits = min(6, max(0, 2 - int(np.floor(np.log10(like))))) if like else 0
    return f"{value:.{digits}f}".replace("-", "−")


def shown_difference(d: Difference) -> tuple[str, str]:
    """The mean difference and its interval for people, with the digits that the wider bound needs; a dash for none.

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


def _name(d: Difference) -> str:
    """A label that can stand in a list."""
    return d.metric.label.replace(", ", " ").partition(" (")[0]


def _brief(d: Difference) -> str:
    """The figure from the reference's value to the other's, and the change: a factor where percentages are enormous."""
    values = [shown(d.metric.scale * value) for value in (d.reference, d.other)]
    text = f"{_name(d)} {' → '.join(values)}{d.metric.unit and f' {d.metric.unit}'}"
    small, large = sorted((d.reference, d.other))
    if d.metric.better != "lower" or d.reference <= 0:
        return text
    if small > 0 and large / small >= _FACTOR:
        return f"{text} ({number(large / small)} times as {'much' if d.other > d.reference else 'little'})"
    return f"{text} ({100 * (d.other / d.reference - 1):+.2g} %)".replace("(-", "(−")
