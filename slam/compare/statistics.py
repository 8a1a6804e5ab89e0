"""What follows from paired trials, and what does not.

Two estimators run on the same recordings: the difference of each pair is free of how hard a recording was. Its mean
over the trials is the effect. It has Student's 95 % confidence interval and a p-value by the sign-flip permutation test
(two-sided): how often so large a mean would come about if neither were better. Many figures are tested at once, so p is
adjusted over all tests of a report (Holm 1979). The interval takes differences for normal ones, the test does not, but
its p cannot fall below 2 / 2ᴺ; a difference needs both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np

from slam.geometry.se3 import Array
from slam.run.results import Metric

#: Of confidence intervals.
LEVEL = 0.95

#: p up to which a difference is significant: Holm-adjusted it is certain, before the adjustment likely.
ALPHA = 0.05

_SEED = 0
_EXACT = 16  # pairs up to which all 2ᴺ patterns of signs are tried; for more as many are drawn


class Verdict(StrEnum):
    """What may be concluded of a difference: see `Difference.verdict`, and ``docs/comparing.md``."""

    CERTAIN = "certain"
    LIKELY = "likely"
    OPEN = "open"
    EQUAL = "equal"
    SINGLE = "one trial"
    NONE = "no pair"
    UNTESTED = ""


@dataclass(frozen=True)
class Difference:
    """How far a back end lies from the reference in one figure, over paired trials.

    For figures whose ideal is one, what is compared is the distance from it, ``|log10 value|``.
    """

    metric: Metric
    pairs: int  # trials in which both have the figure
    missing: int  # trials in which one or both have not, because they failed
    reference: float  # mean over the pairs
    other: float
    mean: float  # of the differences, other less reference
    low: float  # bounds of its confidence interval; NaN with fewer than two pairs
    high: float
    p: float  # of the sign-flip test, two-sided; NaN with fewer than two pairs, and where nothing is better or worse
    p_holm: float  # adjusted over the tests of a report, see `adjusted`; `p` itself where there is no other test
    lower: int  # pairs in which the other is lower
    higher: int

    @property
    def better(self) -> bool | None:
        """Whether the other back end is better, certain or not; None where neither is."""
        if not self.metric.better or not np.isfinite(self.mean) or self.mean == 0:
            return None
        return bool(self.mean > 0) if self.metric.better == "higher" else bool(self.mean < 0)

    @property
    def varies(self) -> bool:
        """Whether the test can come out either way: two pairs or more, not all equal. Only these are a test."""
        return bool(np.isfinite(self.p)) and self.lower + self.higher > 0

    @property
    def verdict(self) -> Verdict:
        """What may be concluded."""
        if not self.pairs:
            return Verdict.NONE
        if not self.lower and not self.higher:  # every pair is the same to the last digit
            return Verdict.EQUAL
        if not self.metric.better:
            return Verdict.UNTESTED
        if self.pairs == 1:  # without any spread to judge it by
            return Verdict.SINGLE
        if self.low <= 0 <= self.high or self.p > ALPHA:
            return Verdict.OPEN
        return Verdict.CERTAIN if self.p_holm <= ALPHA else Verdict.LIKELY


def difference(metric: Metric, reference: Array, other: Array) -> Difference:
    """The paired difference of two back ends in one figure, as the only test; see `adjusted` for several.

    The values (N,) are by trial, NaN where a run failed.
    """
    both = np.isfinite(reference) & np.isfinite(other)
    values = [reference[both], other[both]]
    compared = values
    if metric.better == "one":  # the same for half and double
        compared = [np.abs(np.log10(np.maximum(each, 1e-12))) for each in values]
    d = compared[1] - compared[0]
    first, second, mean = (float(each.mean()) if len(d) else float("nan") for each in (*values, d))
    p = sign_flip(d) if metric.better and len(d) > 1 else float("nan")
    signs = int((d < 0).sum()), int((d > 0).sum())
    return Difference(metric, len(d), int((~both).sum()), first, second, mean, *interval(d), p, p, *signs)


def adjusted(differences: Sequence[Difference]) -> list[Difference]:
    """The differences of one report, in the same order, each with its p adjusted by Holm over all of them.

    Tests that cannot come out either way (`Difference.varies`) keep their p and do not count.
    """
    tests = [i for i, d in enumerate(differences) if d.varies]
    found = list(differences)
    for i, p in zip(tests, holm(np.array([differences[i].p for i in tests]))):
        found[i] = replace(found[i], p_holm=float(p))
    return found


def holm(p: Array) -> Array:
    """p-values (M,) adjusted so that the chance of any false one at level α stays below α (Holm 1979, step-down).

    The smallest is multiplied by M, the next by M − 1, …; none is less than a smaller one's, none more than 1.
    """
    order, result = np.argsort(p, kind="stable"), np.empty(len(p))
    result[order] = np.minimum(1.0, np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order]))
    return result


def fewest(tests: int) -> int:
    """Trials that it takes for one of so many tests to be certain: p is at least 2 / 2ᴺ, and Holm's factor `tests`."""
    return int(np.ceil(np.log2(2 * max(tests, 1) / ALPHA)))


def interval(values: Array) -> tuple[float, float]:
    """Bounds of Student's confidence interval of the mean of values (N,); NaN with fewer than two."""
    if len(values) < 2:
        return float("nan"), float("nan")
    from scipy.special import stdtrit

    half = stdtrit(len(values) - 1, (1 + LEVEL) / 2) * values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean() - half), float(values.mean() + half)


def sign_flip(d: Array) -> float:
    """The p-value of the sign-flip permutation test, two-sided, of paired differences (N,).

    Exact up to 16 pairs. For more, 2¹⁶ patterns of signs are drawn with a fixed seed, and the one observed counts as
    one of them (Phipson and Smyth 2010), so p is never zero.
    """
    if not d.any():
        return 1.0
    sums = np.abs(_signs(len(d)) @ d)
    as_large = int((sums >= np.abs(d.sum()) * (1 - 1e-12)).sum())
    return as_large / len(sums) if len(d) <= _EXACT else (as_large + 1) / (len(sums) + 1)


@lru_cache(maxsize=4)
def _signs(count: int) -> Array:
    """Patterns of signs (M, count): all, or where these are too many 2¹⁶ at random."""
    if count <= _EXACT:
        return 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    return np.random.default_rng(_SEED).choice((-1.0, 1.0), (2**_EXACT, count))
