"""Accuracy of a path against ground truth: the figures of a run's summary, defined in `slam.evaluation.metrics`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from slam.errors import TrajectoryError
from slam.evaluation.consistency import consistency_figures
from slam.evaluation.metrics import (
    absolute_errors,
    associate,
    plane_errors,
    relative_errors,
    segment_errors,
)
from slam.geometry.se3 import Array, inverse, rotation_angle
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.rig_error import CommonError

_TOLERANCE = 0.02  # truth may lie so far from a frame in time [s]


class WithTruth(Protocol):
    """What is asked of a sequence or a recording."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """The left camera's true path; None where it is not known."""
        ...


def evaluate(estimate: Trajectory, sequence: WithTruth) -> dict[str, float]:
    """Errors of an estimated path against the sequence's truth; empty where fewer than 3 poses have any."""
    figures: dict[str, float] = {}
    pairs = _common(estimate, sequence.ground_truth)
    if pairs is not None:
        figures.update(_against_truth(*pairs))
    gps = getattr(sequence, "gps", None)
    if gps is not None and len(estimate) >= 3:
        figures.update(_against_gps(estimate, gps))
    return figures


def true_path(estimate: Trajectory, sequence: WithTruth) -> Trajectory | None:
    """The true path at the stamps of an estimated one, in its own world; None where fewer than 3 poses have any."""
    pairs = _common(estimate, sequence.ground_truth)
    return None if pairs is None else pairs[1]


def _common(estimate: Trajectory, truth: Trajectory | None) -> tuple[Trajectory, Trajectory] | None:
    """Both paths at common stamps; None where fewer than 3 poses have truth."""
    if truth is None or not len(estimate):
        return None
    try:
        own, true = associate(estimate, truth, _TOLERANCE, interpolated=True)
    except TrajectoryError:  # nothing overlaps: then there is no figure, which is no fault of the run
        return None
    return (own, true) if len(own) >= 3 else None


def _against_gps(estimate: Trajectory, gps: Array) -> dict[str, float]:
    try:
        errors = plane_errors(estimate, gps)
    except TrajectoryError:
        return {}
    return {
        "GPS distance RMSE [m]": float(np.sqrt(np.mean(errors**2))),
        "GPS distance max [m]": float(errors.max()),
    }


def _against_truth(own: Trajectory, true: Trajectory) -> dict[str, float]:
    ate, rpe = absolute_errors(own, true), relative_errors(own, true)
    # Turned by the first pose, not by the aligned path: a straight path leaves the turn about itself open.
    turn = inverse(own.poses[0]) @ own.poses @ inverse(inverse(true.poses[0]) @ true.poses)
    segments = segment_errors(own, true)
    return {
        "ATE RMSE [m]": ate.translation_statistics.rmse,
        "ATE max [m]": ate.translation_statistics.max,
        "rotation RMSE from start [deg]": float(np.degrees(np.sqrt(np.mean(rotation_angle(turn[:, :3, :3]) ** 2)))),
        "RPE RMSE [m/frame]": rpe.translation_statistics.rmse,
        "RPE rotation RMSE [deg/frame]": rpe.rotation_statistics.rmse,
        "segment error [%]": segments.mean_translation,
        "poses with truth": float(len(own)),
    }


def consistency(
    estimate: Trajectory, covariances: Array, sequence: WithTruth, common: Sequence[CommonError] | None = None
) -> dict[str, float]:
    """How honest the pose covariances are, see `slam.evaluation.consistency`; empty without truth for the first pose.

    Args:
        estimate: the online path.
        covariances: of its poses (N, 6, 6).
        sequence: with ground truth or without; its `truth_noise`, where it has one, is that of the truth.
        common: the part of the covariances that the poses share (N); None where that is not known, or nothing.
    """
    pairs = _common(estimate, sequence.ground_truth)
    if pairs is None or pairs[0].stamps[0] != estimate.stamps[0]:
        return {}
    rows = np.searchsorted(estimate.stamps, pairs[0].stamps)
    noise = getattr(sequence, "truth_noise", TruthNoise())
    shared = None if common is None else [common[row] for row in rows]
    return consistency_figures(*pairs, covariances[rows], noise, shared)
