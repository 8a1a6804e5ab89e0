"""Names of the array types that signatures use; shapes and units are in the docstrings."""

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
