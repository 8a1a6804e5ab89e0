"""SURF descriptors computed plainly and slowly, on the conventions of OpenCV's implementation: the reference.

Where the front end takes box means from the integral image, this samples every pixel of a turned window, shrinks the
window to 21x21 cells and takes differences. On `surf_reference.npz` it agrees with OpenCV's own output to a median
cosine of 0.9999.
"""

from __future__ import annotations

import cv2
import numpy as np

CELLS = 21


def plain_descriptors(image: np.ndarray, uv: np.ndarray, size: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Unit descriptors (N, 64) of features at pixels (N, 2), of sizes (N,) [px] and angles (N,) [rad], y down."""
    line = np.exp(-((np.arange(CELLS - 1) - 0.5 * (CELLS - 2)) ** 2) / (2 * 3.3**2))
    weights = np.outer(line, line)
    return np.array([_describe(image, *row, weights) for row in zip(uv, size, angle)]).reshape(-1, 64)


def _describe(image: np.ndarray, at: np.ndarray, size: float, angle: float, weights: np.ndarray) -> np.ndarray:
    """One descriptor."""
    cells = _window(image, at, int(CELLS * size * 1.2 / 9), angle).astype(float)
    falling, rising = cells[1:, 1:] - cells[:-1, :-1], cells[:-1, 1:] - cells[1:, :-1]
    dx, dy = (falling + rising) * weights, (falling - rising) * weights
    sums = [part.reshape(4, 5, 4, 5).sum(axis=(1, 3)) for part in (dx, dy, np.abs(dx), np.abs(dy))]
    row = np.stack(sums, axis=-1).ravel()
    return row / max(np.linalg.norm(row), 1e-12)


def _window(image: np.ndarray, at: np.ndarray, side: int, angle: float) -> np.ndarray:
    """Cells (21, 21) uint8: a turned window of `side` pixels, sampled pixel by pixel and shrunk."""
    offset = np.arange(side) - 0.5 * (side - 1)
    u, v = np.meshgrid(offset, offset)
    x = (at[0] + u * np.cos(angle) - v * np.sin(angle)).astype(np.float32)
    y = (at[1] + u * np.sin(angle) + v * np.cos(angle)).astype(np.float32)
    window = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cv2.resize(window, (CELLS, CELLS), interpolation=cv2.INTER_AREA)
