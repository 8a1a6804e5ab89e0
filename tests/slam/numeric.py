"""Numerical derivatives, random covariances, and simple paths, for the tests."""

from collections.abc import Callable, Iterable
from itertools import accumulate

import numpy as np

from slam.geometry.trajectory import Trajectory


def jacobian(function: Callable, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Central differences of a vector function: rows are outputs, columns inputs."""
    x = np.asarray(x, float)
    columns = []
    for i in range(x.size):
        d = np.zeros_like(x)
        d.flat[i] = step
        columns.append((np.ravel(function(x + d)) - np.ravel(function(x - d))) / (2 * step))
    return np.stack(columns, axis=-1)


def chained(steps: Iterable[np.ndarray]) -> np.ndarray:
    """Poses (N + 1, 4, 4) from the origin on, a step (4, 4) from each to the next."""
    return np.array(list(accumulate(steps, np.matmul, initial=np.eye(4))))


def straight(count: int, step: float = 1.0, dt: float = 0.1) -> Trajectory:
    """So many poses straight on, a step [m] forward every `dt` [s]."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = step * np.arange(count)
    return Trajectory(dt * np.arange(count), poses)


def positive(n: int, rng: np.random.Generator) -> np.ndarray:
    """A random positive definite matrix (n, n)."""
    A = rng.standard_normal((n, n))
    return A @ A.T + np.eye(n)
