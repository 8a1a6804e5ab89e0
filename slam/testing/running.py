"""Checks of the first tier: a back end that passes them gets through a run, however well it estimates."""

from __future__ import annotations

import numpy as np

from slam.data import Estimate, Observations, Prediction, UpdateReport, UpdateStatus
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend
from slam.system import StereoSlam
from slam.testing.scene import (
    DT,
    MODELS,
    NONE,
    RIG,
    Factory,
    make_scene,
    require,
    require_same,
    require_status,
    started,
    tracked,
)  # fmt: skip
from slam.worlds import open_world

METHODS = ("predict", "update", "add", "remove", "estimate", "positions", "trajectory")
_FRAMES = 8  # of the run


def every_method_is_there(factory: Factory) -> None:
    """It is made as ``factory(rig, models=models)`` and has the seven methods of `slam.interfaces.Backend`."""
    backend: Backend = factory(RIG, models=MODELS)
    missing = [name for name in METHODS if not callable(getattr(backend, name, None))]
    require(not missing, f"{', '.join(missing)} missing: a back end has {', '.join(METHODS)}")


def predictions_have_their_shapes(factory: Factory) -> None:
    """`predict` gives a `Prediction` of finite arrays, a row for each landmark in view."""
    backend, _ = started(factory)
    prediction = backend.predict(DT)
    _require_kind(prediction, Prediction, "predict")
    n = len(prediction.ids)
    require_same(prediction.stamp, DT, "stamp of the prediction")
    shapes = {"T_world_left": (4, 4), "covariance": (6, 6), "ids": (n,), "uv_left": (n, 2), "uv_right": (n, 2)}
    _require_arrays(prediction, {**shapes, "innovation": (n, 2, 2)}, "predict")
    require(n > 0, "predict lists no landmark, but the camera has hardly moved since they were added")
    require(np.isin(prediction.ids, backend.estimate().ids).all(), "predict lists a landmark that is not in the map")


def updates_are_reported(factory: Factory) -> None:
    """`update` gives an `UpdateReport` that says which landmarks were used; a frame without any is no error."""
    backend, seen = started(factory)
    backend.predict(DT)
    second = make_scene(2).frames[1]
    report = backend.update(second.select(np.isin(second.ids, seen.ids)))
    _require_kind(report, UpdateReport, "update")
    require_status(report, UpdateStatus.OK, "an update with good observations")
    require(len(report.used) > 0 and np.isin(report.used, seen.ids).all(), "update used none of the good observations")
    backend.predict(2 * DT)
    require_status(backend.update(Observations.empty()), UpdateStatus.EMPTY, "a frame without observations")


def estimates_have_their_shapes(factory: Factory) -> None:
    """`estimate` gives an `Estimate` of finite arrays; with ``landmarks=False`` the pose alone."""
    backend, seen = started(factory)
    found, n = backend.estimate(), len(seen)
    _require_kind(found, Estimate, "estimate")
    shapes = {"T_world_left": (4, 4), "covariance": (6, 6), "ids": (n,), "positions": (n, 3), "covariances": (n, 3, 3)}
    _require_arrays(found, shapes, "estimate")
    require_same(np.sort(found.ids), np.sort(seen.ids), "landmarks of the estimate, against those that were added")
    require_same(backend.positions(found.ids), found.positions, "positions(ids), against those of the estimate", 0.1)
    require_same(backend.estimate(landmarks=False).ids, NONE, "landmarks of estimate(landmarks=False)")


def landmarks_can_be_removed(factory: Factory) -> None:
    """`remove` takes landmarks out of the map."""
    backend, seen = started(factory)
    backend.remove(seen.ids[:3])
    require_same(np.sort(backend.estimate().ids), np.sort(seen.ids[3:]), "landmarks after the first three were removed")


def trajectory_has_a_pose_for_every_prediction(factory: Factory) -> None:
    """`trajectory` gives a `Trajectory` with every stamp predicted so far."""
    path = tracked(factory, make_scene(4))[0].backend.trajectory()
    _require_kind(path, Trajectory, "trajectory")
    require_same(path.stamps, DT * np.arange(4), "stamps of the trajectory", 1e-12)


def a_run_comes_to_its_end(factory: Factory) -> None:
    """In `slam.StereoSlam` it tracks a short piece of a built-in world."""
    world = open_world(f"aisle?frames={_FRAMES}")
    system = StereoSlam(world.rig, None, factory(world.rig, models=MODELS))
    results = [system.process_features(world.observations(k)) for k in range(_FRAMES)]
    lost = [r for r in results[1:] if r.status != "tracked"]
    require(not lost, f"a run over a built-in world: {len(lost)} of {_FRAMES - 1} frames not tracked")


def _require_kind(found: object, kind: type, method: str) -> None:
    require(isinstance(found, kind), f"{method} returned {type(found).__name__}, not a {kind.__name__}")


def _require_arrays(found: object, shapes: dict[str, tuple[int, ...]], method: str) -> None:
    """Fail unless the attributes are finite arrays of these shapes."""
    for name, shape in shapes.items():
        value = getattr(found, name)
        require(isinstance(value, np.ndarray), f"{name} of {method} is of type {type(value).__name__}, not an array")
        require(value.shape == shape, f"{name} of {method} has shape {value.shape}, {shape} expected")
        require(np.isfinite(value).all(), f"{name} of {method} is not finite")
