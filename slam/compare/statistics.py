"""What follows from paired trials, and what does not.

Two estimators run on the same recordings: the difference of each pair is free of how hard a recording was. Its mean
over the trials has Student's confidence interval. Many figures are compared at once, so the interval is widened
(Bonferroni): with 95 % chance all differences of a report lie in theirs. Where one leaves out zero, a back end is
better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry.se3 import Array
from slam.run.results import Metric

#: Chance that all intervals of a report hold.
LEVEL = 0.95


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

    @property
    def verdict(self) -> str:
        """What may be concluded of the other back end: "better", "worse", "equal", "open", or "one trial".

        Empty where no trial has both figures, or neither more nor less is better.
        """
        if not self.pairs or not self.metric.better:
            return ""
        if self.low == self.high == 0 or (self.pairs == 1 and self.mean == 0):
            return "equal"
        if self.pairs == 1:  # without any spread to judge it by
            return "one trial"
        if not (self.low > 0 or self.high < 0):
            return "open"
        return "better" if (self.mean > 0) == (self.metric.better == "higher") else "worse"


def difference(metric: Metric, reference: Array, other: Array, tests: int = 1) -> Difference:
    """The paired difference of two back ends in one figure, one of so many (`tests`).

    The values (N,) are by trial, NaN where a run failed.
    """
    both = np.isfinite(reference) & np.isfinite(other)
    compared = values = [reference[both], other[both]]
    if metric.better == "one":  # the same for half and double
        compared = [np.abs(np.log10(np.maximum(each, 1e-12))) for each in values]
    d = compared[1] - compared[0]
    first, second = (mean_of(metric, each) for each in values)
    mean = float(d.mean()) if len(d) else float("nan")
    half = reach(len(d), tests) * float(d.std(ddof=1)) if len(d) > 1 else float("nan")
    if len(d) > 1 and mean and (d == d[0]).all() and 2.0 ** len(d) < 2 * tests / (1 - LEVEL):
        half = float("inf")  # counts that are all alike have no spread; by their signs alone it may be chance
    return Difference(metric, len(d), int((~both).sum()), first, second, mean, mean - half, mean + half)


def mean_of(metric: Metric, values: Array) -> float:
    """The mean of values (N,), the root of the mean square where one is ideal, as of NEES; NaN where there are none."""
    if not len(values):
        return float("nan")
    return float(np.sqrt(np.mean(values**2)) if metric.better == "one" else values.mean())


def reach(pairs: int, tests: int = 1) -> float:
    """Half the interval of a mean of so many pairs, in their standard deviations; infinite for fewer than two."""
    if pairs < 2:
        return float("inf")
    from scipy.special import stdtrit

    return float(stdtrit(pairs - 1, 1 - (1 - LEVEL) / (2 * max(tests, 1))) / np.sqrt(pairs))
