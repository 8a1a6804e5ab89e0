from __future__ import annotations

import numpy as np
import pytest

from slam.compare.statistics import ALPHA, Verdict, adjusted, difference, fewest, holm, interval, sign_flip
from slam.run.results import BY_KEY

ATE, NEES = BY_KEY["ate_online_m"], BY_KEY["nees_per_dof"]


def pairs(n):
    """Trials that differ a lot among each other, and by a centimetre with little noise within a pair."""
    rng = np.random.default_rng(0)
    hard = rng.uniform(0.1, 1.0, n)
    return hard, hard - 0.01 + 0.001 * rng.standard_normal(n)


def test_six_trials_that_agree_are_certain_where_they_are_the_only_test_and_five_are_not():
    assert fewest(1) == 6
    verdicts = [difference(ATE, *pairs(n)).verdict for n in (6, 5, 4)]  # p = 0.031, 0.0625, 0.125
    assert verdicts == [Verdict.CERTAIN, Verdict.OPEN, Verdict.OPEN]


def test_what_cannot_come_out_either_way_is_no_test():
    reference, other = pairs(6)
    every = [(ATE, other), (ATE, reference), (ATE, np.full(6, np.nan)), (BY_KEY["map_size"], other)]
    found = adjusted([*(difference(m, reference, b) for m, b in every), difference(ATE, reference[:1], other[:1])])
    verdicts = [d.verdict for d in found]
    assert verdicts == [Verdict.CERTAIN, Verdict.EQUAL, Verdict.NONE, Verdict.UNTESTED, Verdict.SINGLE]
    assert found[0].p_holm == found[0].p
    assert np.isnan(found[3].p)


def test_holm_is_that_of_his_paper():
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm(np.array([0.5, 0.9])), [1, 1])
    assert len(holm(np.zeros(0))) == 0


def test_the_sign_flip_test_is_exact_for_few_pairs_and_never_zero_for_many():
    d = np.array([1.0, 2, 3, -0.5])
    signs = np.array(np.meshgrid(*[(-1, 1)] * 4)).reshape(4, -1).T
    assert sign_flip(d) == np.mean(np.abs(signs @ d) >= d.sum() - 1e-9)
    assert sign_flip(np.ones(16)) == 2 / 2**16
    assert 0 < sign_flip(np.ones(40)) < 1e-4
    noise = np.random.default_rng(0).standard_normal(40)
    assert 0.05 < sign_flip(noise) == sign_flip(noise) <= 1
    assert sign_flip(np.zeros(3)) == 1


def test_the_interval_of_a_mean():
    assert interval(np.array([1.0, 2.0, 4.0])) == pytest.approx((-1.4612, 6.1279), abs=1e-4)  # 7/3 ± 4.3027 · 0.8819
    assert interval(np.ones(4)) == (1, 1)
    assert np.isnan(interval(np.ones(1))).all()


def test_noise_alone_is_certain_in_few_reports_however_many_figures():
    """The chance of any false one among 20 tests keeps to the level: 5 % of 200 reports are 10."""
    rng = np.random.default_rng(2)
    reports = (np.array([sign_flip(d) for d in rng.standard_normal((20, 12))]) for _ in range(200))
    assert 1 <= sum((holm(p) <= ALPHA).any() for p in reports) <= 18  # p < 0.01 for more


def test_failed_runs_are_counted_and_their_pairs_left_out():
    reference, other = pairs(8)
    reference[2] = other[5] = np.nan
    d = difference(ATE, reference, other)
    assert (d.pairs, d.missing) == (6, 2)


def test_honesty_is_the_distance_from_one():
    d = difference(NEES, np.full(8, 0.5) + 1e-3 * np.arange(8), np.full(8, 1.9))
    assert d.better is True  # 1.9 is nearer to 1 than 0.5 is, on a scale on which half and double are equally far
    assert d.other == pytest.approx(1.9)
