"""Whether covariances hold: one judgement for a run and for a comparison, which says by what it judges."""

import pytest

from slam.compare.plan import Plan, Trial
from slam.compare.tables import groups, honesty
from slam.compare.trial import Run
from slam.run.results import errors_of_truth, figures, verdict, verdict_of_run

TEN, ONE, START = "ratio_10m", "ratio_1m", "ratio_start"


@pytest.mark.parametrize(
    ("found", "runs", "words"),
    [
        ({}, 1, ""),
        ({START: 1.0}, 1, "hold: from the start errors of the pose are as large as they claim (0.45 to 1.55 in 95 %"),
        ({START: 1.265}, 12, "are too small: from the start errors of the pose are 1.26 times what they claim (0.84"),
        ({START: 0.316}, 1, "are too large: from the start errors of the pose are 0.316 times"),
        ({TEN: 1.1, START: 6.3}, 1, "hold in part: over 10 m errors of the pose are 1.1 times"),
        (
            {START: 0.949, "pixels_alone": 1.0},
            12,
            "hold: from the start errors of the pose are 0.949 times what they claim "
            "(0.84 to 1.16 in 95 % of means of 12 runs); they count pixel noise alone",
        ),
        ({ONE: 2.0, START: 1.0}, 1, "are too small: over 1 m errors of the pose are 2 times"),
    ],
)
def test_the_verdict_is_by_the_best_figure_and_its_band(found, runs, words):
    assert verdict(found, runs).removeprefix("covariances ").startswith(words)


def summary(nees, lost=0):
    status = {"started": 1, "tracked": 39 - lost, "lost": lost}
    return {"frames": 40, "status": status, "consistency": {"mean NEES": 6 * nees, "dof": 6.0}}


def test_covariances_that_are_too_large_on_an_exact_world_say_why(tmp_path):
    plan, trial = Plan(("synthetic:desk",), ("ekf",)), Trial("synthetic:desk", "ekf")
    for exact in (True, False):
        tree = summary(0.1)
        tree["consistency"]["exact calibration"] = exact
        said = verdict_of_run(tree)
        assert said.endswith("this world's cameras have none") == exact == ("are on the safe side" in said)
        (group,) = groups(plan, [Run(trial, "completed", figures(tree), {}, tmp_path)])
        assert honesty(group) == [f"ekf: {said}."]
    tree["consistency"] |= {"exact calibration": True, "pixel noise alone": True}  # these are not on the safe side
    said = verdict_of_run(tree)
    assert said.startswith("covariances are too large") and said.count("they count") == 1
    assert said.endswith("; they count pixel noise alone, and no errors of the calibration")


def test_a_truth_less_exact_than_what_is_claimed_is_said_with_all_its_errors():
    """Claims three times too small were said to hold: most of the error that is expected was the truth's."""
    tree = summary(1.0) | {
        "truth": {"translation": 0.01, "rotation": 0.01, "mounting": 0.0, "lever": 0.02, "clock": 0.01}
    }
    assert "the true path's own" not in verdict_of_run(tree)
    tree["consistency"] |= {
        "NEES over 10 m": 6.0,
        "share of truth over 10 m": 0.84,
        "share of truth from the start": 0.2,
    }
    hardly = (
        "covariances can hardly be judged: 84 % of the error that is expected over 10 m is the true path's own; over"
    )
    assert verdict_of_run(tree).startswith(hardly)
    small = tree | {"consistency": tree["consistency"] | {"NEES over 10 m": 60.0}}
    assert verdict_of_run(small).startswith("covariances are too small")  # whoever's errors are expected
    assert errors_of_truth(tree) == "σ 10 mm, 0.573°, mounting 20 mm, 0°, clock 10 ms"


def test_doubtful_truth_is_named_and_not_the_covariance():
    """A run of frames whose truth was interpolated said "covariances are 12 times too small"."""
    tree = summary(1.0)
    tree["consistency"] |= {"doubtful truth over 10 m": 0.25}
    assert verdict_of_run(tree).endswith(
        "; not judged: 25 % of the stretches over 10 m, where the true path is doubtful"
    )
    tree["consistency"]["mean NEES"] = float("nan")
    assert verdict_of_run(tree).startswith("covariances cannot be judged: the true path is doubtful")


def test_covariances_that_cannot_be_judged_say_so():
    """A back end that claims the same covariance in every frame had no verdict, and no word why."""
    tree = summary(1.0) | {"consistency": {"mean NEES": float("nan"), "dof": 6.0, "no covariance over 1 m": 1.0}}
    assert "cannot be judged" in verdict_of_run(tree) and "claims the same one for every frame" in verdict_of_run(tree)
    singular = tree | {"consistency": tree["consistency"] | {"singular covariances": 4}}
    assert verdict_of_run(singular).endswith("they are singular")
    assert "not judged in a prior map" in verdict_of_run(tree | {"loops": {"known": 5}})
    assert verdict_of_run(tree | {"consistency": {}}) == ""  # without a true path


def test_figures_of_bodies_are_means_over_those_that_were_in_view():
    body = {"frames in view": 10, "coverage": 0.8, "ME": {"translation median [m]": 0.002}, "mean NEES": 12.0}
    bodies = {"1": body, "2": body | {"coverage": 0.4}, "3": {"frames in view": 0, "coverage": None}}
    found = figures(summary(1.0) | {"objects": {"features": {"precision": 0.5}, "bodies": bodies}})
    assert found["body_coverage"] == pytest.approx(0.6) and found["body_ratio"] == pytest.approx(2.0**0.5)
    assert found["moving_precision"] == 0.5
    assert "moving_precision" not in figures(summary(1.0) | {"objects": {"features": {"precision": 0.5}, "bodies": {}}})
