from __future__ import annotations

import pytest

from slam.commands.compare import variants_of
from slam.compare.plan import CLOSED_LOOP, Plan, Variant, parse_variant
from slam.errors import ConfigurationError

WORLDS = ("synthetic:aisle?frames=30", "synthetic:box")


def test_trials_are_paired_and_have_folders_of_their_own():
    plan = Plan((*WORLDS, "/data/kitti/00", "/data/kitti/01"), ("ekf", "smoother"), trials=3)
    trials = list(plan.trials_of(CLOSED_LOOP))
    assert len(trials) == 2 * (3 + 3 + 1 + 1)
    assert len({t.folder for t in trials}) == len(trials)
    assert trials[2].source == "synthetic:aisle?frames=30&seed=1"
    assert next(t.source for t in trials if "box" in t.sequence) == "synthetic:box?seed=0"
    assert trials[-1].source == "/data/kitti/01"


def test_names_that_differ_in_odd_characters_or_early_alone_stay_apart():
    long = "x" * 80
    names = ("synthetic:box?box=1", "synthetic:box?box_1", f"/a/{long}", f"/b/{long}")
    trials = Plan(names, ("ekf",)).trials_of(CLOSED_LOOP)
    assert len({t.folder for t in trials}) == 4


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (((), ("ekf",)), "no sequence"),
        ((WORLDS, ()), "no back end"),
        ((WORLDS, ("ekf", "ekf")), "twice"),
        ((("synthetic:box?seed=3",), ("ekf",)), "seed"),
        ((("/data",), ("ekf",), (Variant("s", "simulated"),)), "worlds alone"),
        ((WORLDS, ("ekf",), (Variant("surf"),), 0), "at least one trial"),
    ],
)
def test_bad_plans(arguments, word):
    with pytest.raises(ConfigurationError, match=word):
        Plan(*arguments)


def test_variants():
    assert parse_variant("small:surf:frontend.descriptor=16:map.max_landmarks=100") == Variant(
        "small", "surf", ("frontend.descriptor=16", "map.max_landmarks=100")
    )
    assert parse_variant("few:map.max_landmarks=100", ("a.b=1",)) == Variant(
        "few", "surf", ("a.b=1", "map.max_landmarks=100")
    )
    for bad in ("", ":surf", "a:surf:nothing"):
        with pytest.raises(ConfigurationError, match="form"):
            parse_variant(bad)
    assert variants_of([], [], ["a.b=1"]) == (Variant("surf", "surf", ("a.b=1",)),)
    assert [v.name for v in variants_of(["surf", "simulated"], ["x:a.b=1"], [])] == ["surf", "simulated", "x"]


def test_no_more_trials_and_workers_than_anybody_has(tmp_path):
    from slam.commands.compare import compare

    with pytest.raises(ConfigurationError, match="at most 100000 trials"):
        Plan(("synthetic:desk",), ("ekf",), trials=10**9)
    with pytest.raises(ConfigurationError, match="at most 1024 workers"):
        compare(Plan(("synthetic:desk",), ("ekf",)), tmp_path, workers=10**9)
