"""Checks with calls that nobody should make: queries at every step, updates out of turn, and generated sequences."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from slam.data import Estimate, IdArray, Observations, UpdateReport, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry.se3 import Array
from slam.interfaces import Backend, MapBackend
from slam.testing.scene import DT, MODELS, RIG, Factory, Run, make_scene, raises, require, require_same, require_status

_SEQUENCES, _CALLS = 4, 60
_SIZE = 6  # landmarks in one call
_ROUNDING = 1e-7  # of correlations

#: Times from one prediction to the next [s], most of them ordinary ones.
_STEPS = (DT, DT, DT, DT, 1e-6, 1.0, 51.0, 1e3, 1e6, 1e9)
_NO_STEPS = (0.0, -1.0, float("nan"), float("inf"))


def queries_are_pure(factory: Factory) -> None:
    """Of two twins one is asked for everything at every step, the other never: they go on to the same bytes."""
    scene, dark = make_scene(14), (5, 6, 11)
    asked, silent = Run(factory), Run(factory)
    for k, seen in enumerate(scene.frames):
        seen = seen.select(np.zeros(0, np.intp)) if k in dark else seen
        for run in (asked, silent):
            prediction, report = run.step(k, seen, between=_ask if run is asked else None)
            if k == 8:
                gone = seen.ids[:4]
                run.backend.remove(gone)
                run.known -= set(gone.tolist())
            if run is asked:
                _ask(run.backend)
                first = prediction, report
        for what, a, b in zip(("prediction", "report"), first, (prediction, report)):
            _require_equal(a, b, f"{what} of frame {k} of a back end that was asked before, against one that was not")
        a, b = (run.backend.estimate(landmarks=False) for run in (asked, silent)) if k in dark else (None, None)
        _require_equal(a, b, f"pose of frame {k} of a back end that was asked before, against one that was not")
    _require_equal(asked.backend.trajectory(), silent.backend.trajectory(), "path of a back end that was asked before")
    _require_equal(asked.backend.estimate(), silent.backend.estimate(), "estimate of a back end that was asked before")


def _ask(backend: Backend) -> None:
    """Every question, twice."""
    for _ in range(2):
        backend.estimate(landmarks=False)
        backend.positions(backend.estimate().ids)
        backend.trajectory()
        if hasattr(backend, "recent"):
            backend.recent(4)


def _require_equal(found: Any, expected: Any, what: str) -> None:
    """Fail unless two results have the same attributes, to the last bit."""
    if found is None:
        return
    for name, value in vars(expected).items():
        a, b = np.asarray(getattr(found, name)), np.asarray(value)
        same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        require(same, f"{what}: {name} differs")


def a_stamp_has_one_update(factory: Factory) -> None:
    """A second update of a stamp is refused, whatever came of the first; so is one after an add."""
    scene, run = make_scene(4), Run(factory)
    run.step(0, scene.frames[0])
    seen = scene.frames[1].select(run.in_map(scene.frames[1]))
    old, new = seen.select(np.arange(len(seen) - 3)), seen.select(np.arange(len(seen) - 3, len(seen)))
    backend = run.backend
    backend.remove(new.ids)
    raises(MeasurementError, backend.update, old, what="an update of the first stamp after an add")
    for k, (first, status) in enumerate([(old, UpdateStatus.OK), (Observations.empty(), UpdateStatus.EMPTY)]):
        backend.predict(DT * (k + 1))
        require_status(backend.update(first), status, "the first update of a stamp")
        before = backend.estimate()
        for again in (old, Observations.empty()):
            raises(MeasurementError, backend.update, again, what="a second update of a stamp")
        _require_equal(backend.estimate(), before, "estimate after a second update, which was refused")
    backend.predict(DT * 3)
    backend.add(new)
    raises(MeasurementError, backend.update, old, what="an update after an add at the same stamp")


def rows_that_no_point_explains_are_rejected(factory: Factory) -> None:
    """An update with a row of negative disparity, or far outside the image, rejects that row and uses the others."""
    scene, run = make_scene(6), Run(factory)
    for k in range(5):
        run.step(k, scene.frames[k])
    seen = scene.frames[5].select(run.in_map(scene.frames[5]))
    left, right = seen.uv_left.copy(), seen.uv_right.copy()
    right[1, 0] = left[1, 0] + 50.0
    left[2], right[2] = (9e4, -9e4), (9e4 - 20.0, -9e4)
    run.backend.predict(5 * DT)
    report = run.backend.update(replace(seen, uv_left=left, uv_right=right))
    require_status(report, UpdateStatus.OK, "an update with two wrong rows")
    wrong = seen.ids[[1, 2]]
    require(np.isin(wrong, report.rejected).all(), "a row that no point explains was not rejected")
    assert_sound(run.backend.estimate(), "after an update with two wrong rows")


def hostile_calls_have_one_meaning(factory: Factory) -> None:
    """Generated sequences of hostile calls: each is taken or refused as the interface says, and all stays finite."""
    for seed in range(_SEQUENCES):
        play(factory, seed)


def play(factory: Factory, seed: int, calls: int = _CALLS) -> None:
    """One generated sequence.

    Raises:
        AssertionError: an answer is not of the kind that the interface promises; the message names seed and call.
    """
    life = _Life(factory(RIG, models=MODELS), np.random.default_rng(seed))
    for number in range(calls):
        what, refused, make, then = life.next()
        where = f"sequence {seed}, call {number}, {what}"
        try:
            answer = make()
        except MeasurementError as error:
            require(refused, f"{where}: was refused ({error})")
        except Exception as error:  # noqa: BLE001 - what somebody else's back end raises is the finding
            require(False, f"{where}: raised {type(error).__name__}: {error}")
        else:
            require(not refused, f"{where}: was accepted, MeasurementError is expected")
            then()
            life.check(where, answer)


class _Call(NamedTuple):
    """A call to make."""

    what: str  # its description
    refused: bool  # whether it must be refused
    make: Callable[[], Any]
    then: Callable[[], None]  # what the interface says has changed, where it is taken


class _Life:
    """A back end with what the interface says it holds, and the next call to make of it."""

    def __init__(self, backend: Any, rng: np.random.Generator) -> None:
        self.backend, self.rng = backend, rng
        self.stamps: list[float] = []
        self.ids: set[int] = set()
        self.measured, self.number = True, 0

    def next(self) -> _Call:
        """A call."""
        kinds = [self._predict] * 3 + [self._update] * 4 + [self._add] * 3 + [self._remove]
        kinds += [self._insert] if isinstance(self.backend, MapBackend) else []
        kinds += [self._revise] if hasattr(self.backend, "revise") else []
        return kinds[self.rng.integers(len(kinds))]()

    def check(self, where: str, answer: Any) -> None:
        """Fail unless everything that the back end says is finite and in order."""
        if hasattr(answer, "innovation"):
            assert_definite(answer.covariance[None], f"{where}: pose of the prediction")
            assert_definite(answer.innovation, f"{where}: innovations")
            require(set(answer.ids.tolist()) <= self.ids, f"{where}: predicts a landmark that is not in the map")
        if not self.stamps:
            return
        if self.rng.random() < 0.5:
            assert_sound(self.backend.estimate(landmarks=False), where)
        else:
            found = self.backend.estimate()
            assert_sound(found, where)
            require_same(found.ids, sorted(self.ids), f"{where}: landmarks")
            require(np.isfinite(self.backend.positions(found.ids)).all(), f"{where}: a position is not finite")
        if self.rng.random() < 0.3:
            path = self.backend.trajectory()
            require_same(path.stamps, self.stamps, f"{where}: stamps of the path")
            require(np.isfinite(path.poses).all(), f"{where}: a pose of the path is not finite")

    def _predict(self) -> _Call:
        last = self.stamps[-1] if self.stamps else 0.0
        stamp = last + float(self.rng.choice(_STEPS if self.rng.random() < 0.8 else _NO_STEPS))
        refused = not np.isfinite(stamp) or bool(self.stamps and stamp <= last) or abs(stamp) > 1e12
        return _Call(f"predict({stamp})", refused, lambda: self.backend.predict(stamp), lambda: self._predicted(stamp))

    def _predicted(self, stamp: float) -> None:
        self.stamps.append(stamp)
        self.measured = False

    def _update(self) -> _Call:
        known = self.rng.permutation(sorted(self.ids))[: self.rng.integers(3 * _SIZE)].astype(np.int64)
        unknown = self.rng.random() < 0.1
        seen = self._pixels(np.append(known, 10**6).astype(np.int64) if unknown else known)
        refused = not self.stamps or self.measured or unknown
        return _Call(f"update with {len(seen)} rows", refused, lambda: self._report(seen), lambda: self._added(()))

    def _report(self, seen: Observations) -> UpdateReport:
        report = self.backend.update(seen)
        if not len(seen):
            require_status(report, UpdateStatus.EMPTY, "an update without rows")
        return report

    def _add(self) -> _Call:
        seen = self._pixels(self._new_ids())
        if self.ids and self.rng.random() < 0.1:
            seen = replace(seen, ids=np.append(seen.ids[1:], min(self.ids))) if len(seen) else seen
        known = bool(self.ids & set(seen.ids.tolist()))
        flat = not (np.isfinite(seen.uv_right).all() and (seen.uv_left[:, 0] > seen.uv_right[:, 0]).all())
        refused, ids = not self.stamps or known or flat, seen.ids
        return _Call(
            f"add of {len(ids)} landmarks", refused, lambda: self.backend.add(seen),
            lambda: self._added(ids, self.measured or len(ids) > 0),
        )  # fmt: skip

    def _remove(self) -> _Call:
        share = self.rng.choice([0.0, 0.2, 1.0])
        ids = [i for i in sorted(self.ids) if self.rng.random() < share]
        unknown = self.rng.random() < 0.2
        ids += [10**6] if unknown else []
        return _Call(
            f"remove of {len(ids)} landmarks", unknown, lambda: self.backend.remove(ids),
            lambda: self.ids.difference_update(ids),
        )  # fmt: skip

    def _insert(self) -> _Call:
        ids, positions, covariances = _cloud(self._new_ids(), None, self.rng)
        flat = self.rng.random() < 0.2 and len(ids) > 0
        if flat:
            covariances[0] = self.rng.choice([0.0, -1.0]) * np.eye(3)
        return _Call(
            f"insert of {len(ids)} landmarks", flat, lambda: self.backend.insert(ids, positions, covariances),
            lambda: self._added(ids, self.measured),
        )  # fmt: skip

    def _revise(self) -> _Call:
        shift = self.rng.choice([0.0, 0.01])
        return _Call(
            f"revise by {shift} px", False, lambda: self.backend.revise(lambda z: z + shift), lambda: self._added(())
        )

    def _added(self, ids: Iterable[int], measured: bool = True) -> None:
        self.ids.update(int(i) for i in ids)
        self.measured = measured

    def _new_ids(self) -> IdArray:
        count = int(self.rng.integers(_SIZE + 1))
        self.number += count
        return np.arange(self.number - count, self.number, dtype=np.int64)

    def _pixels(self, ids: IdArray) -> Observations:
        """Pixels of landmarks: those of one fixed world, or wherever."""
        wild = self.rng.random() < 0.3
        points = np.array([_point(i) for i in ids.tolist()]).reshape(-1, 3)
        left, right = RIG.project(points)
        noise = self.rng.standard_normal((2, len(ids), 2))
        left, right = left + 0.5 * noise[0], right + 0.5 * noise[1]
        if wild and len(ids):
            row, kind = self.rng.integers(len(ids)), self.rng.integers(4)
            left[row] = (9e4, 9e4) if kind == 2 else left[row]
            right[row] = ((np.nan, np.nan), left[row] + [20.0, 0.0], (9e4 - 10.0, 9e4), left[row] - [1e-9, 0.0])[kind]
        return Observations(ids, left, right)


def _point(number: int) -> Array:
    """Position of a landmark [m] by its number."""
    return np.random.default_rng(number).uniform((-3, -2, 4), (3, 2, 12))


def _cloud(ids: Any, positions: Any = None, rng: np.random.Generator | None = None) -> tuple[IdArray, Array, Array]:
    """Landmarks with known positions: ids (N,), positions (N, 3) [m] in front of the first camera, covariances."""
    ids = np.asarray(ids, np.int64)
    points = np.array([_point(i) for i in ids.tolist()] if positions is None else positions, float).reshape(-1, 3)
    size = 0.01 if rng is None else float(rng.choice([1e-6, 0.01, 1.0]))
    return ids, points, size * np.tile(np.eye(3), (len(ids), 1, 1))


def assert_sound(found: Estimate, what: str) -> None:
    """Fail unless an estimate is finite and its covariances are positive definite."""
    require(np.isfinite(found.T_world_left).all(), f"{what}: the pose is not finite")
    require(np.isfinite(found.positions).all(), f"{what}: a landmark's position is not finite")
    assert_definite(found.covariance[None], f"{what}: pose")
    assert_definite(found.covariances, f"{what}: landmarks")


def assert_definite(P: Array, what: str) -> None:
    """Fail unless covariances (M, n, n) are finite, and positive definite whatever the units."""
    require(np.isfinite(P).all(), f"{what}: a covariance is not finite")
    variances = np.diagonal(P, axis1=1, axis2=2)
    require((variances > 0).all(), f"{what}: a variance is not positive")
    sigma = np.sqrt(variances)
    least = np.linalg.eigvalsh(P / sigma[:, :, None] / sigma[:, None, :]).min(initial=0.0)
    require(least > -_ROUNDING, f"{what}: a covariance is not positive definite ({least:.2g} of its variances)")
