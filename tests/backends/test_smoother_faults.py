"""gtsam fails: the smoother rebuilds from its measurement_log and the run goes on, the same way every time."""

from __future__ import annotations

import sys
from itertools import count

import gtsam
import numpy as np
import pytest
from backends.smoother.measurement_log import _invertible

from backends import smoother
from backends.smoother import SmootherBackend, rebuild, solver
from slam.data import Observations, UpdateStatus
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import RIG, path, run, scene, step

MODELS = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=0.5)
DT = 0.1

#: What gtsam throws from update and from its queries.
ERRORS = {
    "indeterminate": RuntimeError(
        "\nIndeterminant linear system detected while working near variable\n8646911284551352325 (Symbol: x5).\n"
    ),
    "cheirality": RuntimeError("Stereo Cheirality Exception"),
    "no such key": IndexError("invalid map<K, T> key"),
    "no such value": RuntimeError("Attempting to at the key 'x7', which does not exist in the Values."),
    "not in a table": KeyError("x7"),
    "bad argument": ValueError("removeFactorIndices: no such factor"),
}


def drive(frames: int = 22):
    return scene(path(frames, DT, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.03, 0.0])), points=150)


class Fails:
    """A method that fails in some of its calls, counted from 0, and otherwise does what it did."""

    def __init__(self, monkeypatch, owner, name: str, calls, error: Exception) -> None:
        self.original, self.calls, self.error, self.number = getattr(owner, name), set(calls), error, count()
        self.failed = 0
        fails = self

        def method(*args, **kwargs):
            if next(fails.number) in fails.calls:
                fails.failed += 1
                raise fails.error
            return fails.original(*args, **kwargs)

        monkeypatch.setattr(owner, name, method)


class BrokenIsam:
    """gtsam's ISAM2, but for one method that fails in some of its calls over all instances."""

    method = "update"
    calls: frozenset[int] = frozenset()
    error: Exception = RuntimeError()
    number = count()
    failed = 0

    def __init__(self, parameters) -> None:
        self._isam = ISAM2(parameters)

    def __getattr__(self, name: str):
        def broken(*args):
            if next(BrokenIsam.number) in BrokenIsam.calls:
                BrokenIsam.failed += 1
                raise BrokenIsam.error
            return getattr(self._isam, name)(*args)

        return broken if name == BrokenIsam.method else getattr(self._isam, name)


ISAM2 = gtsam.ISAM2


@pytest.fixture
def break_isam(monkeypatch):
    def set_up(method: str, calls, error: Exception) -> None:
        monkeypatch.setattr(gtsam, "ISAM2", BrokenIsam)
        for name, value in (("method", method), ("calls", frozenset(calls)), ("error", error), ("failed", 0)):
            monkeypatch.setattr(BrokenIsam, name, value)
        monkeypatch.setattr(BrokenIsam, "number", count())

    return set_up


def near_the_truth(backend, data, factor: float = 1.0) -> None:
    trajectory = backend.trajectory()
    assert len(trajectory) == len(data.poses)
    off = se3.log(se3.inverse(data.poses) @ trajectory.poses)
    assert np.abs(off[:, 3:]).max() < factor * 0.05 and np.abs(off[:, :3]).max() < factor * 0.01
    P = backend.estimate().covariance
    assert np.isfinite(P).all() and np.linalg.eigvalsh(P).min() > 0


@pytest.mark.parametrize("name", ERRORS)
def test_one_failure_costs_nothing(break_isam, name):
    data, untouched = drive(), SmootherBackend(RIG, MODELS)
    run(untouched, data)
    break_isam("update", [12], ERRORS[name])
    backend = SmootherBackend(RIG, MODELS)
    reports = run(backend, data)
    assert BrokenIsam.failed == 1
    assert all(r.status is UpdateStatus.OK for r in reports[1:]), "the measurements were used after the rebuild"
    # The same measurements and models; what is left is how far ISAM2 lets a variable move before it relinearises.
    off = se3.log(se3.inverse(untouched.trajectory().poses) @ backend.trajectory().poses)
    assert np.abs(off).max() < 1e-3
    near_the_truth(backend, data)


@pytest.mark.parametrize("failures", [2, 4, 12])
def test_failures_on_end_cost_a_step_at_most(break_isam, failures):
    data = drive()
    break_isam("update", range(12, 12 + failures), ERRORS["indeterminate"])
    backend = SmootherBackend(RIG, MODELS)
    reports = run(backend, data)
    assert BrokenIsam.failed == failures
    failed = [r for r in reports if r.status is UpdateStatus.FAILED]
    assert 1 <= len(failed) <= 4
    for report in failed:
        assert report.reason.startswith("smoother: gtsam: Indeterminant") and "\n" not in report.reason
        assert not len(report.used)
    assert all(r.status is UpdateStatus.OK for r in reports[-8:])
    near_the_truth(backend, data, factor=2)


@pytest.mark.parametrize("lag", [None, 12])
def test_failure_after_failure(break_isam, lag):
    data = drive(30)
    break_isam("update", range(5, 60, 4), ERRORS["cheirality"])
    backend = SmootherBackend(RIG, MODELS, lag=lag)
    reports = run(backend, data)
    assert BrokenIsam.failed > 8
    assert all(r.status is UpdateStatus.OK for r in reports[1:])
    near_the_truth(backend, data)


@pytest.mark.parametrize(
    ("method", "name"),
    [
        ("calculateEstimatePose3", "no such key"),
        ("calculateEstimatePoint3", "no such value"),
        ("calculateBestEstimate", "indeterminate"),
    ],
)
def test_reading_back_fails(break_isam, method, name):
    data = drive(20)
    break_isam(method, [3, 4, 25, 26, 27], ERRORS[name])
    backend = SmootherBackend(RIG, MODELS)
    known: set[int] = set()
    for stamp, _, seen in data:
        step(backend, stamp, seen, known)
        backend.trajectory()
    assert BrokenIsam.failed >= 2
    near_the_truth(backend, data)


@pytest.mark.parametrize(
    ("calls", "error"),
    [
        ([5], ERRORS["indeterminate"]),
        (range(5, 8), np.linalg.LinAlgError("singular matrix")),
        (range(3, 100), ERRORS["no such key"]),
    ],
    ids=["once", "three times", "always"],
)
def test_covariance_queries_never_fail(monkeypatch, calls, error):
    data = drive(14)
    fails = Fails(monkeypatch, solver, "_root_of", calls, error)
    backend = SmootherBackend(RIG, MODELS)
    known: set[int] = set()
    for stamp, _, seen in data:
        assert step(backend, stamp, seen, known).status in (UpdateStatus.OK, UpdateStatus.EMPTY)
        estimate = backend.estimate()
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0
        assert np.isfinite(estimate.covariances).all()
    assert fails.failed
    near_the_truth(backend, data)


def test_a_covariance_that_is_none_is_not_handed_on(monkeypatch):
    monkeypatch.setattr(solver, "_covariance_in", lambda variables, R, keys: np.full((6 * len(keys),) * 2, np.nan))
    data = drive(15)
    backend = SmootherBackend(RIG, MODELS)
    run(backend, data)
    near_the_truth(backend, data)
    # Carried on by the motion alone, the uncertainty grows without measurements to bound it: large, but honest.
    assert np.trace(backend.estimate().covariance[3:, 3:]) > 1e-4


def test_the_whole_problem_cannot_be_solved_for_a_while(break_isam, monkeypatch):
    data = drive()
    fails = Fails(monkeypatch, rebuild, "optimise", range(3), solver.SolverError("no solution"))
    monkeypatch.setattr(smoother.factor_graph, "optimise", rebuild.optimise)
    break_isam("update", [8, 14, 19], ERRORS["indeterminate"])
    backend = SmootherBackend(RIG, MODELS)
    reports = run(backend, data)
    assert fails.failed == 3
    assert all(r.status is UpdateStatus.OK for r in reports[-3:])
    near_the_truth(backend, data, factor=2)


def test_starting_over_keeps_the_path(break_isam):
    """Nothing but the poses can be put into the solver: the path keeps its shape, and the run goes on."""
    data = drive(30)
    backend = SmootherBackend(RIG, MODELS)
    known: set[int] = set()
    for k, (stamp, _, seen) in enumerate(data):
        if k == 15:
            backend.measurement_log.forget_measurements()
            backend._graph._rebuild(solved=False)
            before = backend.trajectory().poses
            off = se3.log(se3.inverse(data.poses[:15]) @ before)
            assert np.abs(off).max() < 0.05
        assert step(backend, stamp, seen, known).status in (UpdateStatus.OK, UpdateStatus.EMPTY)
    assert backend.measurement_log.history.restarted == 15
    near_the_truth(backend, data, factor=4)  # the first half's measurements are gone


def test_recovery_is_the_same_every_time(break_isam):
    data, ends = drive(), []
    for _ in range(2):
        break_isam("update", [6, 11, 12, 17], ERRORS["indeterminate"])
        backend = SmootherBackend(RIG, MODELS)
        run(backend, data)
        assert BrokenIsam.failed == 4
        ends.append((backend.trajectory().poses, backend.estimate()))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    np.testing.assert_array_equal(ends[0][1].covariance, ends[1][1].covariance)
    np.testing.assert_array_equal(ends[0][1].positions, ends[1][1].positions)


def test_impossible_measurements_do_not_end_a_run():
    """Random pixels for known landmarks, for some frames: gated, or solved as well as can be, but no exception."""
    data = drive(30)
    backend = SmootherBackend(RIG, MODELS)
    known: set[int] = set()
    rng = np.random.default_rng(0)
    for k, (stamp, _, seen) in enumerate(data):
        if 10 <= k < 15:
            left = rng.uniform((0, 0), (RIG.width - 1, RIG.height - 1), (len(seen), 2))
            right = left - np.stack([rng.uniform(-5, 60, len(seen)), np.zeros(len(seen))], axis=1)
            old = np.isin(seen.ids, list(known))
            backend.predict(stamp)
            backend.update(Observations(seen.ids, left, right).select(old))
        else:
            step(backend, stamp, seen, known)
        assert np.isfinite(backend.estimate().T_world_left).all()
    off = se3.log(se3.inverse(data.poses[-1]) @ backend.estimate().T_world_left)
    assert np.abs(off[3:]).max() < 0.2 and np.abs(off[:3]).max() < 0.05


@pytest.mark.parametrize("lag", [None, 12])
def test_a_call_that_is_interrupted_did_not_happen(lag):
    """A KeyboardInterrupt at any function call within the smoother: the same step again, and the run goes on."""
    data, known = drive(26), set()
    backend = SmootherBackend(RIG, MODELS, lag=lag)
    rng = np.random.default_rng(0)
    interrupted = 0
    for k, (stamp, _, seen) in enumerate(data):
        backend.predict(stamp)
        old = seen.select(np.isin(seen.ids, list(known)))
        new = seen.select(~np.isin(seen.ids, list(known)))
        for call in (lambda old=old: backend.update(old), lambda new=new: backend.add(new)):
            before = (
                backend.measurement_log.path.count,
                backend.measurement_log.measurements.count,
                len(backend.measurement_log.landmarks),
            )
            if k > 2 and interrupt(call, int(rng.integers(1, 150))):
                interrupted += 1
                measurement_log = backend.measurement_log
                assert (
                    measurement_log.path.count,
                    measurement_log.measurements.count,
                    len(measurement_log.landmarks),
                ) == before
                call()
            elif k <= 2:
                call()
        known.update(new.ids.tolist())
        assert backend.measurement_log.path.count == k + 1 or backend.measurement_log.path.count == k
    assert interrupted > 10
    near_the_truth(backend, data)


def one_frame(backend, stamp, seen, old):
    """The calls of a frame, in their order; each returns something to compare."""
    return (
        lambda: backend.predict(stamp).T_world_left,
        lambda: backend.estimate(landmarks=False).covariance,
        lambda: backend.update(seen.select(old)).used,
        lambda: backend.add(seen.select(~old)) or 0,
        lambda: backend.estimate().covariances,
    )


@pytest.mark.parametrize("lag", [None, 12])
def test_predictions_and_estimates_may_be_interrupted(lag):
    """The same call again gives what it gives without the interruption."""
    data, known = drive(20), set()
    whole, backend = (SmootherBackend(RIG, MODELS, lag=lag) for _ in range(2))
    rng, interrupted = np.random.default_rng(0), 0
    for k, (stamp, _, seen) in enumerate(data):
        old = np.isin(seen.ids, list(known))
        expected = [call() for call in one_frame(whole, stamp, seen, old)]
        for i, call in enumerate(one_frame(backend, stamp, seen, old)):
            if k and i in (0, 1, 4):
                interrupted += interrupt(call, int(rng.integers(1, 25)))
            np.testing.assert_allclose(call(), expected[i], rtol=1e-3, atol=1e-6)
        known.update(seen.ids.tolist())
    assert interrupted > 20
    near_the_truth(backend, data)


def interrupt(call, number: int) -> bool:
    """Whether a call was interrupted at the `number`-th function called within the smoother's modules."""
    left = number

    def profile(frame, event, _):
        nonlocal left
        if event == "call" and "backends/smoother/" in frame.f_code.co_filename.replace("\\", "/"):
            left -= 1
            if not left:
                raise KeyboardInterrupt

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.setprofile(before)
    return False


def test_covariances_that_gtsam_gives_with_some_digits_only_come_out_symmetric(monkeypatch):
    rough = np.random.default_rng(0).normal(0, 1e-6, (6, 6))
    monkeypatch.setattr(solver, "_root_of", lambda *_: None)
    monkeypatch.setattr(BrokenIsam, "marginalCovariance", lambda self, key: np.eye(6) + rough, raising=False)
    graph_solver = SmootherBackend(RIG, MODELS)._graph.solver
    monkeypatch.setattr(graph_solver, "_isam", BrokenIsam(gtsam.ISAM2Params()))
    P = graph_solver._joint_covariance([0])
    assert np.array_equal(P, P.T) and np.allclose(P, np.eye(6), atol=1e-5)


def test_covariances_that_rounding_has_made_singular_get_an_inverse():
    sound = np.diag([1.0, 4.0, 9.0])
    flat = np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])  # known but for one direction: no inverse
    negative = flat - 1e-14 * np.eye(3)
    mended = _invertible(np.stack([sound, flat, negative]))
    np.testing.assert_array_equal(mended[0], sound)
    assert (np.linalg.eigvalsh(np.linalg.inv(mended)) > 0).all()
    np.testing.assert_allclose(mended[1:], [flat, flat], atol=1e-8)
