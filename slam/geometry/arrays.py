"""Arrays: names of their types, tables with a row for each of the same things, and rows looked up by ids.

Shapes and units are in the docstrings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam.errors import MeasurementError

_D = TypeVar("_D")

#: Real numbers; computed in float64.
Array = NDArray[np.floating[Any]]
IdArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
#: Places in arrays: row or slot numbers.
IndexArray = NDArray[np.intp]


def narrowed(values: np.ndarray, dtype: type[np.floating[Any]]) -> NDArray[Any]:
    """The values in a smaller floating-point type; those below its range become 0, also where NumPy is to raise."""
    with np.errstate(under="ignore"):
        return values.astype(dtype)


def isin(ids: IdArray | IndexArray, members: IdArray | IndexArray) -> BoolArray:
    """Which of `ids` (N,) are among `members` (M,): ``np.isin``, which takes several times as long for so few."""
    if not len(members):
        return np.zeros(len(ids), bool)
    ordered = np.sort(members)
    return np.asarray(ordered[np.minimum(ordered.searchsorted(ids), len(ordered) - 1)] == ids)


def among(count: int, rows: IndexArray | IdArray) -> BoolArray:
    """Which of so many places (count,) are among `rows`."""
    out = np.zeros(count, bool)
    out[rows] = True
    return out


def median(values: Array) -> float:
    """The median of some numbers: ``np.median``, which takes longer to begin than these need."""
    ordered = np.sort(values, axis=None)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def quantile(values: Array, share: float) -> float:
    """The quantile of values (N,), at least one: as NumPy's, without its cost for a few."""
    place = share * (len(values) - 1)
    k = int(place)
    ordered = np.sort(values)[k : k + 2]
    return float(ordered[0] + (place - k) * (ordered[-1] - ordered[0]))


def changed(data: _D, **values: Any) -> _D:
    """A frozen dataclass with other values of some fields: ``dataclasses.replace`` in a third of its time, unchecked.

    What the original has computed and kept is found anew.
    """
    new, names, own = object.__new__(type(data)), data.__dataclass_fields__, vars(data)  # type: ignore[attr-defined]
    own = own if len(own) == len(names) else {name: own[name] for name in names}
    vars(new).update(own, **values)
    return new


@dataclass(frozen=True, eq=False)
class Table:
    """Arrays with as many rows each; those that derive from it name them as their fields."""

    @property
    def arrays(self) -> tuple[Any, ...]:
        """All arrays, as compiled code takes them."""
        return tuple(map(vars(self).__getitem__, self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def select(self, rows: Any) -> Self:
        """Some of the rows: a mask, indices, or a slice."""
        return type(self)(*[column[rows] for column in self.arrays])

    def joined(self, other: Self) -> Self:
        """These rows, then others."""
        return type(self)(*map(np.concatenate, zip(self.arrays, other.arrays)))


@dataclass(frozen=True, eq=False)
class LandmarkRows(Table):
    """A row for each landmark of a map."""

    ids: IdArray  # (N,), negative for one that is in the map no more

    @cached_property
    def order(self) -> IndexArray:
        """Rows of the landmarks in the map, by ascending id."""
        rows = self.ids.argsort(kind="stable")
        return rows[self.ids[rows].searchsorted(0) :]

    def rows_of(self, ids: IdArray | Sequence[int]) -> IndexArray:
        """Rows (M,) of landmarks; MeasurementError where one is not in the map."""
        ids, order = np.asarray(ids, np.int64), self.order
        present = self.ids[order]
        at = np.minimum(present.searchsorted(ids), len(order) - 1)
        bad = present[at] != ids if len(order) else np.ones(len(ids), bool)
        if bad.any():
            raise MeasurementError(f"landmark {ids[bad][0]} is not in the map")
        return order[at]

    def require_new(self, ids: IdArray) -> None:
        """Raise MeasurementError where a landmark is in the map already."""
        taken = isin(ids, self.ids)
        if taken.any():
            raise MeasurementError(f"landmark {ids[taken][0]} is in the map already")
