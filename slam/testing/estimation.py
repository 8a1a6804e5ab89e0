"""Checks of how well a back end estimates, and whether its covariances fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import Observations, UpdateReport, UpdateStatus
from slam.geometry import se3
from slam.models import MotionModel
from slam.testing.scene import (
    DT,
    MODELS,
    RIG,
    SIGMA,
    Factory,
    Run,
    all_but_the_last,
    assert_covariance,
    assert_near,
    make_scene,
    require,
    require_same,
    require_status,
    started,
    tracked,
)  # fmt: skip

_OFTEN = 15  # measurements of a landmark


def new_landmarks_are_triangulated(factory: Factory) -> None:
    """A landmark's first position and covariance are the stereo pair's."""
    backend, seen = started(factory)
    estimate = backend.estimate()
    require_same(estimate.ids, seen.ids, "ids of the landmarks that were added")
    h = RIG.triangulate(seen.uv_left, seen.uv_right)
    require_same(estimate.positions, h, "positions of landmarks seen once, against the stereo pair's", 0.02)
    expected = RIG.triangulation_covariance(h, SIGMA)
    ratio = np.trace(estimate.covariances, axis1=1, axis2=2) / np.trace(expected, axis1=1, axis2=2)
    middle = float(np.median(ratio))
    require(abs(middle - 1) < 0.2, f"variances of landmarks seen once are {middle:.3g} times those of the stereo pair")


def follows_the_camera(factory: Factory) -> None:
    """Tracks a noisy scene: pose and landmarks near the truth, within what the covariances say."""
    scene = make_scene()
    run, reports = tracked(factory, scene)
    estimate = run.backend.estimate()
    assert_near(estimate.T_world_left, scene.poses[-1], "pose after the scene")
    assert_covariance(estimate.covariance, (6, 6), "pose")
    error = se3.log(se3.inverse(estimate.T_world_left) @ scene.poses[-1])
    nees = float(error @ np.linalg.solve(estimate.covariance, error))
    require(nees < 60, f"the pose's covariance is far too small: its NEES is {nees:.3g}, 6 expected")  # χ²₆: 1e-10
    assert_covariance(estimate.covariances, (len(estimate.ids), 3, 3), "landmarks")
    off = estimate.positions - scene.points[estimate.ids]
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(estimate.covariances, off[:, :, None])[:, :, 0])
    middle = float(np.median(squared))
    require(middle < 12, f"covariances of landmarks are far too small: their median NEES is {middle:.3g}, 2.4 expected")
    for report, seen in zip(reports[1:], scene.frames[1:]):
        _is_in_order(report, seen)
    nis, dof = sum(r.nis for r in reports[1:]), sum(r.dof for r in reports[1:])
    require(0.3 < nis / dof < 2, f"NIS is {nis / dof:.3g} times its degrees of freedom, 1 expected")


def _is_in_order(report: UpdateReport, seen: Observations) -> None:
    """Fail unless a report of good observations says so."""
    used, rejected, dof = len(report.used), len(report.rejected), report.dof
    require_status(report, UpdateStatus.OK, "an update with good observations")
    require(report.reason == "", f"an update that is ok gives a reason: {report.reason!r}")
    require(used > 0.8 * (used + rejected), f"{rejected} of {used + rejected} good observations were rejected")
    own = not np.isin(report.used, report.rejected).any() and np.isin(report.used, seen.ids).all()
    require(own, "a landmark is both used and rejected, or was not observed")
    counts = f"the report's dof is {dof} for {used} landmarks used: it counts 2 to 4 measured pixels of each"
    require(2 * used <= dof <= 4 * used, counts)
    require(report.nis >= 0, f"NIS is {report.nis:.3g}: it must be a number of at least 0")


def landmarks_are_corrected(factory: Factory) -> None:
    """Landmarks seen many times are known better than at their first sight, and the covariances say so."""
    scene = make_scene(25)
    estimate = tracked(factory, scene)[0].backend.estimate()
    ids, times = np.unique(np.concatenate([seen.ids for seen in scene.frames]), return_counts=True)
    often = np.intersect1d(scene.frames[0].ids, ids[times >= _OFTEN])  # first seen from the origin: no error of a pose
    rows = np.searchsorted(estimate.ids, often)
    first = RIG.triangulation_covariance(scene.points[often], SIGMA)
    off = (estimate.positions[rows] - scene.points[often])[:, :, None]
    left = float((np.swapaxes(off, 1, 2) @ np.linalg.solve(first, off)).mean()) / 3
    require(left < 0.4, f"squared errors of landmarks seen {_OFTEN} times are {left:.3g} of those at their first sight")
    share = float(np.median(np.trace(estimate.covariances[rows], axis1=1, axis2=2) / np.trace(first, axis1=1, axis2=2)))
    require(share < 0.5, f"variances of landmarks seen {_OFTEN} times are {share:.3g} of those at their first sight")


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
    require_same(np.sort(prediction.ids), map_ids[RIG.left.in_image(left)], "landmarks in the predicted angle of view")
    row = np.searchsorted(map_ids, prediction.ids)
    require_same(prediction.uv_left, left[row], "predicted left pixels, against the projected positions", 1e-6)
    require_same(prediction.uv_right, right[row], "predicted right pixels, against the projected positions", 1e-6)
    assert_covariance(prediction.innovation, (len(row), 2, 2), "innovations")
    noisy = np.linalg.eigvalsh(prediction.innovation).min() > 0.99 * SIGMA**2
    require(noisy, "innovation covariances are smaller than the pixel noise that they must include")
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
    require(1 < mean < 4, f"left innovations have a mean squared Mahalanobis distance of {mean:.3g}, about 2 expected")


def left_pixels_alone_are_measured(factory: Factory) -> None:
    """Observations without a right pixel are legal and hold the pose."""
    scene, run = make_scene(), Run(factory)
    for k, seen in enumerate(scene.frames):
        if k > 3:
            seen = replace(seen, uv_right=np.full_like(seen.uv_right, np.nan)).select(run.in_map(seen))
        _, report = run.step(k, seen)
    require_status(report, UpdateStatus.OK, "an update with left pixels alone")
    require(report.dof <= 3 * len(report.used), "right pixels that were not observed count as degrees of freedom")
    assert_near(run.backend.estimate().T_world_left, scene.poses[-1], "pose by left pixels", factor=3)


def wrong_match_is_rejected(factory: Factory) -> None:
    """One gross mismatch is reported and moves nothing."""
    scene = make_scene()
    backend, seen = all_but_the_last(factory, scene)
    shift = np.zeros((len(seen), 2))
    shift[4] = [60.0, -45.0]
    report = backend.update(Observations(seen.ids, seen.uv_left + shift, seen.uv_right + shift))
    rejected = seen.ids[4] in report.rejected and seen.ids[4] not in report.used
    require(rejected, "a match that is 75 px off was not rejected")
    assert_near(backend.estimate().T_world_left, scene.poses[-1], "pose despite a wrong match")


def guess_is_no_measurement(factory: Factory) -> None:
    """A pose to start from changes nothing that matters, be it good or bad."""
    scene = make_scene()
    for offset in (np.zeros(6), np.array([0.02, -0.03, 0.01, 0.1, -0.1, 0.2])):
        backend, seen = all_but_the_last(factory, scene)
        report = backend.update(seen, guess=scene.poses[-1] @ se3.exp(offset))
        require_status(report, UpdateStatus.OK, "an update with a guess")
        how = "good" if not offset.any() else "bad"
        assert_near(backend.estimate().T_world_left, scene.poses[-1], f"pose with a {how} guess to start from")
