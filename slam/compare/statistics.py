"""What follows from paired trials, and what does not.

Two estimators run on the same recordings: the difference of each pair is free of how hard a recording was. Its mean
over the trials has a bootstrap confidence interval (bias-corrected and accelerated, Efron 1987), and the sign-flip
test says how often so large a mean would come about if neither were better. A difference counts as certain only where
both agree: with few trials the bootstrap is too sure of itself, while the test cannot fall below 2 / 2ᴺ.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from slam.compare.measure import Metric
from slam.geometry.se3 import Array

LEVEL = 0.95
_RESAMPLES = 9999
_SEED = 0
_LIKELY = 0.1  # p up to which a difference is called likely

#: Fewer pairs than this cannot reach the level: 2 / 2ᴺ is more than 1 − LEVEL.
FEWEST = int(np.ceil(np.log2(2 / (1 - LEVEL))))


class Verdict(StrEnum):
    """What may be concluded of a difference."""

    CERTAIN = "certain"  #: interval and test agree that there is one
    LIKELY = "likely"  #: the interval leaves out zero, but the test's p is above 5 %, if not above 10 %
    HINT = "hint"  #: the interval leaves out zero, but the test's p is above 10 %, perhaps for want of trials
    OPEN = "open"  #: the interval holds zero
    EQUAL = "equal"  #: every pair is the same to the last digit
    SINGLE = "single"  #: one pair: a difference without any spread to judge it by
    NONE = "none"  #: no pair


@dataclass(frozen=True)
class Difference:
    """How far a back end lies from the reference in one figure, over paired trials.

    For figures whose ideal is one, what is compared is the distance from it, ``|log10 value|``.

    Attributes:
        metric: the figure.
        pairs: trials in which both have it.
        missing: trials in which one or both have not, because they failed.
        reference, other: mean over the pairs.
        mean: of the differences, other less reference.
        low, high: bounds of its confidence interval; NaN with fewer than two pairs.
        p: of the sign-flip test, two-sided; NaN with fewer than two pairs.
        lower, higher: pairs in which the other is lower, and higher.
        verdict: what may be concluded.
    """

    metric: Metric
    pairs: int
    missing: int
    reference: float
    other: float
    mean: float
    low: float
    high: float
    p: float
    lower: int
    higher: int
    verdict: Verdict

    @property
    def better(self) -> bool | None:
        """Whether the other back end is better, certain or not; None where neither is."""
        if not self.metric.better or not np.isfinite(self.mean) or self.mean == 0:
            return None
        return bool(self.mean > 0) if self.metric.better == "higher" else bool(self.mean < 0)

    @property
    def wins(self) -> int:
        """Pairs in which the one that is better on average is better."""
        return self.lower if self.mean < 0 else self.higher


def difference(metric: Metric, reference: Array, other: Array) -> Difference:
    """The paired difference of two back ends in one figure.

    Args:
        metric: the figure.
        reference: values (N,) by trial, NaN where a run failed.
        other: the other's.
    """
    both = np.isfinite(reference) & np.isfinite(other)
    a, b = reference[both], other[both]
    means = (float(a.mean()), float(b.mean())) if len(a) else (float("nan"), float("nan"))
    if metric.better == "one":
        a, b = _dishonesty(a), _dishonesty(b)
    d = b - a
    low, high, p = interval_and_test(d)
    mean = float(d.mean()) if len(d) else float("nan")
    verdict = _verdict(d, low, high, p)
    signs = int((d < 0).sum()), int((d > 0).sum())
    return Difference(metric, len(d), int((~both).sum()), *means, mean, low, high, p, *signs, verdict)


def interval_and_test(d: Array) -> tuple[float, float, float]:
    """Bounds of the mean of paired differences (N,), and the sign-flip test's p; NaN with fewer than two."""
    if len(d) < 2:
        return float("nan"), float("nan"), float("nan")
    if np.ptp(d) == 0:  # no spread to resample
        return float(d[0]), float(d[0]), 1.0 if d[0] == 0 else _sign_flip(d)
    return *_bootstrap(d), _sign_flip(d)


def _bootstrap(d: Array) -> tuple[float, float]:
    from scipy.stats import bootstrap

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # BCa says so where it is not defined; then percentiles are taken
        for method in ("BCa", "percentile"):
            result = bootstrap(
                (d,), np.mean, confidence_level=LEVEL, n_resamples=_RESAMPLES, method=method,
                rng=np.random.default_rng(_SEED),
            )  # fmt: skip
            low, high = result.confidence_interval
            if np.isfinite(low) and np.isfinite(high):
                break
    return float(low), float(high)


def _sign_flip(d: Array) -> float:
    """Exact up to 13 pairs, else by seeded sampling."""
    from scipy.stats import permutation_test

    result = permutation_test(
        (d,), lambda x, axis: np.mean(x, axis=axis), permutation_type="samples", vectorized=True,
        n_resamples=_RESAMPLES, rng=np.random.default_rng(_SEED),
    )  # fmt: skip
    return float(result.pvalue)


def _verdict(d: Array, low: float, high: float, p: float) -> Verdict:
    if not len(d):
        return Verdict.NONE
    if not d.any():
        return Verdict.EQUAL
    if len(d) == 1:
        return Verdict.SINGLE
    if low <= 0 <= high:
        return Verdict.OPEN
    if p <= 1 - LEVEL:
        return Verdict.CERTAIN
    return Verdict.LIKELY if p <= _LIKELY else Verdict.HINT


def _dishonesty(values: Array) -> Array:
    """Distance from one, the same for half and double."""
    return np.abs(np.log10(np.maximum(values, 1e-12)))
