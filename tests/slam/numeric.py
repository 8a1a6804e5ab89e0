"""Numerical derivatives for the tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def jacobian(function: Callable, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Central differences of a vector function: rows are outputs, columns inputs."""
    x = np.asarray(x, float)
    columns = []
    for i in range(x.size):
        d = np.zeros_like(x)
        d.flat[i] = step
        columns.append((np.ravel(function(x + d)) - np.ravel(function(x - d))) / (2 * step))
    return np.stack(columns, axis=-1)
