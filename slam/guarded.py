"""What a back end need not write itself: a class decorator that refuses misuse, as `slam.interfaces.Backend` asks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from inspect import Parameter, signature
from operator import attrgetter
from typing import Any

import numpy as np

from slam.checks import require_guess, require_not_measured, require_stamp
from slam.data import Estimate, IdArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry.arrays import LandmarkRows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.third_party import checked


def guarded(backend: Any) -> Any:
    """A back end's class behind one that calls it only where `slam.interfaces.Backend` allows it.

    Refused, and nothing changed, are options that its constructor does not name, stamps that do not increase, calls
    before the first `predict`, ids that are not in the map, or to be added and in it, new landmarks without a depth, a
    second update of a stamp or one after an `add`, and guesses that are no pose. An update without rows is EMPTY.
    Answers are copies: what the caller writes into them does not reach the back end. An update that used no observation
    is EMPTY. A class without ``positions`` or ``trajectory`` has those of its estimates: a filter's, never revised.
    Of its additional methods those that move the camera or the map count here, too; but what these are given, it checks
    itself. A subclass inherits from its ``__wrapped__``, and is guarded itself.
    """
    own = {key: getattr(backend, key) for key in ("__qualname__", "__module__", "__doc__")}
    others = [name for name in dir(backend) if not name.startswith("_") and not hasattr(_Guarded, name)]
    passed = {name: vars(_Additional).get(name, property(attrgetter(f"_backend.{name}"))) for name in others}
    backend.__qualname__ += ".__wrapped__"  # where pickle finds it
    return type(backend.__name__, (_Guarded,), {**own, **passed, "__wrapped__": backend})


class _Guarded:
    """See `guarded`: each back end's class, in `__wrapped__`, has a subclass."""

    __wrapped__: Any

    def __init__(self, rig: StereoRig, models: EstimatorModels | None = None, **options: Any) -> None:
        self._name, self._rig, parameters = type(self).__name__, rig, signature(self.__wrapped__).parameters.values()
        unknown = set(options) - {p.name for p in parameters}
        if unknown and not any(p.kind is Parameter.VAR_KEYWORD for p in parameters):
            raise ConfigurationError(f"{self._name}: unknown option {min(unknown)!r}")
        self._backend = self.__wrapped__(rig, models or EstimatorModels(), **options)
        self._ids, self._measured, self._stamp = set[int](), True, float("nan")
        self._path: dict[float, Array] = {}  # poses by stamp, of a class without a trajectory

    def __getattr__(self, attribute: str) -> Any:  # what the back end sets itself
        if attribute.startswith("_"):
            raise AttributeError(attribute)
        return getattr(self._backend, attribute)

    def _require(self, ids: IdArray | Sequence[int] = (), known: bool = True, begun: bool = True) -> list[int]:
        """Ids as numbers; raises MeasurementError before the start, or where one is not in the map, or in it."""
        if begun and np.isnan(self._stamp):
            raise MeasurementError(f"{self._name}: the first call is predict")
        numbers: list[int] = np.asarray(ids, np.int64).tolist()
        for i in numbers:
            if (i in self._ids) is not known:
                raise MeasurementError(f"{self._name}: landmark {i} is {'not in' if known else 'already in'} the map")
        return numbers

    def _count(self, ids: IdArray) -> None:
        self._ids = self._ids | set(np.asarray(ids).tolist())

    def predict(self, stamp: float) -> Prediction:
        return self._to(stamp, self._backend.predict)

    def _to(self, stamp: float, predict: Callable[[float], Prediction]) -> Prediction:
        require_stamp(self._name, stamp, None if np.isnan(self._stamp) else self._stamp)
        found = deepcopy(predict(float(stamp)))
        self._stamp, self._measured = float(stamp), False
        if not hasattr(self._backend, "trajectory"):
            self._path[self._stamp] = found.T_world_left.copy()
        return found

    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        self._require(observations.ids)
        require_not_measured(self._name, self._measured)
        require_guess(self._name, guess)
        if not len(observations):
            self._measured = True
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        report = deepcopy(self._backend.update(observations, guess))
        self._measured = True
        if not hasattr(self._backend, "trajectory"):
            self._path[self._stamp] = self._backend.estimate(False).T_world_left.copy()
        if report.status is UpdateStatus.OK and not len(report.used):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", report.rejected)
        return report

    def add(self, observations: Observations) -> None:
        self._require(observations.ids, known=False)
        if not np.isfinite(self._rig.triangulate(observations.uv_left, observations.uv_right)).all():
            raise MeasurementError(f"{self._name}: a landmark has no right pixel or no positive depth")
        if len(observations):
            self._backend.add(observations)
            self._count(observations.ids)
            self._measured = True

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        gone = self._require(ids, begun=False)
        self._backend.remove(np.array(gone, np.int64))
        self._ids = self._ids - set(gone)

    def positions(self, ids: IdArray) -> Array:
        asked = np.array(self._require(ids), np.int64)
        if hasattr(self._backend, "positions"):
            return np.array(self._backend.positions(asked))
        found: Estimate = checked(self, "estimate", self._backend.estimate())
        return np.array(found.positions[LandmarkRows(found.ids).rows_of(asked)])

    def estimate(self, landmarks: bool = True) -> Estimate:
        self._require()
        found: Estimate = deepcopy(self._backend.estimate(landmarks))
        return found

    def trajectory(self) -> Trajectory:
        if hasattr(self._backend, "trajectory"):
            found: Trajectory = deepcopy(self._backend.trajectory())
            return found
        return Trajectory(np.array(list(self._path)), np.array(list(self._path.values())).reshape(-1, 4, 4))


class _Additional(_Guarded):
    """What counts, too, where the back end has it; all else that it has is passed on."""

    def predict_at_rest(self, stamp: float) -> Prediction:
        return self._to(stamp, self._backend.predict_at_rest)

    def revise(self, correct: Callable[[Array], Array]) -> None:
        self._backend.revise(correct)
        self._measured = True

    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        self._backend.insert(ids, positions, covariances)
        self._count(ids)

    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        self._require(ids, known=False)
        self._backend.place(ids, local, covariances)
        self._count(ids)
        self._measured = True
