"""The contract suite over every registered back end, and over a third-party one that comes by an entry point."""

import pickle
import sys
from dataclasses import replace
from functools import partial
from inspect import getattr_static
from pathlib import Path

import numpy as np
import pytest

import backends
from backends.ekf import EkfBackend
from slam import registry
from slam.data import Observations
from slam.errors import MeasurementError
from slam.guarded import guarded
from slam.interfaces import Backend, MapBackend, RestingBackend, RevisingBackend
from slam.testing import GOOD, RIG, RIGHT, RUNS, check_backend, findings
from slam.testing.__main__ import main
from tests.backends.hostile_calls import play
from tests.scripts import load_script

ROOT = Path(__file__).parents[2]
CHECKS = (*RUNS, *RIGHT, *GOOD)


def by_name(check):
    return check.__name__


#: Every registered one, a filter whose landmarks soon leave its state, and that of the docs. The one that solves for
#: everything in every frame takes ten times as long as the others.
MADE = {name: registry.resolve("backends", name) for name in backends.names()} | {
    "few landmarks in the state": partial(EkfBackend, kept=3),
    "docs": load_script("docs/examples/small_filter.py").SmallFilter,
}
NAMES = [pytest.param(name, marks=pytest.mark.slow) if name == "batch" else name for name in MADE]


@pytest.mark.parametrize("check", CHECKS, ids=by_name)
@pytest.mark.parametrize("name", NAMES)
def test_contract(name, check):
    check(MADE[name])


class Guarded(EkfBackend):
    """Stands for one of somebody's own that has all additional methods, and refuses nothing itself."""

    def __init__(self, rig, models=None, mine=3):
        super().__init__(rig, models)

    def update(self, observations, guess=None):
        self.report = super().update(observations, guess)
        return self.report


Guarded = guarded(Guarded)


def test_a_guarded_back_end_keeps_count_of_its_additional_methods_and_gives_nothing_away():
    assert registry.options_of(Guarded, RIG) == {"mine": (3, Guarded)}
    backend, z = Guarded(RIG), RIG.project_stereo(np.array([[0.0, 0.0, 5.0]]))[0]
    seen = Observations(np.array([3]), z[:, :2], z[:, [2, 1]])
    backend.insert(np.array([3, 5]), np.array([[0.0, 0.0, 5.0]] * 2), 1e-2 * np.tile(np.eye(3), (2, 1, 1)))
    backend.remove([5])  # a map may change before the start
    backend.predict(0.0)
    assert backend.positions([3]).shape == (1, 3)  # ids in any form
    backend.predict_at_rest(1.0)
    with pytest.raises(MeasurementError, match="increase"):
        backend.predict(0.5)
    report = backend.update(seen)
    report.used[:] = 7
    assert backend.report.used.tolist() == [3]
    backend.predict(2.0)
    backend.place(np.array([4]), np.array([[0.0, 0.0, 4.0]]), 1e-2 * np.eye(3)[None])
    with pytest.raises(MeasurementError, match="one update"):
        backend.update(seen)
    with pytest.raises(MeasurementError, match="already"):
        backend.add(replace(seen, ids=np.array([4])))
    assert pickle.loads(pickle.dumps(backend)).estimate().ids.tolist() == [3, 4]
    small = MADE["docs"](RIG)
    assert getattr_static(backend, "recent", None) is not None  # as Python 3.12 looks for a protocol's methods
    assert isinstance(backend, MapBackend) and not isinstance(small, MapBackend | RestingBackend | RevisingBackend)


class Own(EkfBackend):
    """Stands for a back end from elsewhere, with an entry point."""


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """An installed distribution with entry points to a back end of its own."""
    info = tmp_path / "third_party-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party\nVersion: 1.0\n")
    place = "tests.backends.test_contract:Own"
    (info / "entry_points.txt").write_text(f"[slam.backends]\nown = {place}\nekf = {place}\n")
    monkeypatch.syspath_prepend(tmp_path)
    registry._table.cache_clear()
    yield "own"
    monkeypatch.undo()
    registry._table.cache_clear()


def test_third_party_back_end_is_found_by_name_and_takes_no_built_in_one(third_party):
    assert third_party in backends.names()
    backend = backends.create(third_party, RIG)
    assert type(backend).__name__ == "Own" and isinstance(backend, Backend)
    assert registry.resolve("backends", "ekf") is EkfBackend
    for check in RUNS:
        check(registry.resolve("backends", third_party))


class Forgetful(EkfBackend):
    def add(self, observations):
        super().add(observations.select(np.arange(len(observations)) > 0))


class Careless(EkfBackend):
    last = 0.0

    def predict(self, stamp):
        try:
            prediction = super().predict(stamp)
        except MeasurementError:
            prediction = super().predict(self.last + 0.1)
        self.last = prediction.stamp
        return prediction


class Boastful(EkfBackend):
    def estimate(self, landmarks=True):
        found = super().estimate(landmarks)
        return replace(found, covariance=1e-6 * found.covariance, covariances=1e-6 * found.covariances)


TIER_OF = {Forgetful: "runs", Careless: "right", Boastful: "right"}


@pytest.mark.slow
@pytest.mark.parametrize("broken", TIER_OF)
def test_the_suite_finds_what_is_broken_and_says_it_in_a_sentence(broken):
    failed = [found for found in findings(broken) if found.failure]
    assert failed[0].tier == TIER_OF[broken]
    for found in failed:
        assert len(found.failure) > 15 and "\n" not in found.failure, found
        assert len(found.demand.split()) > 4, found
    with pytest.raises(AssertionError, match=rf"{failed[0].check} \({failed[0].tier}\): .* Asked for: "):
        check_backend(broken)


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(k, marks=pytest.mark.slow) for k in range(100, 103))])
@pytest.mark.parametrize("name", NAMES[:-1])  # not what the page keeps short
def test_hostile_calls(name, seed):
    play(MADE[name], seed, calls=60 if seed < 100 else 80)


def test_the_command_prints_how_far_a_back_end_comes(capsys, monkeypatch):
    monkeypatch.chdir(ROOT / "docs" / "examples")
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert main(["pose_fit:PoseFit", "--tier", "runs"]) == 0
    said = capsys.readouterr().out
    assert said.count("passes") == len(RUNS) and said.endswith("all passed\n")
    assert main(["tests.backends.test_contract:Careless", "--tier", "right"]) == 1
    said = capsys.readouterr().out
    assert "predict (0.0) after 0.0: was accepted" in said
    assert "Asked for: Refused are calls before the start" in said
    assert main(["pose_fit:Missing"]) == 2 and len(capsys.readouterr().err.splitlines()) == 1
