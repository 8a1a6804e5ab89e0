"""The incremental solver: gtsam's ISAM2, its settings, and its failures as one exception."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from backends.smoother.reference_pose import ReferencePose
from backends.smoother.variables import ballast_key, size_of
from slam.errors import SlamError
from slam.geometry.se3 import Array

_T = TypeVar("_T")

#: What gtsam throws when it cannot solve.
FAILURES = (RuntimeError, ValueError, LookupError)

#: cost: ISAM2 starts from scratch whenever over 65 % of all variables are touched, as they are in a small map. So many
#: variables that nothing depends on keep it incremental from the start.
_BALLAST = 2000


class _SeenEnoughError(Exception):
    """Ends a computation of gtsam once it has given what is wanted."""


class SolverError(SlamError):
    """The solver failed; the message is gtsam's, in one line."""


@dataclass
class Change:
    """What one update puts into the problem and takes out of it.

    Attributes:
        factors: new factors.
        values: first values of new variables.
        removed: slots of factors to take out.
        late: variables that will be measured again soon, to be eliminated late; those of the first set before those of
            the second. Otherwise a landmark seen from many poses may be eliminated before them, which connects all
            of these.
    """

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    removed: list[int] = field(default_factory=list)
    late: tuple[set[int], set[int]] = field(default_factory=lambda: (set(), set()))


class Solver:
    """ISAM2 with the settings that hold for smart stereo factors.

    Args:
        thresholds: how far each kind of variable may move before it is relinearised.
        variables: expected number at most; None for no bound.

    Attributes:
        seconds: CPU time spent in gtsam so far.
    """

    def __init__(self, thresholds: gtsam.ISAM2ThresholdMap, variables: int | None = None) -> None:
        self.seconds = 0.0
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(thresholds)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        parameters.cacheLinearizedFactors = True
        self._isam = gtsam.ISAM2(parameters)
        self._ballast = _BALLAST if variables is None else min(variables, _BALLAST)
        self._guarded(lambda: self._isam.update(*_ballast(self._ballast)))

    def update(self, change: Change, thresholds: gtsam.ISAM2ThresholdMap | None = None) -> list[int]:
        """One update; returns the slots of the new factors, in their order.

        Args:
            change: what is new.
            thresholds: how far each kind of variable may move from now on; None for the same as before.

        Raises:
            SolverError: gtsam failed. The solver is then broken and has to be rebuilt.
        """
        if thresholds is not None:
            self._isam.params().setRelinearizeThreshold(thresholds)  # gtsam hands out its own, not a copy
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = change.removed
        if any(change.late):
            parameters.constrainedKeys = _groups(*change.late)
        result = self._guarded(lambda: self._isam.update(change.factors, change.values, parameters))
        return result.getNewFactorsIndices()

    def converge(self, change: Change, thresholds: gtsam.ISAM2ThresholdMap, rounds: int) -> None:
        """At most so many updates without new factors, until no variable moves by more than the thresholds.

        Raises:
            SolverError: gtsam failed.
        """
        self._isam.params().setRelinearizeThreshold(thresholds)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.constrainedKeys = _groups(*change.late)
        for _ in range(rounds):
            result = self._guarded(lambda: self._isam.update(change.factors, change.values, parameters))
            if not result.getVariablesRelinearized():
                break

    def poses(self, keys: Iterable[int]) -> Array:
        """Pose variables (K, 4, 4)."""
        isam = self._isam
        return self._guarded(lambda: np.array([isam.calculateEstimatePose3(key).matrix() for key in keys]))

    def points(self, keys: Iterable[int]) -> Array:
        """Point variables (K, 3)."""
        isam = self._isam
        found = self._guarded(lambda: [isam.calculateEstimatePoint3(key) for key in keys])
        return np.array(found).reshape(-1, 3)

    def joint_covariance(self, keys: list[int]) -> Array:
        """Joint covariance of pose variables, in the order of `keys`; quick for those that were eliminated last.

        Raises:
            SolverError: gtsam failed.
        """
        P = self._guarded(lambda: self._joint_covariance(keys))
        if not np.isfinite(P).all() or (np.diag(P) <= 0).any():
            raise SolverError("gtsam: a covariance is not finite and positive")
        return P

    def point_covariances(self, keys: list[int], newest: int, held: ReferencePose | None = None) -> dict[int, Array]:
        """Covariances (3, 3) of those point variables that were eliminated together with the newest pose, or after it.

        As if the pose `held` was not held.

        Raises:
            SolverError: gtsam failed.
        """
        return self._guarded(lambda: self._point_covariances(keys, newest, held))

    def _point_covariances(self, keys: list[int], newest: int, held: ReferencePose | None) -> dict[int, Array]:
        root = _root_of(self._isam, newest)
        if root is None or (held is not None and held.key not in root[0]):
            return {}
        variables, R = root
        starts = dict(zip(variables, np.cumsum([0, *map(size_of, variables)]).tolist()))
        half = np.asarray(solve_triangular(R, np.eye(len(R))))
        rows = {key: half[starts[key] : starts[key] + 3] for key in keys if key in starts}
        if held is None:
            return {key: part @ part.T for key, part in rows.items()}
        own = half[starts[held.key] : starts[held.key] + 6]
        P = own @ own.T
        return {key: held.released(part @ part.T, part @ own.T, P) for key, part in rows.items()}

    def _joint_covariance(self, keys: list[int]) -> Array:
        root = _root_of(self._isam, keys[-1])
        if root is not None and set(keys) <= set(root[0]):
            return _covariance_in(*root, keys)
        if len(keys) == 1:
            P = np.asarray(self._isam.marginalCovariance(keys[0]))
        else:
            P = np.asarray(self._isam.jointMarginalCovariance(keys).fullMatrix())
        return np.asarray(0.5 * (P + P.T))  # what is hardly known comes back symmetric to some digits only

    def values(self) -> gtsam.Values:
        """All variables, from a complete back-substitution."""
        return self._guarded(self._isam.calculateBestEstimate)

    def factors(self) -> Iterator[tuple[int, gtsam.NonlinearFactor]]:
        """All factors but those of the ballast, with their slots."""
        graph = self._isam.getFactorsUnsafe()
        for slot in range(self._ballast, graph.size()):
            factor = graph.at(slot)
            if factor is not None:
                yield slot, factor

    def _guarded(self, call: Callable[[], _T]) -> _T:
        start = time.process_time()
        try:
            return call()
        except FAILURES as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            raise SolverError("gtsam: " + (" ".join(lines[:3]) or type(error).__name__)) from error
        finally:
            self.seconds += time.process_time() - start


def _groups(*late: set[int]) -> gtsam.KeyGroupMap:
    """Sets of variables in the order of elimination, in gtsam's form; variables in none of them come first."""
    groups = gtsam.KeyGroupMap()
    for number, keys in enumerate(filter(None, late), start=1):
        for key in keys:
            groups.insert2(key, number)
    return groups


def _root_of(isam: gtsam.ISAM2, key: int) -> tuple[list[int], Array] | None:
    """The root of the Bayes tree, if `key` is in it: its variables, and its triangular matrix R with RᵀR = P⁻¹.

    gtsam's Python interface does not give the tree, but it passes the root's conditional to the function that
    eliminates other variables from it. gtsam's own function would square the matrix and factorise it again. The matrix
    is triangular already, so its last rows are about the variables that were eliminated last.
    """
    found: list[tuple[list[int], Array]] = []

    def look(graph: gtsam.GaussianFactorGraph, _: gtsam.Ordering) -> Any:
        root = graph.at(0)
        if graph.size() == 1 and isinstance(root, gtsam.GaussianConditional) and not root.S().size:
            found.append((root.keys(), root.R()))
        raise _SeenEnoughError

    with suppress(_SeenEnoughError):
        isam.marginalFactor(key, look)
    return found[0] if found else None


def _covariance_in(variables: list[int], R: Array, keys: list[int]) -> Array:
    """Joint covariance of pose variables in the root."""
    sizes = [size_of(v) for v in variables]
    starts = dict(zip(variables, np.cumsum([0, *sizes]).tolist()))
    columns = np.concatenate([np.arange(starts[key], starts[key] + 6) for key in keys])
    first = int(columns.min())
    unit = np.zeros((len(R) - first, len(columns)))
    unit[columns - first, np.arange(len(columns))] = 1
    half = solve_triangular(R[first:, first:], unit, trans="T")
    return half.T @ half


@cache
def _ballast(count: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Variables that nothing depends on, with their factors; gtsam changes neither."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
    for i in range(count):
        key = ballast_key(i)
        values.insert(key, np.zeros(1))
        graph.add(gtsam.PriorFactorVector(key, np.zeros(1), noise))
    return graph, values
