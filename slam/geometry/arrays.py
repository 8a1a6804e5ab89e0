"""Names of the array types that signatures use, and what NumPy takes long to begin where there are few numbers.

Shapes and units are in the docstrings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Which of `ids` (N,) are among `others` (M,): ``np.isin``, which takes several times as long for so few."""
    if len(ids) + len(members) > 2 * 500:  # 500: NumPy is quicker with more
        return np.isin(ids, members)
    return np.fromiter(map(set(members.tolist()).__contains__, ids.tolist()), bool, len(ids))


def among(count: int, rows: IndexArray | IdArray) -> BoolArray:
    """Which of so many places (count,) are among `rows`."""
    out = np.zeros(count, bool)
    out[rows] = True
    return out


def ascending(ids: IdArray) -> bool:
    """Whether ids (N,) ascend, each once."""
    return bool((ids[1:] > ids[:-1]).all())


def median(values: Array) -> float:
    """The median of some numbers: ``np.median``, which takes longer to begin than these need."""
    ordered = np.sort(values, axis=None)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
