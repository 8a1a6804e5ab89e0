"""Likelihood from the rows of one frame: in an ideal rectified pair, matched pixels have the same row."""

from __future__ import annotations

import numpy as np

from slam.calibration.evidence import Evidence
from slam.calibration.model import RESIDUAL, RigModel
from slam.calibration.robust import student_weights
from slam.geometry.se3 import Array


def row_evidence(model: RigModel, points: Array, vertical: Array, parameters: Array) -> tuple[Evidence, Evidence]:
    """Likelihood of the parameters by one frame's vertical disparities, without and with residual fields.

    Args:
        model: the parameters' meaning.
        points: ``(x, y, d)`` (N, 3) [px] of the matches, as measured.
        vertical: right row less left row (N,) [px], as measured.
        parameters: the values (n,) at which outliers are identified.

    Returns:
        The evidence of the parameters (n), and of them followed by the right camera's residual fields of y (n + k). The
        left camera's fields have the same effect with opposite sign.
    """
    A, fields = model.vertical(points), model.residual_vertical(points)
    residual = vertical + A @ parameters
    weights = student_weights(residual**2, 1, 0.03)[:, None]  # 0.03: of a row [px], the least that is believed
    both = np.column_stack([A, fields[:, -len(RESIDUAL) :]])
    weighted, n = both * weights, A.shape[1]
    S, e = weighted.T @ both, -(weighted.T @ vertical)
    return Evidence(S[:n, :n], e[:n], weighted[:, :n].T @ fields), Evidence(S, e, np.zeros((len(e), 0)))
