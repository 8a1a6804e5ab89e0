import numpy as np
import pytest

from slam.compare.plan import Plan
from slam.compare.statistics import difference, reach
from slam.compare.tables import Group
from slam.compare.trial import Run
from slam.run.results import BY_KEY

ATE, NEES, TRACKED, DOUBTED = (BY_KEY[key] for key in ("ate_online_m", "ratio_start", "tracked", "doubted"))


def pairs(n):
    """Trials that differ a lot among each other, and by a centimetre with little noise within a pair."""
    rng = np.random.default_rng(0)
    hard = rng.uniform(0.1, 1.0, n)
    return hard, hard - 0.01 + 0.001 * rng.standard_normal(n)


def test_verdicts():
    first, second = pairs(6)
    for metric, reference, other, word in (
        (ATE, first, second, "better"),
        (ATE, second, first, "worse"),
        (TRACKED, first, second, "worse"),
        (ATE, first, first + np.tile([0.1, -0.1], 3), "open"),
        (ATE, first, first, "equal"),
        (ATE, first[:1], first[:1], "equal"),
        (ATE, first[:1], second[:1], "one trial"),
        (DOUBTED, np.zeros(2), np.ones(2), "open"),  # all alike, and yet by chance in half of all cases
        (DOUBTED, np.zeros(6), np.ones(6), "worse"),
        (ATE, first, np.full(6, np.nan), ""),
        (BY_KEY["map_size"], first, second, ""),
    ):
        assert difference(metric, reference, other).verdict == word


def test_the_interval_of_a_mean():
    values = np.array([0.0, 0.0, np.nan, 0.0, 0.0]), np.array([1.0, 2.0, 3.0, np.nan, 4.0])
    d, of_many = difference(ATE, *values), difference(ATE, *values, 20)
    assert (d.pairs, d.missing) == (3, 2)
    assert (d.low, d.high) == pytest.approx((-1.4612, 6.1279), abs=1e-4)  # 7/3 ± 4.3027 · 0.8819
    assert reach(6, 20) == pytest.approx(5.60386 / np.sqrt(6), rel=1e-4)  # Student's at 1 − 0.05 / 40
    assert (of_many.high - d.mean) / (d.high - d.mean) == pytest.approx(reach(3, 20) / reach(3))
    assert reach(1) == np.inf


def test_the_spread_of_a_figure_is_about_the_mean_that_is_shown(tmp_path):
    trials = Plan(("synthetic:desk",), ("ekf",), trials=2).every
    runs = [Run(t, "completed", {"ratio_start": r, "tracked": r}, {}, tmp_path) for t, r in zip(trials, (1.0, 7.0))]
    group = Group("synthetic:desk", "closed loop", {"ekf": runs})
    assert group.mean_and_sd("ekf", NEES) == pytest.approx((5.0, 20**0.5))  # a root mean square
    assert group.mean_and_sd("ekf", TRACKED) == pytest.approx((4.0, 18**0.5))


def test_honesty_is_the_distance_from_one():
    d = difference(NEES, np.full(8, 0.5) + 1e-3 * np.arange(8), np.full(8, 1.9))
    assert d.verdict == "better"  # 1.9 is nearer to 1 than 0.5 is, on a scale on which half and double are equally far
    assert d.other == pytest.approx(1.9)
