"""Accuracy of a path against ground truth: the figures of a run's summary, defined in `slam.evaluation.metrics`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from slam.data import CommonError
from slam.errors import TrajectoryError
from slam.evaluation.consistency import BEFORE, consistency_figures
from slam.evaluation.joint_errors import JointErrors
from slam.evaluation.metrics import absolute_errors, associate, relative_errors, segment_errors
from slam.geometry.se3 import Array, inverse, so3_log
from slam.geometry.trajectory import Trajectory, TruthNoise

logger = logging.getLogger("slam.evaluation")


def evaluate(estimate: Trajectory, sequence: Any) -> dict[str, float]:
    """Errors of an estimated path against the sequence's truth; empty where fewer than 3 poses have any.

    Figures that cannot be computed for this path, such as those of one that runs off to infinity, are left out.
    """
    pairs = with_truth(estimate, sequence)
    if pairs is None:
        return {}
    mounting = getattr(sequence, "truth_noise", TruthNoise()).mounting
    return _where_possible(_accuracy, *pairs, mounting) | {"poses with truth": float(len(pairs[0]))}


def with_truth(estimate: Trajectory, sequence: Any) -> tuple[Trajectory, Trajectory] | None:
    """Estimated and true path at common stamps; None where fewer than 3 poses have truth."""
    truth = sequence.ground_truth
    if truth is None or not len(estimate):
        return None
    try:
        own, true = associate(estimate, truth)
    except TrajectoryError:  # nothing overlaps: then there is no figure, which is no fault of the run
        return None
    return (own, true) if len(own) >= 3 else None


def _where_possible(part: Callable[..., dict[str, float]], *arguments: object) -> dict[str, float]:
    """Figures of a path; none, with a warning, where they cannot be computed."""
    try:
        return part(*arguments)
    except (TrajectoryError, np.linalg.LinAlgError) as error:
        logger.warning("figures are left out: %s", error)
        return {}


def _accuracy(own: Trajectory, true: Trajectory, mounting: float) -> dict[str, float]:
    """ATE, RPE from frame to frame, and over as many frames as come nearest to a second if the path has so many."""
    errors, turns = absolute_errors(own, true), rotation_errors(own, true, mounting)
    figures = {
        "ATE RMSE [m]": errors.rmse,
        "ATE max [m]": float(errors.translation.max()),
        "rotation RMSE from start [deg]": float(np.degrees(np.sqrt(np.mean(np.sum(turns**2, axis=1))))),
    }
    second = max(1, round(1.0 / float(np.median(np.diff(own.stamps)))))
    for name, unit, frames in (("", "/frame", 1), (" over 1 s", "", second)):
        if len(own) > frames:
            errors = relative_errors(own, true, frames)
            figures[f"RPE RMSE{name} [m{unit}]"] = errors.rmse
            figures[f"RPE rotation RMSE{name} [deg{unit}]"] = errors.rotation_rmse
    segments = segment_errors(own, true)[:, 1]
    return figures | {"segment error [%]": float(segments.mean()) if len(segments) else float("nan")}


def rotation_errors(own: Trajectory, true: Trajectory, mounting: float) -> Array:
    """Errors (N, 3) of rotations since the start [rad], without what a constant turn of the truth's sensor explains.

    Args:
        own: the estimated poses. Both paths are turned by their first pose, as a straight path leaves a turn about
            itself open.
        true: the true poses of the same frames.
        mounting: standard deviation of each axis of that turn beforehand [rad]; 0 for none.
    """
    since_start = (inverse(path.poses[0]) @ path.poses for path in (own, true))
    R, R_true = (poses[:, :3, :3] for poses in since_start)
    R_left = np.swapaxes(R, 1, 2)
    errors = so3_log(R_left @ R_true)
    if not mounting or not errors.any():
        return errors
    J = (np.eye(3) - R_left).reshape(-1, 3)  # a constant turn w of the truth's sensor explains ``(1 − Rᵀ) w``
    prior = np.mean(errors**2) / mounting**2
    turn = np.linalg.solve(J.T @ J + prior * np.eye(3), J.T @ errors.ravel())
    return np.asarray(errors - (J @ turn).reshape(-1, 3))


def consistency(
    estimate: Trajectory,
    covariances: Array,
    sequence: Any,
    common: Sequence[CommonError] | None = None,
    joint: JointErrors | None = None,
) -> dict[str, float]:
    """How honest the pose covariances are, from the first pose that has truth; empty where none has.

    See `slam.evaluation.consistency`. Empty, too, where the path's errors and covariances are beyond computing.

    Args:
        estimate: the online path.
        covariances: of its poses (N, 6, 6).
        sequence: with ground truth or without; its `truth_noise`, where it has one, is that of the truth.
        common: the part of the covariances that the poses share (N); None where that is not known, or nothing.
        joint: how the rest of the poses' (N) errors hang together; None where that is not known.
    """
    pairs = with_truth(estimate, sequence)
    if pairs is None:
        return {}
    rows = np.searchsorted(estimate.stamps, pairs[0].stamps)
    noise = getattr(sequence, "truth_noise", TruthNoise())
    shared = None if common is None else [common[row] for row in rows]
    joint = None if joint is None else joint.select(rows)
    found = _where_possible(consistency_figures, *pairs, covariances[rows], noise, shared, joint)
    return found | ({BEFORE: float(rows[0])} if rows[0] and found else {})
