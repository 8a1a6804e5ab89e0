"""Checks of the tiers ``"runs"`` and ``"right"``: what a back end answers and what it refuses, call by call."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from slam.data import Observations, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.interfaces import Backend
from slam.registry import require_methods
from slam.system import StereoSlam
from slam.testing.scene import (
    DT,
    MODELS,
    NONE,
    RIG,
    Factory,
    Run,
    assert_covariance,
    assert_near,
    cloud,
    make_scene,
    raises,
    require,
    require_equal,
    require_same,
    require_status,
    started,
    tracked,
)  # fmt: skip
from slam.third_party import checked
from slam.worlds import open_world

_FRAMES = 8  # of the run in a world


def every_method_is_there(factory: Factory) -> None:
    """It is made as ``factory(rig, models=models)`` and has the seven methods of `slam.interfaces.Backend`."""
    try:
        require_methods("backends", factory(RIG, models=MODELS))
    except ConfigurationError as error:
        require(False, str(error))


def answers_are_as_documented(factory: Factory) -> None:
    """Its answers are of the types and shapes that the interface says, with what was added, until it is removed."""
    backend, seen = started(factory)
    prediction = checked(backend, "predict", backend.predict(DT))
    require_same(prediction.stamp, DT, "stamp of the prediction")
    require(np.isfinite(prediction.innovation).all(), "innovation of predict is not finite")
    require(len(prediction.ids) > 0, "predict lists no landmark, but the camera has hardly moved since they were added")
    require(np.isin(prediction.ids, seen.ids).all(), "predict lists a landmark that is not in the map")
    second = make_scene(2).frames[1]
    report = checked(backend, "update", backend.update(second.select(np.isin(second.ids, seen.ids))))
    require_status(report, UpdateStatus.OK, "an update with good observations")
    require(len(report.used) > 0 and np.isin(report.used, seen.ids).all(), "update used none of the good observations")
    backend.predict(2 * DT)
    require_status(backend.update(Observations.empty()), UpdateStatus.EMPTY, "a frame without observations")
    estimate = checked(backend, "estimate", backend.estimate())
    require_same(np.sort(estimate.ids), np.sort(seen.ids), "landmarks of the estimate, against those that were added")
    positions = checked(backend, "positions", backend.positions(estimate.ids), n=len(seen))
    require_same(positions, estimate.positions, "positions(ids), against those of the estimate", 0.1)
    require_same(backend.estimate(landmarks=False).ids, NONE, "landmarks of estimate(landmarks=False)")
    require_same(backend.trajectory().stamps, DT * np.arange(3), "stamps of the trajectory", 1e-12)
    backend.remove(seen.ids[:3])
    require_same(np.sort(backend.estimate().ids), np.sort(seen.ids[3:]), "landmarks after the first three were removed")


def a_run_comes_to_its_end(factory: Factory) -> None:
    """In `slam.StereoSlam` it tracks a short piece of a built-in world."""
    world = open_world(f"aisle?frames={_FRAMES}")
    system = StereoSlam(world.rig, None, factory(world.rig, models=MODELS))
    results = [system.process_features(world.observations(k)) for k in range(_FRAMES)]
    lost = [r for r in results[1:] if r.status != "tracked"]
    require(not lost, f"a run over a built-in world: {len(lost)} of {_FRAMES - 1} frames not tracked")


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
    require(not len(prediction.ids), "the first prediction lists landmarks, but the map is empty")


def initial_pose_is_kept(factory: Factory) -> None:
    """The world may be any: the first pose is the models', and everything else follows in that world."""
    T, scene = se3.exp(np.array([0.4, -0.8, 2.0, 10.0, -20.0, 5.0])), make_scene()
    estimate = tracked(factory, scene, replace(MODELS, T_world_left=T.tolist()))[0].backend.estimate()
    assert_near(estimate.T_world_left, T @ scene.poses[-1], "pose in a turned world")
    error = estimate.positions - se3.transform(T, scene.points[estimate.ids])
    require(np.median(np.linalg.norm(error, axis=1)) < 0.5, "landmarks are not in the initial pose's world")


def misuse_is_refused(factory: Factory) -> None:
    """Refused are calls before the start, stamps that do not increase, unknown options and ids, and impossible rows."""
    raises(ConfigurationError, factory, RIG, models=MODELS, no_such_option=1, what="unknown option")
    backend, seen = started(factory)
    for method, arguments in {"add": (seen,), "update": (seen,), "recent": (1,), "place": cloud([7])}.items():
        if hasattr(backend, method):
            fresh: Any = factory(RIG, models=MODELS)
            raises(MeasurementError, getattr(fresh, method), *arguments, what=f"{method} before predict")
    stranger, before = Observations(np.array([999]), seen.uv_left[:1], seen.uv_right[:1]), backend.estimate()
    rows: list[tuple[str, str, Any]] = [
        ("add", "of known ids", seen.select(np.arange(3))),
        ("add", "without a right pixel", replace(stranger, uv_right=np.full((1, 2), np.nan))),
        ("add", "with negative depth", replace(stranger, uv_right=stranger.uv_left + np.array([30.0, 0.0]))),
        ("remove", "of an unknown id", [999]),
        ("positions", "of an unknown id", np.array([999])),
        *(("predict", f"({stamp}) after 0.0", stamp) for stamp in (0.0, -1.0, float("nan"), float("inf"))),
        ("predict", "", DT),
        ("update", "with an unknown id", stranger),
    ]
    rows += [("recent", "(0)", 0)] if hasattr(backend, "recent") else []
    for method, what, argument in rows:
        if what:
            raises(MeasurementError, getattr(backend, method), argument, what=f"{method} {what}")
        else:
            getattr(backend, method)(argument)
    if hasattr(backend, "consider"):
        raises(MeasurementError, backend.consider, lambda z: np.zeros((*z.shape, 1)), what="consider after predict")
    place: Any = getattr(backend, "place", None)
    for depth in (-5.0, 0.0, float("nan")) if place is not None else ():
        raises(MeasurementError, place, *cloud([7], [[0, 0, depth]]), what=f"place at a depth of {depth}")
    after = backend.estimate()
    require_same(after.ids, before.ids, "landmarks after calls that were refused")
    require_same(after.positions, before.positions, "positions after calls that were refused", 1e-9)


def a_stamp_has_one_update(factory: Factory) -> None:
    """A second update of a stamp is refused, whatever came of the first; so is one after an add."""
    scene, run = make_scene(4), Run(factory)
    run.step(0, scene.frames[0])
    seen = scene.frames[1].select(run.in_map(scene.frames[1]))
    old, new = seen.select(np.arange(len(seen) - 3)), seen.select(np.arange(len(seen) - 3, len(seen)))
    backend = run.backend
    backend.remove(new.ids)
    raises(MeasurementError, backend.update, old, what="an update of the first stamp after an add")
    for k, (first, status) in enumerate([(old, UpdateStatus.OK), (Observations.empty(), UpdateStatus.EMPTY)]):
        backend.predict(DT * (k + 1))
        require_status(backend.update(first), status, "the first update of a stamp")
        before = backend.estimate()
        for again in (old, Observations.empty()):
            raises(MeasurementError, backend.update, again, what="a second update of a stamp")
        require_equal(backend.estimate(), before, "estimate after a second update, which was refused")
    backend.predict(DT * 3)
    backend.add(new)
    raises(MeasurementError, backend.update, old, what="an update after an add at the same stamp")


def nothing_seen_is_no_error(factory: Factory) -> None:
    """Frames without observations: the state is predicted, the status says so, uncertainty grows."""
    backend = tracked(factory, make_scene(6))[0].backend
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
    assert_covariance(whole.covariance, (6, 6), "pose")
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
    scene = make_scene()
    backend: Any = tracked(factory, scene)[0].backend
    if not hasattr(backend, "recent"):
        return
    pose, stamps = backend.estimate(), DT * np.arange(len(scene.frames))
    for n in (1, 4, 100):
        recent = backend.recent(n)
        k = len(recent.stamps)
        require(0 < k <= n, f"recent({n}) returned {k} poses")
        require_same(recent.stamps, stamps[-k:], f"stamps of recent({n})", 1e-9)
        require_same(recent.poses[-1], pose.T_world_left, f"last pose of recent({n}) and the estimate's", 1e-9)
        scale = 0.01 * float(np.abs(pose.covariance).max())
        require_same(recent.covariance[-6:, -6:], pose.covariance, f"last covariance of recent({n})", scale)
        assert_covariance(recent.covariance, (6 * k, 6 * k), f"recent({n})")
        A = np.zeros((6, 6 * k))
        step = se3.inverse(recent.poses[0]) @ recent.poses[-1]
        A[:, :6], A[:, -6:] = -se3.adjoint(se3.inverse(step)), A[:, -6:] + np.eye(6)
        error = se3.log(se3.inverse(step) @ se3.inverse(scene.poses[-k]) @ scene.poses[-1])
        distance = float(error @ np.linalg.solve(A @ recent.covariance @ A.T, error)) if k > 1 else 0.0
        require(distance < 40, f"over the poses of recent({n}) the motion is off by {distance:.3g} (χ² of six)")


def results_are_the_callers_own(factory: Factory) -> None:
    """Writing into what a back end returned does not reach its state."""
    backend = tracked(factory, make_scene(4))[0].backend
    before, names = backend.estimate(), ("T_world_left", "positions", "covariance")
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
    gone, rest = ids[::3], np.setdiff1d(ids, ids[::3])
    before = backend.positions(rest)
    backend.remove(gone)
    run.in_backend -= set(gone.tolist())
    backend.remove(NONE)
    require_same(backend.estimate().ids, rest, "landmarks after a removal")
    require_same(backend.positions(rest), before, "positions of those that stay after a removal", 1e-6)
    raises(MeasurementError, backend.positions, gone[:1], what="position of a removed landmark")
    for k in range(8, len(scene.frames)):
        prediction, report = run.step(k, scene.frames[k])
        require_status(report, UpdateStatus.OK, "an update after a removal")
        require(k > 8 or not np.isin(prediction.ids, gone).any(), "a removed landmark is predicted")
    assert_near(backend.estimate().T_world_left, scene.poses[-1], "pose after removals")
    back = gone[np.isin(gone, scene.frames[-1].ids)]
    require(len(back) > 0 and np.isin(back, backend.estimate().ids).all(), "a removed id could not come back")


def queries_are_pure(factory: Factory) -> None:
    """Of two twins one is asked for everything at every step, the other never: they go on to the same bytes."""
    scene, dark = make_scene(14), (5, 6, 11)
    asked, silent = Run(factory), Run(factory)
    other = "of a back end that was asked before, against one that was not"
    for k, seen in enumerate(scene.frames):
        seen = seen.select(np.zeros(0, np.intp)) if k in dark else seen
        answers = [run.step(k, seen, between=_ask if run is asked else None) for run in (asked, silent)]
        if k == 8:
            for run in (asked, silent):
                run.backend.remove(seen.ids[:4])
                run.in_backend -= set(seen.ids[:4].tolist())
        _ask(asked.backend)
        for what, a, b in zip(("prediction", "report"), *answers):
            require_equal(a, b, f"{what} of frame {k} {other}")
        if k in dark:
            a, b = (run.backend.estimate(landmarks=False) for run in (asked, silent))
            require_equal(a, b, f"pose of frame {k} {other}")
    require_equal(asked.backend.trajectory(), silent.backend.trajectory(), f"path {other}")
    require_equal(asked.backend.estimate(), silent.backend.estimate(), f"estimate {other}")


def _ask(backend: Backend) -> None:
    for _ in range(2):
        backend.estimate(landmarks=False)
        backend.positions(backend.estimate().ids)
        backend.trajectory()
        if hasattr(backend, "recent"):
            backend.recent(4)


def rows_that_no_point_explains_are_rejected(factory: Factory) -> None:
    """An update with a row of negative disparity, or far outside the image, rejects that row and uses the others."""
    scene, run = make_scene(6), Run(factory)
    for k in range(5):
        run.step(k, scene.frames[k])
    seen = scene.frames[5].select(run.in_map(scene.frames[5]))
    left, right = seen.uv_left.copy(), seen.uv_right.copy()
    right[1, 0] = left[1, 0] + 50.0
    left[2], right[2] = (9e4, -9e4), (9e4 - 20.0, -9e4)
    run.backend.predict(5 * DT)
    report = run.backend.update(replace(seen, uv_left=left, uv_right=right))
    require_status(report, UpdateStatus.OK, "an update with two wrong rows")
    require(np.isin(seen.ids[[1, 2]], report.rejected).all(), "a row that no point explains was not rejected")
    estimate = run.backend.estimate()
    finite = np.isfinite(estimate.T_world_left).all() and np.isfinite(estimate.positions).all()
    require(finite, "pose or landmarks are not finite after an update with two wrong rows")
    for name in ("covariance", "covariances"):
        P = getattr(estimate, name)
        assert_covariance(P, P.shape, f"{name} after an update with two wrong rows")
