"""The likelihood from the rows of one frame: matched pixels of an ideal rectified pair lie in one row."""

from __future__ import annotations

from slam.calibration.evidence import Evidence
from slam.calibration.model import RigModel
from slam.calibration.robust import student_weights
from slam.geometry.se3 import Array

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
    weighted = A * student_weights(residual**2, 1, _LEAST_NOISE)[:, None]
    return Evidence(weighted.T @ A, -(weighted.T @ vertical), weighted.T @ model.residual_vertical(points))
