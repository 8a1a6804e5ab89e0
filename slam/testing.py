"""The contract of a back end as checks that any back end can be put through, third-party ones included.

With pytest, one test a check::

    import pytest
    from slam.testing import BACKEND_CHECKS

    @pytest.mark.parametrize("check", BACKEND_CHECKS, ids=lambda check: check.__name__)
    def test_contract(check):
        check(MyBackend)

or all at once: ``check_backend(MyBackend)``. The factory is called as ``factory(rig, models=EstimatorModels(...))``.
Nothing here needs pytest. Tolerances are some ten times what a good estimator reaches on the scene: they find what is
broken, not what is mediocre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam import se3
from slam.camera import PinholeCamera
from slam.data import BoolArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError, SlamError
from slam.interfaces import Backend
from slam.models import EstimatorModels, MotionModel
from slam.rig import StereoRig
from slam.se3 import Array

Factory = Callable[..., Backend]

RIG = StereoRig.rectified_pair(f=400.0, u0=319.5, v0=239.5, baseline=0.2, width=640, height=480)

#: Distorted, with the right camera turned and shifted: measurements are in the rig's own pixels whatever it is.
GENERAL_RIG = StereoRig(
    PinholeCamera(410.0, 405.0, 310.0, 245.0, 640, 480, "radtan", (-0.1, 0.02, 1e-3, -5e-4)),
    PinholeCamera(400.0, 402.0, 325.0, 238.0, 640, 480, "radtan", (-0.08, 0.01, -5e-4, 1e-3)),
    se3.so3_exp(np.array([0.01, -0.03, 0.005])),
    np.array([-0.2, 0.004, -0.006]),
)

SIGMA = 0.5  # pixel noise [px]
MODELS = EstimatorModels(pixel_sigma=SIGMA)
_DT = 0.1
_POSITION, _ROTATION = 0.05, 0.01  # largest pose errors on the scene [m], [rad]
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True)
class _Scene:
    """A camera that flies slowly through points, with noisy observations of all of them that are in view."""

    rig: StereoRig
    poses: Array
    points: Array
    frames: tuple[Observations, ...]


def _scene(count: int = 15, rig: StereoRig = RIG) -> _Scene:
    rng = np.random.default_rng(5)
    points = rng.uniform((-4, -3, 4), (4, 3, 12), (60, 3))
    step = se3.exp(_DT * np.array([0.02, 0.1, -0.05, 0.2, -0.1, 0.5]))
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    frames = tuple(_observe(rig, T, points, rng) for T in poses)
    return _Scene(rig, np.array(poses), points, frames)


def _observe(rig: StereoRig, T: Array, points: Array, rng: np.random.Generator) -> Observations:
    left, right = rig.project(se3.transform(se3.inverse(T), points))
    seen = np.flatnonzero(rig.left.in_image(left) & rig.right.in_image(right))
    noise = SIGMA * rng.standard_normal((2, len(seen), 2))
    return Observations(seen.astype(np.int64), left[seen] + noise[0], right[seen] + noise[1])


class _Run:
    """A back end on its way through frames; it remembers which landmarks it has added."""

    def __init__(self, factory: Factory, rig: StereoRig = RIG, models: EstimatorModels = MODELS) -> None:
        self.backend: Backend = factory(rig, models=models)
        self.known: set[int] = set()

    def step(self, k: int, seen: Observations) -> tuple[Prediction, UpdateReport]:
        """Frame k: predict, update with what the map has, add the rest."""
        prediction = self.backend.predict(_DT * k)
        old = self.in_map(seen)
        report = self.backend.update(seen.select(old))
        self.backend.add(seen.select(~old))
        self.known.update(seen.ids.tolist())
        return prediction, report

    def in_map(self, seen: Observations) -> BoolArray:
        """Which observations (M,) are of landmarks that the map has."""
        return np.array([i in self.known for i in seen.ids.tolist()], bool)


def _tracked(factory: Factory, scene: _Scene, models: EstimatorModels = MODELS) -> tuple[_Run, list[UpdateReport]]:
    """A back end after all frames of a scene, and its reports."""
    run = _Run(factory, scene.rig, models)
    return run, [run.step(k, seen)[1] for k, seen in enumerate(scene.frames)]


def _all_but_the_last(factory: Factory, scene: _Scene) -> tuple[Backend, Observations]:
    """A back end with the last frame predicted but not measured, and what it sees there of its map."""
    run, _ = _tracked(factory, replace(scene, frames=scene.frames[:-1]))
    run.backend.predict(_DT * (len(scene.frames) - 1))
    last = scene.frames[-1]
    return run.backend, last.select(run.in_map(last))


def _started(factory: Factory) -> tuple[Backend, Observations]:
    """A back end that has seen one frame, and what it saw."""
    run, scene = _Run(factory), _scene(1)
    run.step(0, scene.frames[0])
    return run.backend, scene.frames[0]


def _raises(error: type[Exception], call: Callable[..., Any], *args: Any, what: str, **kwargs: Any) -> None:
    try:
        call(*args, **kwargs)
    except error:
        return
    raise AssertionError(f"{what}: {error.__name__} expected")


def _assert_covariance(P: Array, shape: tuple[int, ...], what: str) -> None:
    assert P.shape == shape and np.isfinite(P).all(), f"{what}: finite covariance of shape {shape} expected"
    scale = np.abs(P).max(initial=0.0)
    assert np.abs(P - np.swapaxes(P, -1, -2)).max(initial=0.0) <= 1e-9 * scale, f"{what}: covariance is not symmetric"
    assert not len(P) or np.linalg.eigvalsh(P).min() > -1e-9 * scale, f"{what}: covariance is not positive definite"


def _assert_near(T: Array, truth: Array, what: str, factor: float = 1.0) -> None:
    error = se3.log(se3.inverse(truth) @ T)
    turned, moved = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    assert moved < factor * _POSITION and turned < factor * _ROTATION, f"{what}: off by {moved} m, {turned} rad"


# --- the checks ---


def first_prediction_is_the_start(factory: Factory) -> None:
    """The first predict returns the initial pose with its covariance and no landmark."""
    prediction = factory(RIG, models=MODELS).predict(3.0)
    assert prediction.stamp == 3.0
    np.testing.assert_allclose(prediction.T_world_left, np.eye(4), atol=1e-9)
    _assert_covariance(prediction.covariance, (6, 6), "first prediction")
    sigma = np.sqrt(np.diag(prediction.covariance))
    expected = np.repeat([MODELS.initial_rotation_sigma, MODELS.initial_position_sigma], 3)
    np.testing.assert_allclose(sigma, expected, rtol=0.1)
    assert len(prediction.ids) == len(prediction.uv_left) == len(prediction.uv_right) == 0
    assert prediction.innovation.shape == (0, 2, 2)


def initial_pose_is_kept(factory: Factory) -> None:
    """The world may be any: the first pose is the models', and everything else follows in that world."""
    T = se3.exp(np.array([0.4, -0.8, 2.0, 10.0, -20.0, 5.0]))
    scene = _scene()
    run, _ = _tracked(factory, scene, replace(MODELS, T_world_left=T.tolist()))
    backend = run.backend
    _assert_near(backend.estimate().T_world_left, T @ scene.poses[-1], "pose in a turned world")
    found = backend.estimate()
    error = found.positions - se3.transform(T, scene.points[found.ids])
    assert np.median(np.linalg.norm(error, axis=1)) < 0.5, "landmarks are not in the initial pose's world"


def time_must_increase(factory: Factory) -> None:
    """A stamp that is not finite or not later is refused, and does no harm."""
    backend, _ = _started(factory)
    for stamp in (0.0, -1.0, float("nan"), float("inf")):
        _raises(MeasurementError, backend.predict, stamp, what=f"predict({stamp}) after 0.0")
    assert backend.predict(_DT).stamp == _DT


def calls_before_the_first_prediction(factory: Factory) -> None:
    """Nothing can be measured before the start."""
    seen = _scene(1).frames[0]
    _raises(MeasurementError, factory(RIG, models=MODELS).add, seen, what="add before predict")
    _raises(MeasurementError, factory(RIG, models=MODELS).update, seen, what="update before predict")


def unknown_option_is_refused(factory: Factory) -> None:
    """An option that does not exist is an error, not ignored."""
    _raises(ConfigurationError, factory, RIG, models=MODELS, no_such_option=1, what="unknown option")


def nothing_seen_is_no_error(factory: Factory) -> None:
    """Frames without observations: the state is predicted, the status says so, uncertainty grows."""
    scene = _scene(6)
    backend = _tracked(factory, scene)[0].backend
    before = backend.estimate()
    for k in range(6, 12):
        backend.predict(_DT * k)
        report = backend.update(Observations.empty())
        assert report.status is UpdateStatus.EMPTY and report.dof == 0 and np.isnan(report.nis)
        assert len(report.used) == len(report.rejected) == 0
    after = backend.estimate()
    assert np.isfinite(after.T_world_left).all()
    _assert_covariance(after.covariance, (6, 6), "after frames without observations")
    assert np.trace(after.covariance) > np.trace(before.covariance), "uncertainty must grow in the dark"
    np.testing.assert_array_equal(after.ids, before.ids)


def ids_must_fit_the_map(factory: Factory) -> None:
    """Unknown ids, known ids added again, and rows without depth are refused and change nothing."""
    backend, seen = _started(factory)
    before = backend.estimate()
    stranger = Observations(np.array([999]), seen.uv_left[:1], seen.uv_right[:1])
    blind = replace(stranger, uv_right=np.full((1, 2), np.nan))
    behind = replace(stranger, uv_right=stranger.uv_left + np.array([30.0, 0.0]))
    _raises(MeasurementError, backend.add, seen.select(np.arange(3)), what="add of known ids")
    _raises(MeasurementError, backend.add, blind, what="add without a right pixel")
    _raises(MeasurementError, backend.add, behind, what="add with negative depth")
    _raises(MeasurementError, backend.remove, [999], what="remove of an unknown id")
    _raises(MeasurementError, backend.positions, np.array([999]), what="position of an unknown id")
    backend.predict(_DT)
    _raises(MeasurementError, backend.update, stranger, what="update with an unknown id")
    after = backend.estimate()
    np.testing.assert_array_equal(after.ids, before.ids)
    np.testing.assert_allclose(after.positions, before.positions, atol=1e-9)


def new_landmarks_are_triangulated(factory: Factory) -> None:
    """A landmark's first position and covariance are the stereo pair's."""
    backend, seen = _started(factory)
    found = backend.estimate()
    np.testing.assert_array_equal(found.ids, seen.ids)
    h = RIG.triangulate(seen.uv_left, seen.uv_right)
    np.testing.assert_allclose(found.positions, h, rtol=1e-3)
    expected = RIG.triangulation_covariance(h, SIGMA)
    ratio = np.trace(found.covariances, axis1=1, axis2=2) / np.trace(expected, axis1=1, axis2=2)
    assert np.abs(np.median(ratio) - 1) < 0.2, f"first landmark variances are {np.median(ratio)} of the stereo pair's"


def follows_the_camera(factory: Factory) -> None:
    """Tracks a noisy scene: pose and landmarks near the truth, within what the covariances say."""
    _follows(factory, _scene())


def follows_with_a_general_rig(factory: Factory) -> None:
    """The same with an unrectified, distorted rig, in its own pixels."""
    _follows(factory, _scene(rig=GENERAL_RIG))


def _follows(factory: Factory, scene: _Scene) -> None:
    run, reports = _tracked(factory, scene)
    found = run.backend.estimate()
    _assert_near(found.T_world_left, scene.poses[-1], "pose after the scene")
    _assert_covariance(found.covariance, (6, 6), "pose")
    error = se3.log(se3.inverse(found.T_world_left) @ scene.poses[-1])
    assert error @ np.linalg.solve(found.covariance, error) < 60, "the pose's covariance is far too small"  # χ²₆: 1e-10
    _assert_covariance(found.covariances, (len(found.ids), 3, 3), "landmarks")
    off = found.positions - scene.points[found.ids]
    nees = np.einsum("ni,ni->n", off, np.linalg.solve(found.covariances, off[:, :, None])[:, :, 0])
    assert np.median(nees) < 12, f"median NEES of landmarks is {np.median(nees)}, 2.4 expected"
    for report, seen in zip(reports[1:], scene.frames[1:]):
        assert report.status is UpdateStatus.OK and report.reason == ""
        assert len(report.used) > 0.8 * (len(report.used) + len(report.rejected)), "most observations are good"
        assert not np.isin(report.used, report.rejected).any() and np.isin(report.used, seen.ids).all()
        assert 2 * len(report.used) <= report.dof <= 4 * len(report.used) and report.nis >= 0
    nis, dof = sum(r.nis for r in reports[1:]), sum(r.dof for r in reports[1:])
    assert 0.3 < nis / dof < 2, f"NIS is {nis / dof} of its degrees of freedom"


def velocity_is_learnt(factory: Factory) -> None:
    """After some frames of steady motion the prediction is good before the measurement."""
    scene = _scene()
    run, _ = _tracked(factory, replace(scene, frames=scene.frames[:-1]))
    prediction = run.backend.predict(_DT * (len(scene.frames) - 1))
    _assert_near(prediction.T_world_left, scene.poses[-1], "prediction", factor=1.5)


def predictions_are_of_landmarks_in_view(factory: Factory) -> None:
    """Predicted pixels are the projections of the map; only what is in the angle of view is listed."""
    scene = _scene()
    backend = _tracked(factory, scene)[0].backend
    prediction = backend.predict(_DT * len(scene.frames))
    map_ids = backend.estimate().ids
    left, right = RIG.project(se3.transform(se3.inverse(prediction.T_world_left), backend.positions(map_ids)))
    np.testing.assert_array_equal(np.sort(prediction.ids), map_ids[RIG.left.in_image(left)])
    row = np.searchsorted(map_ids, prediction.ids)
    np.testing.assert_allclose(prediction.uv_left, left[row], atol=1e-6)
    np.testing.assert_allclose(prediction.uv_right, right[row], atol=1e-6)
    _assert_covariance(prediction.innovation, (len(row), 2, 2), "innovations")
    assert np.linalg.eigvalsh(prediction.innovation).min() > 0.99 * SIGMA**2, "measurement noise is included"
    _assert_covariance(prediction.covariance, (6, 6), "predicted pose")


def innovations_are_as_predicted(factory: Factory) -> None:
    """Innovations of left pixels fit the predicted covariances on average."""
    scene, distances = _scene(25), []
    steady = replace(MODELS, motion=MotionModel(acceleration=0.02, angular_acceleration=0.02))
    run = _Run(factory, models=steady)
    for k, seen in enumerate(scene.frames):
        prediction, _ = run.step(k, seen)
        _, ours, theirs = np.intersect1d(prediction.ids, seen.ids, return_indices=True)
        nu, S = seen.uv_left[theirs] - prediction.uv_left[ours], prediction.innovation[ours]
        distances.append(np.einsum("ni,ni->n", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0]))
    mean = float(np.concatenate(distances[10:]).mean())  # by then the velocity is known
    assert 1 < mean < 4, f"mean squared distance of left innovations is {mean}, about 2 expected"


def left_pixels_alone_are_measured(factory: Factory) -> None:
    """Observations without a right pixel are legal and hold the pose."""
    scene, run = _scene(), _Run(factory)
    for k, seen in enumerate(scene.frames):
        if k > 3:
            seen = replace(seen, uv_right=np.full_like(seen.uv_right, np.nan)).select(run.in_map(seen))
        _, report = run.step(k, seen)
    assert report.status is UpdateStatus.OK and report.dof <= 3 * len(report.used)
    _assert_near(run.backend.estimate().T_world_left, scene.poses[-1], "pose by left pixels", factor=3)


def wrong_match_is_rejected(factory: Factory) -> None:
    """One gross mismatch is reported and moves nothing."""
    scene = _scene()
    backend, seen = _all_but_the_last(factory, scene)
    shift = np.zeros((len(seen), 2))
    shift[4] = [60.0, -45.0]
    report = backend.update(Observations(seen.ids, seen.uv_left + shift, seen.uv_right + shift))
    assert seen.ids[4] in report.rejected and seen.ids[4] not in report.used
    _assert_near(backend.estimate().T_world_left, scene.poses[-1], "pose despite a wrong match")


def guess_is_no_measurement(factory: Factory) -> None:
    """A pose to start from changes nothing that matters, be it good or bad."""
    scene = _scene()
    for offset in (np.zeros(6), np.array([0.02, -0.03, 0.01, 0.1, -0.1, 0.2])):
        backend, seen = _all_but_the_last(factory, scene)
        report = backend.update(seen, guess=scene.poses[-1] @ se3.exp(offset))
        assert report.status is UpdateStatus.OK
        _assert_near(backend.estimate().T_world_left, scene.poses[-1], f"pose with a guess off by {offset}")


def removed_landmarks_are_gone(factory: Factory) -> None:
    """Removal takes landmarks out of everything; tracking goes on; an id may come back."""
    scene = _scene()
    run, _ = _tracked(factory, replace(scene, frames=scene.frames[:8]))
    backend = run.backend
    ids = backend.estimate().ids
    gone, kept = ids[::3], np.setdiff1d(ids, ids[::3])
    before = backend.positions(kept)
    backend.remove(gone)
    run.known -= set(gone.tolist())
    backend.remove(_NONE)
    np.testing.assert_array_equal(backend.estimate().ids, kept)
    np.testing.assert_allclose(backend.positions(kept), before, atol=1e-6)
    _raises(MeasurementError, backend.positions, gone[:1], what="position of a removed landmark")
    for k in range(8, len(scene.frames)):
        prediction, report = run.step(k, scene.frames[k])
        assert report.status is UpdateStatus.OK
        assert k > 8 or not np.isin(prediction.ids, gone).any(), "a removed landmark is predicted"
    _assert_near(backend.estimate().T_world_left, scene.poses[-1], "pose after removals")
    back = gone[np.isin(gone, scene.frames[-1].ids)]
    assert len(back) and np.isin(back, backend.estimate().ids).all(), "a removed id could not come back"


def estimate_is_in_order(factory: Factory) -> None:
    """Ids ascend, `positions` follows the order asked for, and without landmarks the pose is the same."""
    scene, run = _scene(2), _Run(factory)
    run.step(0, scene.frames[0].select(np.arange(len(scene.frames[0]))[::-1]))
    run.step(1, scene.frames[1])
    backend = run.backend
    whole, pose_only = backend.estimate(), backend.estimate(landmarks=False)
    assert (np.diff(whole.ids) > 0).all()
    # An offline back end may solve for `estimate` alone, so `positions` may be an earlier answer, but not another one.
    off = np.abs(backend.positions(whole.ids[::-1])[::-1] - whole.positions)
    deviations = np.sqrt(np.diagonal(whole.covariances, axis1=1, axis2=2))
    assert (off < deviations).all(), "positions and estimate differ by more than a standard deviation"
    assert len(pose_only.ids) == 0 and pose_only.positions.shape == (0, 3) and pose_only.covariances.shape == (0, 3, 3)
    np.testing.assert_array_equal(pose_only.T_world_left, whole.T_world_left)
    np.testing.assert_allclose(pose_only.covariance, whole.covariance, rtol=1e-9)
    assert whole.stamp == pose_only.stamp == _DT


def trajectory_has_every_stamp(factory: Factory) -> None:
    """A pose for every stamp predicted; the last is the estimate's; all near the truth."""
    scene = _scene()
    backend = _tracked(factory, scene)[0].backend
    trajectory = backend.trajectory()
    np.testing.assert_allclose(trajectory.stamps, _DT * np.arange(len(scene.frames)), atol=1e-12)
    np.testing.assert_allclose(trajectory.poses[-1], backend.estimate().T_world_left, atol=1e-9)
    for T, truth in zip(trajectory.poses, scene.poses):
        _assert_near(T, truth, "trajectory")


def results_are_the_callers_own(factory: Factory) -> None:
    """Writing into what a back end returned does not reach its state."""
    backend = _tracked(factory, _scene(4))[0].backend
    before = backend.estimate()
    copy = (before.T_world_left.copy(), before.positions.copy(), before.covariance.copy())
    returned = backend.estimate()
    for array in (returned.T_world_left, returned.positions, returned.covariance, backend.trajectory().poses):
        if array.flags.writeable:
            array[:] = 7.0
    backend.positions(before.ids)[:] = 7.0
    after = backend.estimate()
    for a, b in zip(copy, (after.T_world_left, after.positions, after.covariance)):
        np.testing.assert_array_equal(a, b)


def same_input_same_bytes(factory: Factory) -> None:
    """Two runs over the same observations agree to the last bit."""
    runs = [_tracked(factory, _scene(8))[0].backend for _ in range(2)]
    first, second = (backend.estimate() for backend in runs)
    np.testing.assert_array_equal(first.T_world_left, second.T_world_left)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(runs[0].trajectory().poses, runs[1].trajectory().poses)


#: Every check of the contract, in the order of increasing demands.
BACKEND_CHECKS: Sequence[Callable[[Factory], None]] = (
    first_prediction_is_the_start,
    initial_pose_is_kept,
    time_must_increase,
    calls_before_the_first_prediction,
    unknown_option_is_refused,
    nothing_seen_is_no_error,
    ids_must_fit_the_map,
    new_landmarks_are_triangulated,
    estimate_is_in_order,
    trajectory_has_every_stamp,
    results_are_the_callers_own,
    same_input_same_bytes,
    follows_the_camera,
    follows_with_a_general_rig,
    velocity_is_learnt,
    predictions_are_of_landmarks_in_view,
    innovations_are_as_predicted,
    left_pixels_alone_are_measured,
    wrong_match_is_rejected,
    guess_is_no_measurement,
    removed_landmarks_are_gone,
)


def check_backend(factory: Factory) -> None:
    """Put a back end through the whole contract.

    Args:
        factory: called as ``factory(rig, models=...)``, for each check anew; usually the back end's class.

    Raises:
        AssertionError: the first check that fails, by name.
    """
    for check in BACKEND_CHECKS:
        try:
            check(factory)
        except (AssertionError, SlamError) as error:
            raise AssertionError(f"{check.__name__}: {error}") from error
