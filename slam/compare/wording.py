"""What follows from paired trials in plain words: what may be concluded, how sure that is, and what cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.compare.plan import REPLAY
from slam.compare.statistics import ALPHA, FEWEST, HINT_ALPHA, LEVEL, Difference, Verdict, fewest
from slam.evaluation.metrics import chi_square_band
from slam.run.results import Metric

#: A verdict as a badge has it, in the report and on the terminal.
WORDS = {
    Verdict.CERTAIN: "certain", Verdict.LIKELY: "likely", Verdict.HINT: "a hint", Verdict.OPEN: "open",
    Verdict.EQUAL: "equal", Verdict.SINGLE: "one trial", Verdict.NONE: "no pair", Verdict.UNTESTED: "",
}  # fmt: skip

#: What a badge means.
STRENGTH = {
    Verdict.CERTAIN: f"certain (Holm-adjusted p ≤ {ALPHA:g})",
    Verdict.LIKELY: f"likely (p ≤ {ALPHA:g}, not after Holm's adjustment)",
    Verdict.HINT: f"a hint (p ≤ {HINT_ALPHA:g})",
    Verdict.SINGLE: "in one trial, which cannot say whether that is chance",
}

_TRIFLE = 0.01  # of the larger value: a smaller difference is no headline
_MISSING = 0.5  # of what the smaller of two shares lacks: with a larger difference, nearly all is not as good as all
_FACTOR = 3.0  # between two means, from which on it is said as a factor

#: Figures that say whether covariances hold, the best first: drift does not add up over stretches.
_HONESTY = {
    "nees_10m_per_dof": "over 10 m of path", "nees_1m_per_dof": "over 1 m of path", "nees_per_dof": "from the start",
}  # fmt: skip


@dataclass(frozen=True)
class Line:
    """A line of a headline.

    Attributes:
        text: who, and which figures; the badge says the rest.
        direction: "better" or "worse", of the other back end against the reference; empty where neither.
        verdict: how sure that is.
    """

    text: str
    direction: str
    verdict: Verdict

    @property
    def badge(self) -> str:
        """Direction and strength."""
        return badge(self.verdict, self.direction)


def badge(verdict: Verdict, direction: str) -> str:
    """A verdict in two words: direction and strength."""
    return f"{direction}: {WORDS[verdict]}" if direction else WORDS[verdict]


def direction(d: Difference) -> str:
    """Whether the other back end is better or worse, as a badge says it; empty where nothing can be said."""
    if d.better is None or d.verdict not in STRENGTH:
        return ""
    return "better" if d.better else "worse"


def headline(differences: Sequence[Difference], other: str) -> list[Line]:
    """What the other back end does better and worse than the reference, the surest first, and what remains open.

    All that is certain, likely, or a hint is named, in both directions; of the rest the main figures.
    """
    lines = []
    tested = [d for d in differences if direction(d) and (d.metric.main or d.verdict is not Verdict.SINGLE)]
    for verdict in STRENGTH:
        for way in ("better", "worse"):
            own = [d for d in tested if d.verdict is verdict and direction(d) == way and not is_trifle(d)]
            if own:
                lines.append(Line(f"{other}: {'; '.join(map(_brief, own))}", way, verdict))
    if trifles := [_name(d.metric) for d in tested if is_trifle(d)]:
        lines.append(Line(f"{other}: less than {100 * _TRIFLE:g} % apart: {', '.join(trifles)}", "", Verdict.EQUAL))
    rest = [d for d in differences if worth_saying(d)]
    for verdict, of in ((Verdict.OPEN, (Verdict.OPEN, Verdict.EQUAL)), (Verdict.NONE, (Verdict.NONE,))):
        if names := [_name(d.metric) for d in rest if d.verdict in of]:
            lines.append(Line(f"{other}: {', '.join(names)}", "", verdict))
    return lines or [Line(f"{other}: errors (the true path is not known)", "", Verdict.NONE)]


def in_short(differences: Sequence[Difference], reference: str, other: str) -> str:
    """Which of two back ends is better in what, in one sentence: in the main figures that can be told apart."""
    sure = (Verdict.CERTAIN, Verdict.LIKELY)
    told = [d for d in differences if d.metric.main and d.verdict in sure and not is_trifle(d)]
    parts = []
    for better, first, second in ((True, other, reference), (False, reference, other)):
        if names := [f"{_name(d.metric)} ({WORDS[d.verdict]})" for d in told if d.better is better]:
            parts.append(f"{first} is better than {second} in {', '.join(names)}")
    return f"{'; '.join(parts) or f'No difference between {reference} and {other} can be concluded'}."


def is_trifle(d: Difference) -> bool:
    """Whether two means are so near that nobody would choose by them, however sure their difference is.

    Shares such as that of tracked frames are judged by what they lack, too: 99.2 % is not equal to 100 %.
    """
    apart, larger = abs(d.other - d.reference), max(abs(d.reference), abs(d.other))
    same = _shown(d, d.reference) == _shown(d, d.other)
    if d.metric.better == "higher" and d.metric.unit == "%" and not same:
        return bool(apart < _TRIFLE * larger and apart < _MISSING * (1 - min(d.reference, d.other)))
    return bool(apart < _TRIFLE * larger or same)


def worth_saying(d: Difference) -> bool:
    """Whether a summary speaks of it whatever its verdict: not of what has the same ideal value in every run."""
    perfect = d.metric.better == "higher" and d.reference == 1
    return d.metric.main and not (perfect and d.verdict is Verdict.EQUAL)


def honesty(values: dict[str, dict[str, float]], runs: int) -> list[str]:
    """Whether the covariances hold, a sentence per back end: what its mean NEES is, and what is to be expected.

    Args:
        values: mean NEES over the runs by key of the figure and by back end; NaN where there is none.
        runs: how many. The band holds even if all frames of a run are as good as one.
    """
    low, high = (bound / 6 for bound in chi_square_band(6, max(runs, 1)))
    lines = []
    for backend in next(iter(values.values()), {}):
        key = next((k for k in _HONESTY if np.isfinite(values.get(k, {}).get(backend, np.nan))), None)
        if key is None:
            continue
        value = values[key][backend]
        claim = "consistent" if low <= value <= high else "overconfident" if value > high else "too cautious"
        lines.append(
            f"{backend}: {claim}. NEES / 6 {_HONESTY[key]} is {_digits(value)}, expected 1, {low:.2f} to {high:.2f} by "
            f"chance ({round(100 * LEVEL)} %): errors are {_digits(np.sqrt(value))} times as large as the covariances "
            "claim."
        )
    return lines


def failures(runs: dict[str, int], trials: int) -> str:
    """Which back ends failed how often; empty where none did."""
    counts = [f"{n} of {trials} of {name}" for name, n in runs.items() if n]
    if not counts:
        return ""
    return (
        f"Runs failed, {', '.join(counts)}: a trial in which either failed is no pair, and the other figures speak of "
        "the pairs alone."
    )


def beforehand(trials: int) -> str:
    """What so many trials can show, before they are run."""
    tests = int(ALPHA * 2 ** min(trials - 1, 30))
    if tests < 1:
        return caution(trials)
    return f"With {trials} trials a difference that has the same sign in all is certain where up to {tests} are tested."


def caution(trials: int, tests: int = 1) -> str:
    """What so many trials can show at best; empty where they are enough to be certain of something.

    Args:
        trials: of the sequence that has most.
        tests: that p is adjusted for.
    """
    enough = fewest(tests)
    if trials >= enough:
        return ""
    if trials == 1:
        return (
            "One trial cannot tell a difference from chance: synthetic worlds have as many as are asked for (--trials, "
            f"{enough} or more), a recorded sequence has one."
        )
    least, what = 2 / 2**trials, "nothing can be certain"
    if trials < fewest(1):
        why = f"even where all agree, chance alone does as much in {100 * least:.2g} % of such comparisons"
    else:
        why = f"even where all agree, p is {least:.2g}, and {tests} tests multiply it (Holm)"
        what = "differences can be likely at best, not certain"
    intervals = f" Intervals of a mean are given from {FEWEST} trials on." if trials < FEWEST else ""
    return f"With {trials} trials {what}: {why}. It takes {enough} or more (--trials).{intervals}"


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


def shown_mean(d: Difference) -> str:
    """The mean difference for people; of figures that should be one, the ratio of the factors by which they are off."""
    if d.metric.better == "one" and np.isfinite(d.mean):
        return f"× {10**d.mean:.3f}"
    return shown(d.metric.scale * d.mean, _widest(d)) if np.isfinite(d.low) else d.metric.show(d.mean)


def shown_interval(d: Difference) -> str:
    """The bounds of its interval, with as many digits as the larger one needs; a dash where there is none."""
    if not np.isfinite(d.low):
        return "–"
    if d.metric.better == "one":
        return f"{10**d.low:.3f} … {10**d.high:.3f}"
    return " … ".join(shown(d.metric.scale * bound, _widest(d)) for bound in (d.low, d.high))


def _widest(d: Difference) -> float:
    return d.metric.scale * max(abs(d.low), abs(d.high))


def shown_spread(metric: Metric, mean: float, sd: float) -> tuple[str, str]:
    """Mean and standard deviation for people, with as many digits as the mean needs; empty where there is none."""
    mean, sd = metric.scale * mean, metric.scale * sd
    return shown(mean), f"± {shown(sd, mean)}" if np.isfinite(mean) and np.isfinite(sd) else ""


def shown_p(p: float) -> str:
    """A p-value for people; a dash where there is none."""
    if not np.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def _name(metric: Metric) -> str:
    """A label that can stand in a list."""
    return metric.label.replace(", ", " ").removesuffix(" (expected 1)")


def _brief(d: Difference) -> str:
    """The figure from the reference's value to the other's, and by how much of the reference's that is."""
    unit = d.metric.unit and f" {d.metric.unit}"
    return f"{_name(d.metric)} {_shown(d, d.reference)} → {_shown(d, d.other)}{unit}{_apart(d)}"


def _shown(d: Difference, value: float) -> str:
    return shown(d.metric.scale * value)


def _apart(d: Difference) -> str:
    """By how much the other's mean is above or below the reference's: a factor where percentages are enormous."""
    small, large = sorted((d.reference, d.other))
    if d.metric.better != "lower" or d.reference <= 0:
        return ""
    if small <= 0 or large / small < _FACTOR:
        return f" ({100 * (d.other / d.reference - 1):+.2g} %)".replace("-", "−")
    times = _digits(large / small) if large / small < 1e4 else f"{large / small:.1g}"
    return f" ({times} times as {'much' if d.other > d.reference else 'little'})"


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2f}"
