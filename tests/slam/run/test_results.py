"""Whether covariances hold: one judgement for a run and for a comparison, which says by what it judges."""

from __future__ import annotations

import pytest

from slam.compare.plan import Plan, Trial, Variant
from slam.compare.sweep import Run
from slam.compare.tables import groups
from slam.compare.wording import conclusions
from slam.run.results import BY_KEY, figures, rows, verdict, verdict_of_run

TEN, ONE, START, HUNDRED = "nees_10m_per_dof", "nees_1m_per_dof", "nees_per_dof", "nees_100m_per_dof"


@pytest.mark.parametrize(
    ("found", "runs", "words"),
    [
        ({}, 1, ""),
        ({START: 1.0}, 1, "covariances hold: NEES / 6 from the start is 1 (0.21 to 2.41 in 95 % of runs)"),
        ({START: 1.6}, 12, "covariances are too small: NEES / 6 from the start is 1.6 (0.70 to 1.35 in 95 %"),
        ({START: 0.1}, 1, "covariances are too large: NEES / 6 from the start is 0.1"),
        ({TEN: 1.2, START: 0.9}, 1, "covariances hold: NEES / 6 over 10 m is 1.2"),
        ({TEN: 1.2, START: 40.0}, 1, "covariances hold in part: NEES / 6 over 10 m is 1.2"),
        ({ONE: 4.0, START: 1.0}, 1, "covariances are too small: NEES / 6 over 1 m is 4"),
    ],
)
def test_the_verdict_is_by_the_best_figure_and_its_band(found, runs, words):
    said = verdict(found, runs)
    assert said.startswith(words) and bool(said) == bool(words)


def test_a_figure_that_says_something_else_is_named():
    assert verdict({TEN: 1.2, START: 40.0, HUNDRED: 0.05}).endswith(
        "; from the start 40: they are too small; over 100 m 0.05: they are too large"
    )


def summary(nees, lost=0):
    status = {"started": 1, "tracked": 39 - lost, "lost": lost}
    return {"frames": 40, "status": status, "consistency": {"mean NEES": 6 * nees, "dof": 6.0}}


def test_run_and_comparison_say_the_same_of_one_run(tmp_path):
    """At 2.2 the one said "too small", by half and double, and the other "consistent", by chance."""
    plan = Plan(("folder",), ("ekf",), replay=False)
    trial = Trial("folder", Variant("surf"), "ekf", 0, "closed loop")
    for nees in (0.3, 1.0, 2.2, 3.0):
        run = Run(trial, "completed", figures(summary(nees)), {}, tmp_path)
        (group,) = groups(plan, [run])
        assert conclusions(group).honesty == [f"ekf: {verdict_of_run(summary(nees))}."]


def test_frames_that_are_not_judged_are_counted_beside_the_verdict():
    assert verdict_of_run(summary(1.0, 7)).endswith("; not judged: 7 of 40 frames, whose pose was not measured")
    assert "not judged" not in verdict_of_run(summary(1.0))


def test_covariances_that_are_too_large_on_an_exact_world_say_why():
    for exact in (True, False):
        tree = summary(0.1)
        tree["consistency"]["exact calibration"] = exact
        assert ("this world's cameras have none" in verdict_of_run(tree)) == exact


def test_a_nees_of_which_most_stretches_had_no_covariance_is_no_figure():
    tree = summary(1.0)
    tree["consistency"] |= {"NEES over 10 m": 600.0, "no covariance over 10 m": 0.6}
    assert verdict_of_run(tree).startswith("covariances hold: NEES / 6 from the start")
    table = dict(rows([tree]))
    assert table["stretches over 10 m not judged [%]"] == ["60"] and not any(
        "NEES / 6 over" in label for label in table
    )


def test_the_nis_is_not_judged_by_a_value_that_no_run_has():
    """Below 1 the noise is smaller than assumed, which is no fault."""
    assert BY_KEY["nis_per_dof"].better == "" and "up to 1 is right" in BY_KEY["nis_per_dof"].label
