"""The whole problem, built from the measurement log and solved: after a failure of ISAM2 or a change of all pixels."""

from __future__ import annotations

import gtsam
import numpy as np

from backends.smoother.factors import FactorMaker, to_pose3
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.path import Path
from backends.smoother.solver import FAILURES, Change, SolverError
from backends.smoother.variables import pose_key
from slam.data import IndexArray
from slam.geometry.se3 import Array, inverse

_ITERATIONS = 30  # numerics: of Levenberg-Marquardt at most
_AS_FORETOLD = 0.75  # of the gain that the linear problem promises: with less, a step was not a small one


def whole_problem(make: FactorMaker, log: MeasurementLog) -> tuple[Change, dict[int, int]]:
    """All factors and first values, and the places of the smart factors of the landmarks' tracks, by slot."""
    change = Change()
    add_poses(change, make, log, log.history.restarted)
    for rows in log.history.finished:
        points = [make.point(z) for z in log.measurements.z[rows].tolist()]
        change.factors.add(make.smart(points, pose_keys(log, rows)))
    for key, all_rows in log.history.explicit.items():
        add_landmark(change, make, log, key, np.array(all_rows, np.intp), log.history.places[key])
        known = log.history.known.get(log.history.owner[key])
        if known is not None and not known.is_before(log.history.first):
            change.factors.add(make.known(key, known))
    places = {}
    for slot, track in log.landmarks.tracks.items():
        if track.informative:
            places[slot] = change.factors.size()
            change.factors.add(make.smart(track.points, track.keys))
    return change, places


def add_poses(change: Change, make: FactorMaker, log: MeasurementLog, restarted: int = 0) -> None:
    """All poses that are variables, with their priors and the motion between them.

    The relative poses of the first `restarted` frames are kept as in the log.
    """
    path, first, prior = log.path, log.history.first, log.history.prior
    if prior is not None:
        change.factors.add(prior.factor())
    for i in range(first, path.count):
        change.values.insert(pose_key(i), to_pose3(path.poses[i]))
        if first < i < restarted:
            relative = inverse(path.poses[i - 1]) @ path.poses[i]
            factor = make.step((pose_key(i - 1), pose_key(i)), relative, path.interval(i))
        elif prior is not None and i < first + 2 and not (i > first and path.jumped(first)):
            continue  # the prior holds what ties it to those that left
        else:
            factor = pose_factor(make, path, i)
        change.factors.add(factor)


def pose_factor(make: FactorMaker, path: Path, i: int) -> gtsam.NonlinearFactor:
    """The motion factor of the pose of frame `i`, or its prior."""
    if i == 0:
        return make.prior(pose_key(0))
    if i in path.rests:
        return make.rest((pose_key(i - 1), pose_key(i)))
    if i == 1 or path.jumped(i - 1):
        return make.first_motion((pose_key(i - 1), pose_key(i)), path.interval(i))
    keys = (pose_key(i - 2), pose_key(i - 1), pose_key(i))
    return make.motion(keys, path.interval(i - 1), path.interval(i))


def optimise(change: Change, iterations: int = _ITERATIONS) -> gtsam.Values:
    """The values that fit all factors best, by Levenberg-Marquardt.

    Raises:
        SolverError: gtsam failed, or found nothing better.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    try:
        before = change.factors.error(change.values)
        values = gtsam.LevenbergMarquardtOptimizer(change.factors, change.values, parameters).optimize()
        after = change.factors.error(values)
    except FAILURES as error:
        raise SolverError(f"gtsam: {' '.join(str(error).split())[:200]}") from error
    if not np.isfinite(after) or after > before:
        raise SolverError(f"Levenberg-Marquardt found no solution (error {before:.6g} to {after:.6g})")
    return values


def stepped(change: Change) -> gtsam.Values:
    """The values after one step of Gauss-Newton from values that were the solution before a small change.

    Raises:
        SolverError: gtsam failed, or the step gains less than the linear problem promises.
    """
    graph, values = change.factors, change.values
    try:
        linear = graph.linearize(values)
        step = linear.optimize()
        better = values.retract(step)
        before, after = graph.error(values), graph.error(better)
        # Of the linear problem before the step: smart factors project away what their triangulation leaves over.
        foretold = linear.error(gtsam.VectorValues.Zero(step)) - linear.error(step)
    except FAILURES as error:
        raise SolverError(f"gtsam: {' '.join(str(error).split())[:200]}") from error
    if not before - after >= _AS_FORETOLD * foretold >= 0:
        raise SolverError(f"the step was not a small one (error {before:.6g} to {after:.6g}, foretold −{foretold:.6g})")
    return better


def pose_keys(log: MeasurementLog, rows: IndexArray) -> list[int]:
    """Pose variables of measurements."""
    return [pose_key(i) for i in log.measurements.frame[rows].tolist()]


def add_landmark(
    change: Change, make: FactorMaker, log: MeasurementLog, key: int, rows: IndexArray, place: Array
) -> None:
    """A landmark that is a variable, first placed at `place` (3,) in world coordinates."""
    for z, pose in zip(log.measurements.z[rows].tolist(), pose_keys(log, rows)):
        change.factors.add(make.explicit(make.point(z), pose, key))
    change.values.insert(key, place)
