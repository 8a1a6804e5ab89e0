"""Checks of what a back end says and refuses, call by call."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from slam.data import Observations, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.testing.scene import (
    DT,
    MODELS,
    NONE,
    RIG,
    Factory,
    Run,
    assert_covariance,
    assert_near,
    make_scene,
    raises,
    require,
    require_same,
    require_status,
    started,
    tracked,
)  # fmt: skip


def first_prediction_is_the_start(factory: Factory) -> None:
    """The first predict returns the initial pose with its covariance and no landmark."""
    prediction = factory(RIG, models=MODELS).predict(3.0)
    require_same(prediction.stamp, 3.0, "stamp of the first prediction")
    require_same(prediction.T_world_left, np.eye(4), "pose of the first prediction", 1e-9)
    assert_covariance(prediction.covariance, (6, 6), "first prediction")
    sigma = np.sqrt(np.diag(prediction.covariance))
    expected = np.repeat([MODELS.initial_rotation_sigma, MODELS.initial_position_sigma], 3)
    near = np.allclose(sigma, expected, rtol=0.1)
    require(near, "the first covariance is not that of the models' initial_rotation_sigma and initial_position_sigma")
    rows = len(prediction.ids) + len(prediction.uv_left) + len(prediction.uv_right) + len(prediction.innovation)
    require(not rows, "the first prediction lists landmarks, but the map is empty")


def initial_pose_is_kept(factory: Factory) -> None:
    """The world may be any: the first pose is the models', and everything else follows in that world."""
    T = se3.exp(np.array([0.4, -0.8, 2.0, 10.0, -20.0, 5.0]))
    scene = make_scene()
    run, _ = tracked(factory, scene, replace(MODELS, T_world_left=T.tolist()))
    backend = run.backend
    assert_near(backend.estimate().T_world_left, T @ scene.poses[-1], "pose in a turned world")
    found = backend.estimate()
    error = found.positions - se3.transform(T, scene.points[found.ids])
    require(np.median(np.linalg.norm(error, axis=1)) < 0.5, "landmarks are not in the initial pose's world")


def time_must_increase(factory: Factory) -> None:
    """A stamp that is not finite or not later is refused, and does no harm."""
    backend, _ = started(factory)
    for stamp in (0.0, -1.0, float("nan"), float("inf")):
        raises(MeasurementError, backend.predict, stamp, what=f"predict({stamp}) after 0.0")
    require_same(backend.predict(DT).stamp, DT, "stamp of a prediction after refused ones")


def calls_before_the_first_prediction(factory: Factory) -> None:
    """Nothing can be measured before the start."""
    seen = make_scene(1).frames[0]
    raises(MeasurementError, factory(RIG, models=MODELS).add, seen, what="add before predict")
    raises(MeasurementError, factory(RIG, models=MODELS).update, seen, what="update before predict")


def unknown_option_is_refused(factory: Factory) -> None:
    """An option that does not exist is an error, not ignored."""
    raises(ConfigurationError, factory, RIG, models=MODELS, no_such_option=1, what="unknown option")


def nothing_seen_is_no_error(factory: Factory) -> None:
    """Frames without observations: the state is predicted, the status says so, uncertainty grows."""
    scene = make_scene(6)
    backend = tracked(factory, scene)[0].backend
    before = backend.estimate()
    for k in range(6, 12):
        backend.predict(DT * k)
        report = backend.update(Observations.empty())
        require_status(report, UpdateStatus.EMPTY, "a frame without observations")
        none = report.dof == 0 and np.isnan(report.nis) and not len(report.used) and not len(report.rejected)
        require(none, "a report without observations has some used or rejected, degrees of freedom, or a NIS")
    after = backend.estimate()
    require(np.isfinite(after.T_world_left).all(), "the pose is not finite after frames without observations")
    assert_covariance(after.covariance, (6, 6), "after frames without observations")
    grown = np.trace(after.covariance) > np.trace(before.covariance)
    require(grown, "the pose's covariance does not grow in frames without observations")
    require_same(after.ids, before.ids, "landmarks after frames without observations")


def ids_must_fit_the_map(factory: Factory) -> None:
    """Unknown ids, known ids added again, and rows without depth are refused and change nothing."""
    backend, seen = started(factory)
    before = backend.estimate()
    stranger = Observations(np.array([999]), seen.uv_left[:1], seen.uv_right[:1])
    blind = replace(stranger, uv_right=np.full((1, 2), np.nan))
    behind = replace(stranger, uv_right=stranger.uv_left + np.array([30.0, 0.0]))
    raises(MeasurementError, backend.add, seen.select(np.arange(3)), what="add of known ids")
    raises(MeasurementError, backend.add, blind, what="add without a right pixel")
    raises(MeasurementError, backend.add, behind, what="add with negative depth")
    raises(MeasurementError, backend.remove, [999], what="remove of an unknown id")
    raises(MeasurementError, backend.positions, np.array([999]), what="position of an unknown id")
    backend.predict(DT)
    raises(MeasurementError, backend.update, stranger, what="update with an unknown id")
    after = backend.estimate()
    require_same(after.ids, before.ids, "landmarks after calls that were refused")
    require_same(after.positions, before.positions, "positions after calls that were refused", 1e-9)


def estimate_is_in_order(factory: Factory) -> None:
    """Ids ascend, `positions` follows the order asked for, and without landmarks the pose is the same."""
    scene, run = make_scene(2), Run(factory)
    run.step(0, scene.frames[0].select(np.arange(len(scene.frames[0]))[::-1]))
    run.step(1, scene.frames[1])
    backend = run.backend
    whole, pose_only = backend.estimate(), backend.estimate(landmarks=False)
    require((np.diff(whole.ids) > 0).all(), "the estimate's ids do not ascend")
    # An offline back end may solve for `estimate` alone, so `positions` may be an earlier answer, but not another one.
    off = np.abs(backend.positions(whole.ids[::-1])[::-1] - whole.positions)
    deviations = np.sqrt(np.diagonal(whole.covariances, axis1=1, axis2=2))
    require((off < deviations).all(), "positions(ids) and the estimate differ by more than a standard deviation")
    for name, shape in (("ids", (0,)), ("positions", (0, 3)), ("covariances", (0, 3, 3))):
        require_same(getattr(pose_only, name), np.zeros(shape), f"{name} of estimate(landmarks=False)")
    # A smoother may solve further for the whole estimate.
    off = np.abs(se3.log(se3.inverse(pose_only.T_world_left) @ whole.T_world_left))
    off /= np.sqrt(np.diag(whole.covariance))
    require(off.max() < 0.2, f"pose with and without landmarks differ by {off.max():.3g} standard deviations")
    scale = 0.01 * float(np.abs(whole.covariance).max())
    require_same(pose_only.covariance, whole.covariance, "the pose's covariance with and without landmarks", scale)
    require_same((whole.stamp, pose_only.stamp), (DT, DT), "stamp of the estimate")


def trajectory_has_every_stamp(factory: Factory) -> None:
    """A pose for every stamp predicted; the last is the estimate's; all near the truth."""
    scene = make_scene()
    backend = tracked(factory, scene)[0].backend
    trajectory = backend.trajectory()
    require_same(trajectory.stamps, DT * np.arange(len(scene.frames)), "stamps of the trajectory", 1e-12)
    require_same(trajectory.poses[-1], backend.estimate().T_world_left, "last pose of trajectory and estimate", 1e-9)
    for T, truth in zip(trajectory.poses, scene.poses):
        assert_near(T, truth, "trajectory")


def recent_poses_fit_the_estimate(factory: Factory) -> None:
    """If it has `recent`: the last of the poses is the estimate's, and how they moved is as sure as it says."""
    if not hasattr(factory(RIG, models=MODELS), "recent"):
        return
    backend: Any = factory(RIG, models=MODELS)
    raises(MeasurementError, backend.recent, 1, what="recent before predict")
    scene = make_scene()
    backend = tracked(factory, scene)[0].backend
    raises(MeasurementError, backend.recent, 0, what="recent(0)")
    pose, stamps = backend.estimate(), DT * np.arange(len(scene.frames))
    for n in (1, 4, 100):
        found = backend.recent(n)
        k = len(found.stamps)
        require(0 < k <= n, f"recent({n}) returned {k} poses")
        require_same(found.stamps, stamps[-k:], f"stamps of recent({n})", 1e-9)
        require_same(found.poses[-1], pose.T_world_left, f"last pose of recent({n}) and the estimate's", 1e-9)
        scale = 0.01 * float(np.abs(pose.covariance).max())
        require_same(found.covariance[-6:, -6:], pose.covariance, f"last covariance of recent({n})", scale)
        assert_covariance(found.covariance, (6 * k, 6 * k), f"recent({n})")
        A = np.zeros((6, 6 * k))
        step = se3.inverse(found.poses[0]) @ found.poses[-1]
        A[:, :6], A[:, -6:] = -se3.adjoint(se3.inverse(step)), A[:, -6:] + np.eye(6)
        truth = se3.inverse(scene.poses[-k]) @ scene.poses[-1]
        error = se3.log(se3.inverse(step) @ truth)
        distance = float(error @ np.linalg.solve(A @ found.covariance @ A.T, error)) if k > 1 else 0.0
        require(distance < 40, f"over the poses of recent({n}) the motion is off by {distance:.3g} (χ² of six)")


def results_are_the_callers_own(factory: Factory) -> None:
    """Writing into what a back end returned does not reach its state."""
    backend = tracked(factory, make_scene(4))[0].backend
    before = backend.estimate()
    names = ("T_world_left", "positions", "covariance")
    copies, returned = [getattr(before, name).copy() for name in names], backend.estimate()
    for array in (*(getattr(returned, name) for name in names), backend.trajectory().poses):
        if array.flags.writeable:
            array[:] = 7.0
    backend.positions(before.ids)[:] = 7.0
    after = backend.estimate()
    for name, copy in zip(names, copies):
        require_same(getattr(after, name), copy, f"{name} after the caller wrote into an array that was returned")


def removed_landmarks_are_gone(factory: Factory) -> None:
    """Removal takes landmarks out of everything; tracking goes on; an id may come back."""
    scene = make_scene()
    run, _ = tracked(factory, replace(scene, frames=scene.frames[:8]))
    backend = run.backend
    ids = backend.estimate().ids
    gone, kept = ids[::3], np.setdiff1d(ids, ids[::3])
    before = backend.positions(kept)
    backend.remove(gone)
    run.known -= set(gone.tolist())
    backend.remove(NONE)
    require_same(backend.estimate().ids, kept, "landmarks after a removal")
    require_same(backend.positions(kept), before, "positions of those that stay after a removal", 1e-6)
    raises(MeasurementError, backend.positions, gone[:1], what="position of a removed landmark")
    for k in range(8, len(scene.frames)):
        prediction, report = run.step(k, scene.frames[k])
        require_status(report, UpdateStatus.OK, "an update after a removal")
        require(k > 8 or not np.isin(prediction.ids, gone).any(), "a removed landmark is predicted")
    assert_near(backend.estimate().T_world_left, scene.poses[-1], "pose after removals")
    back = gone[np.isin(gone, scene.frames[-1].ids)]
    require(len(back) > 0 and np.isin(back, backend.estimate().ids).all(), "a removed id could not come back")
