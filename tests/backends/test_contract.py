"""The contract suite over every registered back end, and over a third-party one that comes by an entry point."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import backends
from slam import registry
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.interfaces import Backend
from slam.testing import BACKEND_CHECKS, RIG, RIGHT, RUNS, check_backend, estimation, findings, hostile, protocol
from slam.testing.__main__ import main
from tests.backends.fixed_map import FixedMapBackend
from tests.backends.scenes import path, scene

ROOT = Path(__file__).parents[2]


def by_name(check):
    return check.__name__


@pytest.mark.parametrize("check", BACKEND_CHECKS, ids=by_name)
@pytest.mark.parametrize("name", backends.names())
def test_contract(name, check):
    check(registry.resolve("backends", name))


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """An installed distribution with an entry point to a back end of its own."""
    info = tmp_path / "third_party-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[slam.backends]\n"
        "fixed_map = tests.backends.fixed_map:FixedMapBackend\n"
        "ekf = tests.backends.fixed_map:FixedMapBackend\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    registry._table.cache_clear()
    yield "fixed_map"
    monkeypatch.undo()
    registry._table.cache_clear()


@pytest.mark.parametrize("check", [*RUNS, *RIGHT], ids=by_name)
def test_third_party_contract(third_party, check):
    check(registry.resolve("backends", third_party))


def test_third_party_back_end_is_found_by_name(third_party):
    assert third_party in backends.names()
    backend = backends.create(third_party, RIG)
    assert isinstance(backend, FixedMapBackend) and isinstance(backend, Backend)


def test_third_party_cannot_take_a_built_in_name(third_party):
    assert registry.resolve("backends", "ekf") is not FixedMapBackend


class Forgetful(FixedMapBackend):
    def add(self, observations):
        super().add(observations.select(np.arange(len(observations)) > 0))


class Careless(FixedMapBackend):
    def predict(self, stamp):
        try:
            return super().predict(stamp)
        except MeasurementError:
            return super().predict(self.stamps[-1] + 0.1)


class Boastful(FixedMapBackend):
    def estimate(self, landmarks=True):
        self.covariance = 1e-6 * self.covariance
        return super().estimate(landmarks)


class Nosy(FixedMapBackend):
    def trajectory(self):
        self.poses[-1] = self.poses[-1] @ se3.exp(np.full(6, 1e-15))
        return super().trajectory()


class Twice(FixedMapBackend):
    def update(self, observations, guess=None):
        self.measured = False
        return super().update(observations, guess)


class Empty:
    def __init__(self, rig, models=None):
        pass


class Buggy(FixedMapBackend):
    def update(self, observations, guess=None):
        return self.nothing_of_this_name


TIER_OF = {
    Forgetful: "runs", Careless: "right", Boastful: "right", Nosy: "right", Twice: "right", Empty: "runs",
    Buggy: "runs", FixedMapBackend: "good",
}  # fmt: skip


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


def test_a_missing_method_and_a_defect_are_named():
    assert "predict, update, add, remove, estimate, positions, trajectory missing" in next(findings(Empty)).failure
    said = [found.failure for found in findings(Buggy, "runs") if found.failure]
    assert said[0] == "raised AttributeError: 'Buggy' object has no attribute 'nothing_of_this_name'"


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("nothing to say")


@pytest.mark.parametrize("error", [AssertionError(), AssertionError("\n"), SystemExit(), MuteError()])
def test_an_exception_that_says_nothing_fails_a_check(error):
    def failing(*args, **options):
        raise error

    assert next(findings(failing)).failure == f"raised {type(error).__name__}: without a message"


def test_a_status_that_is_a_word_is_told_from_the_right_one():
    class Wordy(FixedMapBackend):
        def update(self, observations, guess=None):
            report = super().update(observations, guess)
            return replace(report, status=str(report.status))

    failed = {found.check: found.failure for found in findings(Wordy, "runs") if found.failure}
    assert failed["answers_are_as_documented"].endswith("Wordy.update: status must be of type UpdateStatus, got str")


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (Nosy, hostile.queries_are_pure),
        (Twice, protocol.a_stamp_has_one_update),
        (FixedMapBackend, estimation.landmarks_are_corrected),  # it never updates its landmarks
    ],
)
def test_a_fault_is_found_by_its_own_check(broken, check):
    with pytest.raises(AssertionError):
        check(broken)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 120))
@pytest.mark.parametrize("name", backends.names())
def test_hostile_calls(name, seed):
    hostile.play(registry.resolve("backends", name), seed, calls=80)


@pytest.mark.slow
def test_tiers_are_taken_one_after_the_other():
    assert [found.tier for found in findings(FixedMapBackend, "right")] == ["runs"] * len(RUNS) + ["right"] * len(RIGHT)
    check_backend(FixedMapBackend, "right")
    with pytest.raises(ConfigurationError, match="unknown tier 'best'; known: runs, right, good"):
        check_backend(FixedMapBackend, "best")


def test_the_command_prints_how_far_a_back_end_comes(capsys, monkeypatch):
    monkeypatch.chdir(ROOT / "docs" / "examples")
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert main(["pose_fit:PoseFit", "--tier", "runs"]) == 0
    said = capsys.readouterr().out
    assert said.count("passes") == len(RUNS) and said.endswith("all passed\n")
    assert main(["tests.backends.test_contract:Careless", "--tier", "right"]) == 1
    said = capsys.readouterr().out
    assert "fails   time_must_increase\n          predict(0.0) after 0.0: was accepted" in said
    assert "Asked for: A stamp that is not finite" in said
    for name in ("nothing", "no_such_module:Backend", "pose_fit:Missing"):
        assert main([name]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("name", backends.names())
def test_a_question_between_predict_and_update_changes_nothing(name):
    data = scene(path(4, 0.1, np.array([0.2, 0.0, 0.5]), np.array([0.0, 0.05, 0.0])))
    asked, plain = (backends.create(name, RIG) for _ in range(2))
    for backend in (asked, plain):
        known: set[int] = set()
        for k, (stamp, _, seen) in enumerate(data):
            prediction = backend.predict(stamp)
            if backend is asked:
                assert backend.trajectory().stamps.tolist() == data.stamps[: k + 1].tolist()
                for T in (backend.trajectory().poses[-1], backend.estimate().T_world_left):
                    near = 1e-4 if name == "batch" else 0.0  # it solves for all poses, where the prediction does not
                    assert np.allclose(T, prediction.T_world_left, rtol=0, atol=near)
            old = np.isin(seen.ids, sorted(known))
            assert len(backend.update(seen.select(old)).used) == old.sum()
            backend.add(seen.select(~old))
            known |= set(seen.ids.tolist())
    assert np.allclose(asked.estimate().T_world_left, plain.estimate().T_world_left, atol=1e-6)
