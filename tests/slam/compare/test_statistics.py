from __future__ import annotations

import numpy as np
import pytest

from slam.compare.statistics import ALPHA, FEWEST, Verdict, adjusted, difference, fewest, holm, interval, sign_flip
from slam.compare.wording import headline, honesty, is_trifle
from slam.run.results import BY_KEY, object_figures, object_metric

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


def test_failed_runs_are_counted_and_their_pairs_left_out():
    reference, other = pairs(8)
    reference[2] = other[5] = np.nan
    d = difference(ATE, reference, other)
    assert (d.pairs, d.missing) == (6, 2)
    nothing = difference(ATE, np.full(3, np.nan), other[:3])
    assert nothing.verdict is Verdict.NONE


def test_honesty_is_the_distance_from_one():
    d = difference(NEES, np.full(8, 0.5) + 1e-3 * np.arange(8), np.full(8, 1.9))
    assert d.better is True  # 1.9 is nearer to 1 than 0.5 is, on a scale on which half and double are equally far
    assert d.other == pytest.approx(1.9)


def test_higher_is_better_where_it_is():
    d = difference(PRECISION, *pairs(8, shift=0.05))
    assert d.better is True
    assert d.verdict is Verdict.CERTAIN


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
    assert metric.title == "body 2: motion error, translation median [mm]"
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


def test_nearly_all_is_not_as_good_as_all():
    """Where 99.2 % of the frames are tracked, eight in a thousand are lost: no trifle, though it is less than 1 %."""
    ones = np.ones(9)
    lines = headline(adjusted([difference(TRACKED, ones, ones - 0.008)]), "smoother")
    assert (lines[0].badge, lines[0].text) == ("worse: certain", "smoother: frames tracked 100 → 99.2 %")
    assert not is_trifle(difference(PRECISION, 0.999 * ones, 0.99 * ones))
    assert is_trifle(difference(PRECISION, 0.974 * ones, 0.972 * ones))
