"""Generated sequences of calls that nobody should make: each is taken or refused as the interface says."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam.data import Estimate, IdArray, Observations, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry.se3 import Array
from slam.interfaces import MapBackend
from slam.testing.scene import DT, MODELS, RIG, Factory, cloud, point, require, require_same, require_status

_CALLS = 60
_SIZE = 6  # landmarks in one call
_ROUNDING = 1e-7  # of correlations

#: Times from one prediction to the next [s], most of them ordinary ones.
_STEPS = (DT, DT, DT, DT, 1e-6, 1.0, 51.0, 1e3, 1e6, 1e9)
_NO_STEPS = (0.0, -1.0, float("nan"), float("inf"))


def play(factory: Factory, seed: int, calls: int = _CALLS) -> None:
    """One generated sequence; AssertionError, with seed and call, where an answer is not of the promised kind."""
    life = _Life(factory(RIG, models=MODELS), np.random.default_rng(seed))
    for number in range(calls):
        call = life.next()
        where = f"sequence {seed}, call {number}, {call.what}"
        try:
            answer = call.make()
        except MeasurementError as error:
            require(call.refused, f"{where}: was refused ({error})")
        except Exception as error:  # noqa: BLE001 - what somebody else's back end raises is the finding
            require(False, f"{where}: raised {type(error).__name__}: {error}")
        else:
            require(not call.refused, f"{where}: was accepted, MeasurementError is expected")
            life.after(call)
            life.check(where, call, answer)


@dataclass(frozen=True)
class _Call:
    """A call to make, and what the interface says has changed where it is taken."""

    what: str  # its description
    refused: bool  # whether it must be refused
    make: Callable[[], Any]
    added: tuple[int, ...] = ()  # ids of landmarks
    removed: tuple[int, ...] = ()
    stamp: float | None = None  # to which it advances
    measured: bool | None = None  # whether the stamp has no update any more; None for as before
    empty: bool = False  # whether it is an update without rows


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
        kinds += [self._place, self._insert] if isinstance(self.backend, MapBackend) else []
        kinds += [self._revise] if hasattr(self.backend, "revise") else []
        return kinds[self.rng.integers(len(kinds))]()

    def after(self, call: _Call) -> None:
        """Keep count of a call that was taken."""
        self.stamps += [] if call.stamp is None else [call.stamp]
        self.ids = (self.ids | set(call.added)) - set(call.removed)
        self.measured = self.measured if call.measured is None else call.measured

    def check(self, where: str, call: _Call, answer: Any) -> None:
        """Fail unless everything that the back end says is finite and in order."""
        if call.empty:
            require_status(answer, UpdateStatus.EMPTY, "an update without rows")
        if hasattr(answer, "innovation"):
            assert_definite(answer.covariance[None], f"{where}: pose of the prediction")
            assert_definite(answer.innovation, f"{where}: innovations")
            require(set(answer.ids.tolist()) <= self.ids, f"{where}: predicts a landmark that is not in the map")
        if not self.stamps:
            return
        whole = self.rng.random() >= 0.5
        estimate = self.backend.estimate(landmarks=whole)
        assert_sound(estimate, where)
        if whole:
            require_same(estimate.ids, sorted(self.ids), f"{where}: landmarks")
            require(np.isfinite(self.backend.positions(estimate.ids)).all(), f"{where}: a position is not finite")
        if self.rng.random() < 0.3:
            path = self.backend.trajectory()
            require_same(path.stamps, self.stamps, f"{where}: stamps of the path")
            require(np.isfinite(path.poses).all(), f"{where}: a pose of the path is not finite")

    def _predict(self) -> _Call:
        last = self.stamps[-1] if self.stamps else 0.0
        stamp = last + float(self.rng.choice(_STEPS if self.rng.random() < 0.8 else _NO_STEPS))
        refused = not np.isfinite(stamp) or bool(self.stamps and stamp <= last) or abs(stamp) > 1e12
        make = lambda: self.backend.predict(stamp)  # noqa: E731
        return _Call(f"predict({stamp})", refused, make, stamp=stamp, measured=False)

    def _update(self) -> _Call:
        ids = self.rng.permutation(sorted(self.ids))[: self.rng.integers(3 * _SIZE)].astype(np.int64)
        strange = self.rng.random() < 0.1
        seen = self._pixels(np.append(ids, 10**6).astype(np.int64) if strange else ids)
        refused, make = not self.stamps or self.measured or strange, lambda: self.backend.update(seen)
        return _Call(f"update with {len(seen)} rows", refused, make, measured=True, empty=not len(seen))

    def _add(self) -> _Call:
        seen = self._pixels(self._new_ids())
        if len(seen) and self.ids and self.rng.random() < 0.1:
            seen = replace(seen, ids=np.append(seen.ids[1:], min(self.ids)))
        ids = tuple(seen.ids.tolist())
        flat = not (np.isfinite(seen.uv_right).all() and (seen.uv_left[:, 0] > seen.uv_right[:, 0]).all())
        refused, make = not self.stamps or bool(self.ids & set(ids)) or flat, lambda: self.backend.add(seen)
        return _Call(f"add of {len(ids)} landmarks", refused, make, added=ids, measured=self.measured or bool(ids))

    def _remove(self) -> _Call:
        share, strange = self.rng.choice([0.0, 0.2, 1.0]), self.rng.random() < 0.2
        ids = [i for i in sorted(self.ids) if self.rng.random() < share] + ([10**6] if strange else [])
        make = lambda: self.backend.remove(ids)  # noqa: E731
        return _Call(f"remove of {len(ids)} landmarks", strange, make, removed=tuple(ids))

    def _place(self) -> _Call:
        ids, local, covariances = cloud(self._new_ids(), None, self._variance())
        behind = self.rng.random() < 0.2 and len(ids) > 0
        if behind:
            local[0, 2] = self.rng.choice([-5.0, 0.0, float("nan")])
        refused, make = not self.stamps or behind, lambda: self.backend.place(ids, local, covariances)
        measured, added = self.measured or len(ids) > 0, tuple(ids.tolist())
        return _Call(f"place of {len(ids)} landmarks", refused, make, added=added, measured=measured)

    def _insert(self) -> _Call:
        ids, positions, covariances = cloud(self._new_ids(), None, self._variance())
        flat = self.rng.random() < 0.2 and len(ids) > 0
        if flat:
            covariances[0] = self.rng.choice([0.0, -1.0]) * np.eye(3)
        make = lambda: self.backend.insert(ids, positions, covariances)  # noqa: E731
        return _Call(f"insert of {len(ids)} landmarks", flat, make, added=tuple(ids.tolist()))

    def _revise(self) -> _Call:
        shift = self.rng.choice([0.0, 0.01])
        return _Call(f"revise by {shift} px", False, lambda: self.backend.revise(lambda z: z + shift), measured=True)

    def _variance(self) -> float:
        return float(self.rng.choice([1e-6, 0.01, 1.0]))

    def _new_ids(self) -> IdArray:
        count = int(self.rng.integers(_SIZE + 1))
        self.number += count
        return np.arange(self.number - count, self.number, dtype=np.int64)

    def _pixels(self, ids: IdArray) -> Observations:
        """Pixels of landmarks: those of one fixed world, or wherever."""
        wild = self.rng.random() < 0.3
        left, right = RIG.project(np.array([point(i) for i in ids.tolist()]).reshape(-1, 3))
        noise = self.rng.standard_normal((2, len(ids), 2))
        left, right = left + 0.5 * noise[0], right + 0.5 * noise[1]
        if wild and len(ids):
            row, kind = self.rng.integers(len(ids)), self.rng.integers(4)
            left[row] = (9e4, 9e4) if kind == 2 else left[row]
            right[row] = ((np.nan, np.nan), left[row] + [20.0, 0.0], (9e4 - 10.0, 9e4), left[row] - [1e-9, 0.0])[kind]
        return Observations(ids, left, right)


def assert_sound(estimate: Estimate, what: str) -> None:
    """Fail unless an estimate is finite and its covariances are positive definite."""
    require(np.isfinite(estimate.T_world_left).all(), f"{what}: the pose is not finite")
    require(np.isfinite(estimate.positions).all(), f"{what}: a landmark's position is not finite")
    assert_definite(estimate.covariance[None], f"{what}: pose")
    assert_definite(estimate.covariances, f"{what}: landmarks")


def assert_definite(P: Array, what: str) -> None:
    """Fail unless covariances (M, n, n) are finite, and positive definite whatever the units."""
    require(np.isfinite(P).all(), f"{what}: a covariance is not finite")
    variances = np.diagonal(P, axis1=1, axis2=2)
    require((variances > 0).all(), f"{what}: a variance is not positive")
    sigma = np.sqrt(variances)
    least = np.linalg.eigvalsh(P / sigma[:, :, None] / sigma[:, None, :]).min(initial=0.0)
    require(least > -_ROUNDING, f"{what}: a covariance is not positive definite ({least:.2g} of its variances)")
