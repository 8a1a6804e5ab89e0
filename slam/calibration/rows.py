"""What the rows of one frame say: matched pixels of an ideal rectified pair lie in one row."""

from __future__ import annotations

import numpy as np

from slam.calibration.evidence import Evidence
from slam.calibration.model import RigModel
from slam.geometry.se3 import Array

_DEGREES = 4.0  # of Student's t, the weight of a match
_MEDIAN = 0.455  # of χ² with one degree of freedom
_LEAST_NOISE = 0.03  # of a row [px], the least that is believed


def row_evidence(model: RigModel, points: Array, vertical: Array, parameters: Array) -> Evidence:
    """The likelihood of the parameters from the vertical disparities of one frame.

    Args:
        model: the parameters' meaning.
        points: ``(x, y, d)`` (N, 3) [px] of the matches, as measured.
        vertical: right row less left row (N,) [px], as measured.
        parameters: the values (n,) at which wrong matches are told from right ones.
    """
    A = model.vertical(points)
    residual = vertical + A @ parameters
    noise = max(float(np.median(residual**2)) / _MEDIAN, _LEAST_NOISE**2) if len(residual) else 1.0
    weights = (_DEGREES + 1) / (_DEGREES + residual**2 / noise) / noise
    weighted = A * weights[:, None]
    return Evidence(weighted.T @ A, -(weighted.T @ vertical), weighted.T @ model.residual_vertical(points))
