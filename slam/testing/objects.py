"""The contract of a back end that estimates moving bodies, as checks that any such back end can be put through.

As `slam.testing`, which it goes with::

    from slam.testing.objects import OBJECT_CHECKS

    @pytest.mark.parametrize("check", OBJECT_CHECKS, ids=lambda check: check.__name__)
    def test_contract(check):
        check(MyBackend)

Tolerances are some ten times what a good estimator reaches on the scene: they find what is broken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from slam.data import Observations
from slam.errors import MeasurementError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.interfaces import Backend, ObjectBackend
from slam.models import EstimatorModels
from slam.object_data import ObjectEstimate, ObjectObservations
from slam.testing.scene import require, require_same

Factory = Callable[..., Backend]

RIG = StereoRig.rectified_pair(f=400.0, u0=319.5, v0=239.5, baseline=0.2, width=640, height=480)
SIGMA = 0.3
MODELS = EstimatorModels(pixel_sigma=SIGMA)
_DT = 0.05
_BODY = 4
_POINTS = 20
_VELOCITY = np.array([0.0, 0.4, 0.0, 0.3, 0.0, 0.1])  # [ω, v] in world axes


def moves_with_its_body(factory: Factory) -> None:
    """The pose of a body that is in view is the motion since its first sight, its velocity the true one."""
    estimates = _run(factory, 15)
    origin = estimates[0].T_world_object
    truth = _motion(14) @ origin
    error = se3.log(se3.inverse(estimates[-1].T_world_object) @ truth)
    turned, moved = float(np.abs(error[:3]).max()), float(np.abs(error[3:]).max())
    require(turned < 0.08, f"rotation since the first sight is off by {turned:.3g} rad")
    require(moved < 0.05, f"translation since the first sight is off by {moved:.3g} m")
    nees = float(error @ np.linalg.solve(estimates[-1].covariance, error))
    require(nees < 60, f"the body's covariance is far too small: its NEES is {nees:.3g}, 6 expected")
    off = float(np.abs(_VELOCITY[:3] - estimates[-1].velocity[:3]).max())
    require(off < 1.0, f"angular velocity is off by {off:.3g} rad/s")
    for e in estimates:
        whole = e.id == _BODY and e.measured and len(e.used) == _POINTS and len(e.rejected) == 0
        require(whole, f"body {e.id}: measured {e.measured}, {len(e.used)} of {_POINTS} good points used")


def first_pose_is_by_definition(factory: Factory) -> None:
    """The frame of a body: its axes are the world's, its origin is the mean of the points, its pose has no error."""
    first = _run(factory, 1)[0]
    require_same(first.T_world_object[:3, :3], np.eye(3), "rotation of a new body", 1e-9)
    require_same(
        first.T_world_object[:3, 3], _shape().mean(axis=0), "a new body's origin, against its points' mean", 0.1
    )
    require_same(first.covariance, np.zeros((6, 6)), "covariance of a new body's pose", 1e-9)


def unseen_body_is_predicted(factory: Factory) -> None:
    """A body out of sight goes on with growing covariance, and is found again under its id."""
    estimates = _run(factory, 16, hidden=range(8, 13))
    spread = [np.trace(e.covariance) for e in estimates[8:13]]
    require(not any(e.measured for e in estimates[8:13]), "a body that was not observed counts as measured")
    require((np.diff(spread) > 0).all(), "the covariance of a body does not grow while it is not observed")
    step = np.linalg.norm(estimates[12].T_world_object[:3, 3] - estimates[7].T_world_object[:3, 3])
    expected = 5 * _DT * np.linalg.norm(_VELOCITY[3:])
    require(abs(step - expected) < expected, f"an unseen body moved by {step:.3g} m, {expected:.3g} m expected")
    require(all(e.measured for e in estimates[13:]), "a body that was seen again is not measured")


def wrong_point_is_rejected(factory: Factory) -> None:
    """One gross mismatch is reported and moves nothing."""

    def spoil(k: int, o: ObjectObservations) -> ObjectObservations:
        shift = np.zeros((len(o.points), 2))
        shift[3] = (40.0, -30.0) if k == 9 else 0.0
        return replace(o, uv_left=o.uv_left + shift, uv_right=o.uv_right + shift)

    clean, spoilt = _run(factory, 10)[-1], _run(factory, 10, change=spoil)[-1]
    require(spoilt.rejected.tolist() == [103], "a match that is 50 px off was not rejected, or others were")
    off = se3.log(se3.inverse(clean.T_world_object) @ spoilt.T_world_object)
    still = (np.abs(off) < 2 * np.sqrt(np.diag(clean.covariance))).all()
    require(still, "a wrong match moved the body by more than two standard deviations")


def bodies_come_in_order_and_go(factory: Factory) -> None:
    """Estimates by ascending id; removed bodies are gone, others stay; an id may come back."""
    backend, objects = _create(factory)
    rng = np.random.default_rng(0)
    backend.predict(0.0)
    seen = _observations(0, rng)
    other = replace(seen, id=1, points=seen.points + 50)
    require_same([e.id for e in objects.update_objects([seen, other])], [1, _BODY], "bodies by ascending id")
    objects.remove_objects([1])
    backend.predict(_DT)
    require_same([e.id for e in objects.update_objects([])], [_BODY], "bodies after one was removed")
    objects.remove_objects(np.array([_BODY]))
    backend.predict(2 * _DT)
    require(objects.update_objects([]) == [], "there are bodies after all were removed")
    backend.predict(3 * _DT)
    again = [e.id for e in objects.update_objects([_observations(3, rng)])]
    require_same(again, [_BODY], "a removed body that comes back under its id")


def a_body_is_measured_once_a_stamp(factory: Factory) -> None:
    """A further call at one stamp starts new bodies and leaves the known ones as they are."""
    backend, objects = _create(factory)
    rng = np.random.default_rng(0)
    for k in range(4):
        backend.predict(k * _DT)
        seen = _observations(k, rng)
        (first,) = objects.update_objects([seen])
    other = replace(seen, id=1, points=seen.points + 50)
    new, again = objects.update_objects([other, seen])
    require(new.measured and not again.measured, "a second call at one stamp measures a body that it has measured")
    for name in ("T_world_object", "covariance", "velocity", "velocity_covariance"):
        require_same(getattr(again, name), getattr(first, name), f"{name} of a body after a second call at one stamp")


def misuse_of_bodies_is_refused(factory: Factory) -> None:
    """New bodies without depth, and unknown ids, are errors."""
    backend, objects = _create(factory)
    backend.predict(0.0)
    seen = _observations(0, np.random.default_rng(0))
    flat = replace(seen, uv_right=np.full_like(seen.uv_right, np.nan))
    few = ObjectObservations(2, seen.points[:2], seen.uv_left[:2], seen.uv_right[:2])
    _raises(objects.update_objects, [flat], what="a new body without right pixels")
    _raises(objects.update_objects, [few], what="a new body of two points")
    _raises(objects.remove_objects, [5], what="removal of an unknown body")
    require(objects.update_objects([]) == [], "a body that was refused is there")


def camera_is_not_moved_by_bodies(factory: Factory) -> None:
    """A body that jumps about does not shift the camera."""
    poses = []
    for wild in (False, True):
        backend, objects = _create(factory)
        rng = np.random.default_rng(0)
        for k in range(6):
            backend.predict(_DT * k)
            backend.update(Observations.empty())
            seen = _observations(k, rng)
            jump = np.array([10.0 * (-1) ** k, 0.0]) if wild else np.zeros(2)
            objects.update_objects([replace(seen, uv_left=seen.uv_left + jump, uv_right=seen.uv_right + jump)])
        poses.append(backend.estimate().T_world_left)
    require_same(poses[1], poses[0], "the camera's pose while a body jumps", 1e-6)


#: All checks.
OBJECT_CHECKS: tuple[Callable[[Factory], None], ...] = (
    moves_with_its_body,
    first_pose_is_by_definition,
    unseen_body_is_predicted,
    wrong_point_is_rejected,
    bodies_come_in_order_and_go,
    a_body_is_measured_once_a_stamp,
    misuse_of_bodies_is_refused,
    camera_is_not_moved_by_bodies,
)


def check_object_backend(factory: Factory) -> None:
    """Put a back end through all checks; raises AssertionError at the first that fails."""
    for check in OBJECT_CHECKS:
        check(factory)


# --- the scene: a body of 0.4 m at 2 m before a camera at rest ---


def _shape() -> Array:
    """Points (P, 3) at the first sight, in world coordinates."""
    return np.array([0.0, 0.0, 2.0]) + np.random.default_rng(1).uniform(-0.2, 0.2, (_POINTS, 3))


def _motion(k: int) -> Array:
    """Motion (4, 4) of the body since frame 0, in world coordinates."""
    centre = _shape().mean(axis=0)
    R = se3.so3_exp(k * _DT * _VELOCITY[:3])
    return se3.pose(R, centre - R @ centre + k * _DT * _VELOCITY[3:])


def _observations(k: int, rng: np.random.Generator) -> ObjectObservations:
    left, right = RIG.project(se3.transform(_motion(k), _shape()))
    noise = SIGMA * rng.standard_normal((_POINTS, 3))
    return ObjectObservations(_BODY, 100 + np.arange(_POINTS), left + noise[:, :2], right + noise[:, [2, 1]])


def _create(factory: Factory) -> tuple[Backend, ObjectBackend]:
    backend = factory(RIG, models=MODELS)
    if not isinstance(backend, ObjectBackend):
        raise AssertionError("update_objects or remove_objects is missing")
    return backend, backend


def _run(
    factory: Factory,
    frames: int,
    hidden: Sequence[int] = (),
    change: Callable[[int, ObjectObservations], ObjectObservations] = lambda k, o: o,
) -> list[ObjectEstimate]:
    """Estimates of the body in each frame; the camera stands still and sees landmarks."""
    backend, objects = _create(factory)
    rng = np.random.default_rng(2)
    marks = np.column_stack([rng.uniform(-1.5, 1.5, 30), rng.uniform(-1, 1, 30), rng.uniform(2, 5, 30)])
    left, right = RIG.project(marks)
    out = []
    for k in range(frames):
        noise = SIGMA * rng.standard_normal((30, 3))
        seen = Observations(np.arange(30), left + noise[:, :2], right + noise[:, [2, 1]])
        backend.predict(_DT * k)
        if k == 0:
            backend.add(seen)
        else:
            backend.update(seen)
        given = change(k, _observations(k, rng))
        (estimate,) = objects.update_objects([] if k in hidden else [given])
        require_same(estimate.stamp, _DT * k, "stamp of a body's estimate")
        out.append(estimate)
    return out


def _raises(call: Callable[..., Any], *arguments: Any, what: str) -> None:
    try:
        call(*arguments)
    except MeasurementError:
        return
    raise AssertionError(f"{what} was not refused with a MeasurementError")
