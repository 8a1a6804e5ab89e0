"""Checks of how well a back end estimates, and whether its covariances fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import Observations, UpdateStatus
from slam.geometry import se3
from slam.models import MotionModel
from slam.testing.scene import (
    DT,
    GENERAL_RIG,
    MODELS,
    RIG,
    SIGMA,
    Factory,
    Run,
    Scene,
    all_but_the_last,
    assert_covariance,
    assert_near,
    make_scene,
    started,
    tracked,
)


def new_landmarks_are_triangulated(factory: Factory) -> None:
    """A landmark's first position and covariance are the stereo pair's."""
    backend, seen = started(factory)
    found = backend.estimate()
    np.testing.assert_array_equal(found.ids, seen.ids)
    h = RIG.triangulate(seen.uv_left, seen.uv_right)
    np.testing.assert_allclose(found.positions, h, rtol=1e-3)
    expected = RIG.triangulation_covariance(h, SIGMA)
    ratio = np.trace(found.covariances, axis1=1, axis2=2) / np.trace(expected, axis1=1, axis2=2)
    assert np.abs(np.median(ratio) - 1) < 0.2, f"first landmark variances are {np.median(ratio)} of the stereo pair's"


def follows_the_camera(factory: Factory) -> None:
    """Tracks a noisy scene: pose and landmarks near the truth, within what the covariances say."""
    _follows(factory, make_scene())


def follows_with_a_general_rig(factory: Factory) -> None:
    """The same with an unrectified, distorted rig, in its own pixels."""
    _follows(factory, make_scene(rig=GENERAL_RIG))


def _follows(factory: Factory, scene: Scene) -> None:
    run, reports = tracked(factory, scene)
    found = run.backend.estimate()
    assert_near(found.T_world_left, scene.poses[-1], "pose after the scene")
    assert_covariance(found.covariance, (6, 6), "pose")
    error = se3.log(se3.inverse(found.T_world_left) @ scene.poses[-1])
    assert error @ np.linalg.solve(found.covariance, error) < 60, "the pose's covariance is far too small"  # χ²₆: 1e-10
    assert_covariance(found.covariances, (len(found.ids), 3, 3), "landmarks")
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
    scene = make_scene()
    run, _ = tracked(factory, replace(scene, frames=scene.frames[:-1]))
    prediction = run.backend.predict(DT * (len(scene.frames) - 1))
    assert_near(prediction.T_world_left, scene.poses[-1], "prediction", factor=1.5)


def predictions_are_of_landmarks_in_view(factory: Factory) -> None:
    """Predicted pixels are the projections of the map; only what is in the angle of view is listed."""
    scene = make_scene()
    backend = tracked(factory, scene)[0].backend
    prediction = backend.predict(DT * len(scene.frames))
    map_ids = backend.estimate().ids
    left, right = RIG.project(se3.transform(se3.inverse(prediction.T_world_left), backend.positions(map_ids)))
    np.testing.assert_array_equal(np.sort(prediction.ids), map_ids[RIG.left.in_image(left)])
    row = np.searchsorted(map_ids, prediction.ids)
    np.testing.assert_allclose(prediction.uv_left, left[row], atol=1e-6)
    np.testing.assert_allclose(prediction.uv_right, right[row], atol=1e-6)
    assert_covariance(prediction.innovation, (len(row), 2, 2), "innovations")
    assert np.linalg.eigvalsh(prediction.innovation).min() > 0.99 * SIGMA**2, "measurement noise is included"
    assert_covariance(prediction.covariance, (6, 6), "predicted pose")


def innovations_are_as_predicted(factory: Factory) -> None:
    """Innovations of left pixels fit the predicted covariances on average."""
    scene, distances = make_scene(25), []
    steady = replace(MODELS, motion=MotionModel(acceleration=0.02, angular_acceleration=0.02))
    run = Run(factory, models=steady)
    for k, seen in enumerate(scene.frames):
        prediction, _ = run.step(k, seen)
        _, ours, theirs = np.intersect1d(prediction.ids, seen.ids, return_indices=True)
        nu, S = seen.uv_left[theirs] - prediction.uv_left[ours], prediction.innovation[ours]
        distances.append(np.einsum("ni,ni->n", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0]))
    mean = float(np.concatenate(distances[10:]).mean())  # by then the velocity is known
    assert 1 < mean < 4, f"mean squared distance of left innovations is {mean}, about 2 expected"


def left_pixels_alone_are_measured(factory: Factory) -> None:
    """Observations without a right pixel are legal and hold the pose."""
    scene, run = make_scene(), Run(factory)
    for k, seen in enumerate(scene.frames):
        if k > 3:
            seen = replace(seen, uv_right=np.full_like(seen.uv_right, np.nan)).select(run.in_map(seen))
        _, report = run.step(k, seen)
    assert report.status is UpdateStatus.OK and report.dof <= 3 * len(report.used)
    assert_near(run.backend.estimate().T_world_left, scene.poses[-1], "pose by left pixels", factor=3)


def wrong_match_is_rejected(factory: Factory) -> None:
    """One gross mismatch is reported and moves nothing."""
    scene = make_scene()
    backend, seen = all_but_the_last(factory, scene)
    shift = np.zeros((len(seen), 2))
    shift[4] = [60.0, -45.0]
    report = backend.update(Observations(seen.ids, seen.uv_left + shift, seen.uv_right + shift))
    assert seen.ids[4] in report.rejected and seen.ids[4] not in report.used
    assert_near(backend.estimate().T_world_left, scene.poses[-1], "pose despite a wrong match")


def guess_is_no_measurement(factory: Factory) -> None:
    """A pose to start from changes nothing that matters, be it good or bad."""
    scene = make_scene()
    for offset in (np.zeros(6), np.array([0.02, -0.03, 0.01, 0.1, -0.1, 0.2])):
        backend, seen = all_but_the_last(factory, scene)
        report = backend.update(seen, guess=scene.poses[-1] @ se3.exp(offset))
        assert report.status is UpdateStatus.OK
        assert_near(backend.estimate().T_world_left, scene.poses[-1], f"pose with a guess off by {offset}")
