from __future__ import annotations

import numpy as np
import pytest

from slam.compare.measure import BY_KEY, COMPLETED, object_figures, object_metric
from slam.compare.statistics import FEWEST, Verdict, difference
from slam.compare.wording import caution, headline, sentence, worth_saying

ATE, NEES, PRECISION = BY_KEY["ate_online_m"], BY_KEY["nees_per_dof"], BY_KEY["association_precision"]


def pairs(n, shift=-0.01, seed=0):
    """Trials that differ a lot among each other, and by `shift` with little noise within a pair."""
    rng = np.random.default_rng(seed)
    hard = rng.uniform(0.1, 1.0, n)
    return hard, hard + shift + 0.001 * rng.standard_normal(n)


def test_six_trials_that_agree_are_certain_and_five_are_not():
    assert FEWEST == 6
    assert difference(ATE, *pairs(6)).verdict is Verdict.CERTAIN
    assert difference(ATE, *pairs(5)).verdict is Verdict.LIKELY
    assert difference(ATE, *pairs(3)).verdict is Verdict.HINT


def test_pairs_take_the_difficulty_of_a_trial_out():
    reference, other = pairs(10)
    d = difference(ATE, reference, other)
    assert d.mean == pytest.approx(-0.01, abs=0.002)
    assert -0.012 < d.low < d.mean < d.high < -0.008  # although trials spread over 0.9
    assert d.better is True
    assert difference(ATE, other, reference).better is False


def test_noise_alone_is_seldom_certain():
    """The share of false certainties keeps to the level: 5 % of 200 are 10; more than 18 have p < 0.01."""
    rng = np.random.default_rng(1)
    wrong = 0
    for _ in range(200):
        d = rng.standard_normal((2, 8))
        wrong += difference(ATE, d[0] + 10, d[1] + 10).verdict is Verdict.CERTAIN
    assert wrong <= 18


def test_failed_runs_are_counted_and_their_pairs_left_out():
    reference, other = pairs(8)
    reference[2] = other[5] = np.nan
    d = difference(ATE, reference, other)
    assert (d.pairs, d.missing) == (6, 2)
    nothing = difference(ATE, np.full(3, np.nan), other[:3])
    assert nothing.verdict is Verdict.NONE
    assert "nothing to compare" in sentence(nothing, "a", "b")


def test_equal_single_and_open():
    reference, _ = pairs(4)
    assert difference(ATE, reference, reference).verdict is Verdict.EQUAL
    assert difference(ATE, reference[:1], reference[:1] + 1).verdict is Verdict.SINGLE
    other = reference + np.array([0.01, -0.01, 0.012, -0.009])
    d = difference(ATE, reference, other)
    assert d.verdict is Verdict.OPEN
    assert "no difference can be concluded" in sentence(d, "a", "b")


def test_the_same_difference_in_every_pair_has_no_spread():
    d = difference(ATE, np.ones(7), np.full(7, 0.5))
    assert (d.low, d.high) == (-0.5, -0.5)
    assert d.verdict is Verdict.CERTAIN


def test_honesty_is_the_distance_from_one():
    d = difference(NEES, np.full(8, 0.5) + 1e-3 * np.arange(8), np.full(8, 1.9))
    assert d.better is True  # 1.9 is nearer to 1 than 0.5 is, on a scale on which half and double are equally far
    assert d.other == pytest.approx(1.9)


def test_higher_is_better_where_it_is():
    d = difference(PRECISION, *pairs(8, shift=0.05))
    assert d.better is True
    assert sentence(d, "a", "b").startswith("association precision: b is better than a")
    assert "in 8 of 8 trials" in sentence(d, "a", "b")


def test_sentences_say_how_much_and_how_sure():
    text = sentence(difference(ATE, *pairs(6)), "ekf", "smoother")
    for words in ("smoother is better than ekf", "mm", "% less", "6 of 6", "95 % interval", "certain"):
        assert words in text
    assert "likely, not certain" in sentence(difference(ATE, *pairs(5)), "ekf", "smoother")
    assert "6.2 %" in caution(5)
    assert "One trial" in caution(1)
    assert not caution(6)


def test_the_same_input_gives_the_same_figures():
    assert difference(ATE, *pairs(20)) == difference(ATE, *pairs(20))


def test_figures_of_objects_know_what_is_better():
    better = {
        "object features precision": "higher",
        "object bodies 1 coverage": "higher",
        "object false movers per frame": "lower",
        "object bodies 1 absolute translation RMSE [m]": "lower",
        "object bodies 1 frames in view": "",
        "object bodies 1 NEES / degree of freedom": "one",
    }
    assert {key: object_metric(key).better for key in better} == better
    metric = object_metric("object bodies 2 ME translation median [m]")
    assert metric.title == "body 2: ME translation median [mm]"
    assert metric.show(0.0021) == "2.1"


def test_figures_of_objects_from_a_summary():
    body = {"frames in view": 30, "coverage": 0.9, "ids": [1], "mean NEES": 9.0, "dof": 6.0}
    found = object_figures({"objects": {"features": {"F1": 0.8}, "bodies": {"1": body}, "false objects": []}})
    assert found["object features F1"] == 0.8
    assert found["object bodies 1 NEES / degree of freedom"] == 1.5
    still = {"frames in view": 0, "coverage": None, "ids": []}
    nothing = object_figures({"objects": {"features": {"F1": 0.0}, "bodies": {"1": still}}})
    assert nothing == {"object bodies 1 frames in view": 0.0}
    assert object_figures({}) == {}


def test_a_headline_says_who_is_better_in_what_and_what_is_open():
    same = np.full(6, 0.5)
    differences = [
        difference(ATE, *pairs(6)),
        difference(PRECISION, same, same),
        difference(BY_KEY["landmark_error_m"], same, same + np.array([0.1, -0.1, 0.11, -0.12, 0.09, -0.08])),
    ]
    text = headline(differences, "ekf", "smoother")
    assert text.startswith("smoother is better in ATE RMSE online (")
    assert "% less): certain at the level of 95 %." in text
    assert "No difference can be concluded in association precision and landmark error median." in text


def test_runs_that_failed_are_a_difference_of_their_own():
    """Five of six fail: what completes more often is certain only where every pair says so."""
    all_failed = difference(COMPLETED, np.ones(6), np.zeros(6))
    assert (all_failed.verdict, all_failed.better, all_failed.wins) == (Verdict.CERTAIN, False, 6)
    some = difference(COMPLETED, np.array([0.0, 0, 0, 1, 1, 1]), np.ones(6))
    assert (some.verdict, some.better, some.wins) == (Verdict.HINT, True, 3)
    assert "in 3 of 6 trials" in sentence(some, "a", "b")
    assert not worth_saying(difference(COMPLETED, np.ones(6), np.ones(6)))
