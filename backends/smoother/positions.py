"""Landmark positions that fit the poses as they stand, each landmark by itself."""

from __future__ import annotations

from backends.smoother import uncertainty
from backends.smoother.factors import FactorMaker
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.solver import Solver
from slam.data import IndexArray
from slam.geometry.se3 import Array, inverse

#: cost: A landmark is solved for iteratively where a single step would change its sum of squares by so much.
_FAR = 1.0


def place(
    make: FactorMaker, log: MeasurementLog, solver: Solver, slots: IndexArray, before: Array | None = None
) -> None:
    """Set the positions and covariances of landmarks to what fits the poses on record.

    Args:
        make: projection and noise.
        log: poses, measurements, and the landmarks, which are changed.
        solver: has the positions of those landmarks that are variables.
        slots: the landmarks.
        before: poses (F, 4, 4) as they were until now: a landmark first moves with the last pose that measured it.

    Raises:
        SolverError: the solver cannot say where its variables are.
    """
    marks = log.landmarks
    variables = marks.variable[slots]
    explicit = variables >= 0
    others = slots[~explicit]
    if before is not None:
        last = marks.last[others]
        moved = log.path.poses[last] @ inverse(before[last])
        turned = moved[:, :3, :3] @ marks.position[others][:, :, None]
        marks.position[others] = turned[:, :, 0] + moved[:, :3, 3]
    marks.position[slots[explicit]] = solver.points(variables[explicit].tolist())
    step, gain = linearise(make, log, slots)
    far = ~explicit & (gain > _FAR)
    if far.any():
        marks.position[slots[far]] = uncertainty.refined(
            make.stereo, make.sigma, log.path.poses, log.measurements, marks, slots[far]
        )
        step[far] = linearise(make, log, slots[far])[0]
    near = ~explicit & (gain <= _FAR)
    marks.position[slots[near]] += step[near]


def linearise(make: FactorMaker, log: MeasurementLog, slots: IndexArray) -> tuple[Array, Array]:
    """Set the landmarks' information and covariances by their recent measurements.

    Returns:
        steps (M, 3) to better positions [m], and by how much each would lessen its sum of squares (M,).
    """
    marks = log.landmarks
    position = marks.position[slots]
    information, gradient, _ = uncertainty.linearise(
        make.stereo, make.sigma, log.path.poses, log.measurements, position, marks.recent[slots]
    )
    marks.information[slots] = information
    step, marks.covariance[slots], gain = uncertainty.position_step(
        information.sum(axis=1) + marks.older[slots], gradient, marks.prior[slots], marks.mean[slots] - position
    )
    return step, gain
