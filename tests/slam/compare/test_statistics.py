from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from slam.compare.measure import BY_KEY, COMPLETED, object_figures, object_metric
from slam.compare.statistics import (
    ALPHA,
    FEWEST,
    HINT_ALPHA,
    Verdict,
    adjusted,
    difference,
    fewest,
    holm,
    interval,
    sign_flip,
)
from slam.compare.wording import (
    STRENGTH,
    beforehand,
    caution,
    headline,
    honesty,
    in_short,
    innovations,
    is_trifle,
    measurements,
    sentence,
    shown_p,
    worth_saying,
)

ATE, NEES, PRECISION = BY_KEY["ate_online_m"], BY_KEY["nees_per_dof"], BY_KEY["association_precision"]
TRACKED = BY_KEY["tracked"]


def pairs(n, shift=-0.01, seed=0):
    """Trials that differ a lot among each other, and by `shift` with little noise within a pair."""
    rng = np.random.default_rng(seed)
    hard = rng.uniform(0.1, 1.0, n)
    return hard, hard + shift + 0.001 * rng.standard_normal(n)


def test_six_trials_that_agree_are_certain_where_they_are_the_only_test_and_five_are_not():
    assert fewest(1) == 6
    assert difference(ATE, *pairs(6)).verdict is Verdict.CERTAIN
    assert difference(ATE, *pairs(5)).verdict is Verdict.HINT  # p = 0.0625
    assert difference(ATE, *pairs(4)).verdict is Verdict.OPEN  # p = 0.125


def test_p_near_a_tenth_is_not_likely():
    change = np.array([0.05, -0.06, -0.1, -0.11, -0.12, -0.13, 0.02])
    d = difference(ATE, np.ones(7), 1 + change)
    assert 0.05 < d.p <= 0.1
    assert d.verdict is Verdict.HINT


def test_words_have_their_thresholds_in_one_place():
    assert (ALPHA, HINT_ALPHA) == (0.05, 0.1)
    assert "Holm-adjusted p ≤ 0.05" in STRENGTH[Verdict.CERTAIN]
    assert "p ≤ 0.05" in STRENGTH[Verdict.LIKELY]
    assert "p ≤ 0.1" in STRENGTH[Verdict.HINT]
    page = (Path(__file__).parents[3] / "docs" / "comparing.md").read_text(encoding="utf-8")
    assert f"| certain | leaves out zero | Holm-adjusted p ≤ {ALPHA:g} |" in page
    assert f"| likely | leaves out zero | p ≤ {ALPHA:g} before the adjustment |" in page
    assert f"| a hint | leaves out zero | p ≤ {HINT_ALPHA:g} before the adjustment |" in page
    trials = re.search(r"with (\d+) trials, 20 tests with (\d+), 70 with (\d+), 300 with\s(\d+)", page)
    assert [int(n) for n in trials.groups()] == [fewest(1), fewest(20), fewest(70), fewest(300)]


def test_holm_is_that_of_his_paper():
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm(np.array([0.5, 0.9])), [1, 1])
    assert len(holm(np.zeros(0))) == 0


def test_several_tests_need_more_trials():
    """Six trials that agree are likely where ten figures are tested; nine are enough for all ten."""
    assert (fewest(10), fewest(67)) == (9, 12)
    for trials, verdict in ((6, Verdict.LIKELY), (8, Verdict.LIKELY), (9, Verdict.CERTAIN)):
        found = adjusted([difference(ATE, *pairs(trials, seed=k)) for k in range(10)])
        assert {d.verdict for d in found} == {verdict}
        assert {d.p_holm for d in found} == {min(1, 10 * 2 / 2**trials)}


def test_what_cannot_come_out_either_way_is_no_test():
    reference, other = pairs(6)
    every = [
        difference(ATE, reference, other),
        difference(ATE, reference, reference),
        difference(ATE, reference[:1], other[:1]),
        difference(BY_KEY["map_size"], reference, other),
    ]
    found = adjusted(every)
    verdicts = [d.verdict for d in found]
    assert verdicts == [Verdict.CERTAIN, Verdict.EQUAL, Verdict.SINGLE, Verdict.UNTESTED]
    assert found[0].p_holm == found[0].p
    assert np.isnan(found[3].p)


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
    values = np.random.default_rng(0).standard_normal(50)
    low, high = interval(values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 / np.sqrt(50), rel=0.25)
    assert interval(np.ones(FEWEST)) == (1, 1)
    assert np.isnan(interval(values[: FEWEST - 1])).all()


def test_so_few_trials_have_no_interval_and_nothing_is_sure():
    """Two trials have three resampled means: an interval of them means nothing."""
    d = difference(ATE, *pairs(2))
    assert np.isnan([d.low, d.high]).all()
    assert d.verdict is Verdict.OPEN
    assert "interval" not in sentence(d, "a", "b")
    assert f"Intervals of a mean are given from {FEWEST} trials on." in caution(2)
    assert "Intervals" not in caution(FEWEST, 67)


def test_pairs_take_the_difficulty_of_a_trial_out():
    reference, other = pairs(10)
    d = difference(ATE, reference, other)
    assert d.mean == pytest.approx(-0.01, abs=0.002)
    assert -0.012 < d.low < d.mean < d.high < -0.008  # although trials spread over 0.9
    assert d.better is True
    assert difference(ATE, other, reference).better is False


def test_noise_alone_is_certain_in_few_reports_however_many_figures():
    """The chance of any false one among 20 tests keeps to the level: 5 % of 200 reports are 10."""
    rng = np.random.default_rng(2)
    wrong = 0
    for _ in range(200):
        p = [sign_flip(d) for d in rng.standard_normal((20, 12))]
        wrong += bool((holm(np.array(p)) <= ALPHA).any())
    assert 1 <= wrong <= 18  # p < 0.01 for more


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
    assert "p = 0.008: certain" in sentence(d, "a", "b")
    assert "in 8 of 8 trials" in sentence(d, "a", "b")


def test_sentences_say_how_much_and_how_sure():
    text = sentence(difference(ATE, *pairs(6)), "ekf", "smoother")
    for words in ("smoother is better than ekf", "mm (−", "6 of 6", "95 % interval", "certain"):
        assert words in text
    few = adjusted([difference(ATE, *pairs(6, seed=k)) for k in range(3)])[0]
    assert "p = 0.031, Holm-adjusted 0.094: likely (p ≤ 0.05, not after" in sentence(few, "ekf", "smoother")
    assert "a hint (p ≤ 0.1)" in sentence(difference(ATE, *pairs(5)), "ekf", "smoother")


def test_the_caution_says_how_many_trials_it_takes():
    assert "6.2 %" in caution(5)
    assert "One trial" in caution(1, 67)
    assert "12 or more" in caution(1, 67)
    assert not caution(6)
    assert "67 tests multiply it (Holm). It takes 12 or more" in caution(6, 67)
    assert not caution(12, 67)


def test_p_values_are_short_and_never_zero():
    assert [shown_p(p) for p in (float("nan"), 1e-5, 0.03125, 0.5)] == ["–", "< 0.001", "0.031", "0.50"]


def test_mean_nees_stands_beside_what_is_to_be_expected():
    """A NEES of 3500 says little; that errors are 24 times what is claimed says what is wrong."""
    values = {"nees_per_dof": {"ekf": 3500 / 6, "smoother": 1.2}, "nees_10m_per_dof": {"ekf": np.nan, "smoother": 0.1}}
    frightening, cautious = honesty(values, 6)
    assert frightening.startswith(
        "ekf: overconfident. NEES / 6 from the start is 583, expected 1, 0.59 to 1.51 by chance"
    )
    assert "errors are 24 times as large" in frightening
    assert cautious.startswith("smoother: too cautious. NEES / 6 over 10 m of path is 0.10")
    assert honesty({"nees_per_dof": {"ekf": 1.2}}, 6)[0].startswith("ekf: consistent")
    assert honesty({}, 6) == []


def test_captions_tell_closed_loop_from_replay():
    assert measurements("closed loop", "ekf").startswith("Closed loop:")
    assert "ekf's closed loop" in measurements("replay", "ekf")


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


def test_a_headline_names_all_that_is_certain_in_both_directions_and_what_is_open():
    same = np.full(9, 0.5)
    noise = np.array([0.1, -0.1, 0.11, -0.12, 0.09, -0.08, 0.1, -0.1, 0.01])
    differences = [
        difference(ATE, *pairs(9)),
        difference(BY_KEY["rpe_1s_m"], *pairs(9, shift=0.01)),  # no main figure
        difference(PRECISION, same, same),
        difference(BY_KEY["landmark_error_m"], same, same + noise),
        difference(BY_KEY["landmark_error_90_m"], same, same + noise),
    ]
    lines = headline(adjusted(differences), "smoother")
    assert [(line.direction, line.verdict) for line in lines] == [
        ("better", Verdict.CERTAIN),
        ("worse", Verdict.CERTAIN),
        ("", Verdict.OPEN),
    ]
    better, worse, rest = (line.text for line in lines)
    assert [line.badge for line in lines] == ["better: certain", "worse: certain", "open"]
    assert better.startswith("smoother: ATE RMSE online ")
    assert "→" in better
    assert "(−1" in better  # per cent of the reference
    assert worse.startswith("smoother: RPE RMSE over 1 s ")
    assert "(+1" in worse
    assert rest == "smoother: landmark error median"


def test_enormous_ratios_are_factors_and_the_verdict_is_one_sentence():
    ones = np.linspace(0.9, 1.1, 12)
    (found,) = adjusted([difference(ATE, 0.01 * ones, 5 * ones)])
    (line,) = headline([found], "smoother")
    assert "(500 times as much)" in line.text
    assert "%" not in line.text
    assert in_short([found], "ekf", "smoother") == "ekf is better than smoother in ATE RMSE online (certain)."
    assert in_short([], "ekf", "smoother") == "No difference between ekf and smoother can be concluded."


def test_what_trials_can_show_is_said_beforehand():
    assert "same sign in all is certain where up to 102 are tested" in beforehand(12)
    assert beforehand(3) == caution(3)


def test_what_nobody_would_choose_by_is_no_headline_however_sure():
    """97.4 % against 97.0 % in every trial is certain, and a trifle."""
    reference = np.linspace(0.960, 0.966, 9)
    lines = headline(adjusted([difference(PRECISION, reference, reference - 0.004)]), "smoother")
    assert [(line.badge, line.text) for line in lines][:1] == [
        ("equal", "smoother: less than 1 % apart: association precision")
    ]
    lines = headline(adjusted([difference(PRECISION, reference, reference - 0.04)]), "smoother")
    assert lines[0].badge == "worse: certain"


def test_nearly_all_is_not_as_good_as_all():
    """Where 99.2 % of the frames are tracked, eight in a thousand are lost: no trifle, though it is less than 1 %."""
    ones = np.ones(9)
    lines = headline(adjusted([difference(TRACKED, ones, ones - 0.008)]), "smoother")
    assert (lines[0].badge, lines[0].text) == ("worse: certain", "smoother: frames tracked 100 → 99.2 %")
    assert not is_trifle(difference(PRECISION, 0.999 * ones, 0.99 * ones))
    assert is_trifle(difference(PRECISION, 0.974 * ones, 0.972 * ones))


def test_what_prints_as_the_same_is_no_headline():
    values = np.linspace(1.0, 2.0, 9)
    assert is_trifle(difference(PRECISION, 0.99996 * np.ones(9), 0.99999 * np.ones(9)))  # 100 % both
    assert is_trifle(difference(BY_KEY["rpe_1s_deg"], 1e-7 * values, 3e-7 * values))  # six decimals at most
    assert not is_trifle(difference(BY_KEY["rpe_1s_deg"], values, 1.02 * values))


def test_a_nis_far_from_one_is_explained():
    nan = float("nan")
    low, high = innovations({"ekf": 0.22, "smoother": 1.0, "batch": 0.3, "mine": 7.0, "none": nan})
    assert low.startswith("NIS per degree of freedom: ekf 0.22, batch 0.30, expected 1: predictions and measurements")
    assert "better than assumed" in low
    assert high.startswith("NIS per degree of freedom: mine 7.00, expected 1")
    assert "worse than assumed" in high
    assert innovations({"ekf": 1.0}) == []


def test_a_headline_without_any_error_says_why():
    tracked = difference(BY_KEY["tracked"], np.ones(1), np.ones(1))
    (line,) = headline([tracked], "smoother")
    assert (line.badge, line.text) == ("no pair", "smoother: errors (the true path is not known)")


def test_runs_that_failed_are_a_difference_of_their_own():
    """Five of six fail: what completes more often is certain only where every pair says so."""
    all_failed = difference(COMPLETED, np.ones(6), np.zeros(6))
    assert (all_failed.verdict, all_failed.better, all_failed.wins) == (Verdict.CERTAIN, False, 6)
    some = difference(COMPLETED, np.array([0.0, 0, 0, 1, 1, 1]), np.ones(6))
    assert (some.verdict, some.better, some.wins) == (Verdict.OPEN, True, 3)  # p = 0.25
    assert "b 100 against 50 %, mean of 6 trials" in sentence(some, "a", "b")
    assert not worth_saying(difference(COMPLETED, np.ones(6), np.ones(6)))
    assert worth_saying(difference(COMPLETED, np.zeros(6), np.zeros(6)))
