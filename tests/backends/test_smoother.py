"""What the contract does not ask of the smoother: poses of the graph, the lag, gaps, mended measurements."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from backends.smoother import SmootherBackend
from backends.smoother.factors import FactorMaker, to_pose3
from slam.data import Observations, UpdateStatus
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from slam.window import motion
from slam.window.stereo import RectifiedStereo
from tests.backends.scenes import RIG, forget, nees, observe, path, run, scene, step, with_far_points

MODELS = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=0.5)
DT = 0.1


def drive(frames: int, **options):
    """A drive past points that come and go: data of a scene, ids far more than are ever in view."""
    poses = path(frames, DT, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.03, 0.0]))
    return scene(poses, **options)


def errors(T, truth):
    """Distance [m] and angle [rad] between poses."""
    off = se3.log(se3.inverse(truth) @ T)
    return np.linalg.norm(off[..., 3:], axis=-1), np.linalg.norm(off[..., :3], axis=-1)


def sigma(backend):
    """Standard deviation [m] of the newest position."""
    return np.sqrt(np.trace(backend.estimate(landmarks=False).covariance[3:, 3:]))


def tracked(data, **options):
    """A back end after a scene; landmarks that are out of view are removed."""
    models = options.pop("models", MODELS)
    backend, known = SmootherBackend(RIG, models, **options), set()
    for stamp, _, seen in data:
        step(backend, stamp, seen, known)
        forget(backend, known, seen)
    return backend


OPTIONS = [{}, {"track": 3}, {"lag": None}, {"lag": 4, "past": 0}]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_the_path_and_its_covariance_with_all_options(options):
    data = drive(45, points=250)
    backend = tracked(data, **options)
    moved, turned = errors(backend.trajectory().poses, data.poses)
    assert moved.max() < 0.1 and turned.max() < 0.01
    assert nees(backend, data.poses[-1]) < 25
    assert backend.revises_path == (options.get("lag", 16) is None)
    assert (len(backend.state.sights) < 9) == ("past" in options), "what is kept does not grow for ever"


@pytest.mark.parametrize(
    ("seen_at_once", "seed", "most"),
    [(100, 0, 0.3), (15, 0, 1.5), (8, 2, 2.5)],
)
def test_far_landmarks_that_soon_leave_are_not_believed_too_much(seen_at_once, seed, most):
    """Of 100 in a frame: what hung at another pose, and landmarks first seen there, shared an error: 1.9 m, 13 sigma.

    Of 15: as variables far ones are linearised where they are not linear: 3.8 m, 18 sigma. Of 8: what was known of
    variables from afar stayed linear as the camera passed them: 131 m, 90 sigma.
    """
    poses = path(150, DT, np.array([0.0, 0.0, 8.0]), np.zeros(3))
    models = EstimatorModels(MotionModel(1.0, 0.3), 0.7, initial_velocity_sigma=15.0)
    points, noise = (1500, 0.5) if seed == 0 else (800, 0.7)
    data, known = scene(poses, points=points, sigma=noise, limit=seen_at_once, seed=seed), set()
    backend = SmootherBackend(RIG, models)
    for k, (stamp, truth, seen) in enumerate(data):
        assert step(backend, stamp, seen, known).status is UpdateStatus.OK or not k, "also with far points alone"
        forget(backend, known, seen)
        off = np.linalg.norm(backend.estimate(landmarks=False).T_world_left[:3, 3] - truth[:3, 3])
        assert off < min(3 * sigma(backend), most), k


def test_points_at_a_disparity_of_noise_do_not_rebuild_the_graph():
    """Noise puts some behind a camera, which gtsam's factor throws at: the graph was built anew once every lag."""
    backend = SmootherBackend(RIG, EstimatorModels(MotionModel(1.0, 0.3), 0.7, initial_velocity_sigma=15.0))
    assert not any(report.reason for report in run(backend, with_far_points(40, 8.0))[1:])


def enter(backend, k: int, stamp: float, seen: Observations) -> None:
    """A frame that measures nothing, and adds two landmarks."""
    backend.predict(stamp)
    backend.update(Observations.empty())
    backend.add(Observations(10**6 + 2 * k + np.arange(2), seen.uv_left[:2], seen.uv_right[:2]))


@pytest.mark.parametrize(("options", "frames"), [({}, 1), ({}, 16), ({"lag": None}, 3), ({"lag": 4}, 4)], ids=str)
def test_new_landmarks_in_a_frame_that_measured_nothing_leave_what_is_known(options, frames):
    """Until the next update the graph lacks its pose: all that is known of the poses before it went unheard."""
    data, backend = list(drive(30, points=250)), SmootherBackend(RIG, MODELS, **options)
    run(backend, data[: 30 - frames])
    before, earlier = backend.estimate(), backend.recent(4)
    for k in range(30 - frames, 30):
        enter(backend, k, *data[k][::2])
    after, recent = backend.estimate(), backend.recent(4 + frames)
    old = np.isin(after.ids, before.ids)
    np.testing.assert_allclose(after.covariances[old], before.covariances, rtol=1e-3, atol=1e-9)
    assert len(recent.stamps) == 4 + frames
    np.testing.assert_allclose(recent.covariance[:24, :24], earlier.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(recent.covariance[-6:, -6:], after.covariance, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(recent.covariance).min() > 0


@pytest.mark.parametrize(("lag", "dark"), [(2, 2), (2, 5), (4, 4), (4, 7), (16, 7), (16, 16), (16, 19)])
def test_frames_that_measured_nothing_are_no_failure(lag, dark):
    """A pose without its tie left the graph indeterminate; or all factors began anew at once, and sigma was .5 m."""
    data, backend, known = drive(dark + 20, points=250), SmootherBackend(RIG, MODELS, lag=lag), set()
    for k, (stamp, _, seen) in enumerate(data):
        if 10 <= k < 10 + dark:
            enter(backend, k, stamp, seen)
            continue
        report = step(backend, stamp, seen, known)
        assert not k or (report.status is UpdateStatus.OK and not report.reason), (k, report.reason)
        assert len(report.rejected) < 3
    assert nees(backend, data.poses[-1]) < 25
    assert lag < 4 or sigma(backend) < 0.04


@pytest.mark.parametrize("lag", [4, None])
def test_a_long_rest_is_no_burden_and_its_map_is_still_known(lag):
    data, backend, known = list(drive(24, points=250)), SmootherBackend(RIG, MODELS, lag=lag), set()
    run(backend, data[:20], known)
    last, before = data[19], sigma(backend)
    for k in range(1, 351):
        backend.predict_at_rest(last[0] + DT * k)
        backend.update(Observations.empty())
    assert lag is None or len(backend.state.poses) < 250
    for k, (_, _, seen) in enumerate(data[20:], 1):
        report = step(backend, last[0] + DT * (350 + k), seen, known)
        assert report.status is UpdateStatus.OK and len(report.rejected) < 4
    assert nees(backend, data[23][1]) < 25 and sigma(backend) < 2 * before
    assert len(backend.trajectory()) == 374


def test_landmarks_that_were_found_together_do_not_all_begin_anew_together():
    """That would leave but the motion model between two poses, and the newest one 2.8 times as uncertain."""
    data = drive(22, points=150)
    ours, best = (
        SmootherBackend(RIG, MODELS, landmarks=0),
        SmootherBackend(RIG, MODELS, lag=None, track=1000),
    )
    deviations = []
    for backend in (ours, best):
        run(backend, data)
        deviations.append(sigma(backend))
    assert deviations[0] < 1.4 * deviations[1], deviations


def test_a_place_in_the_world_that_is_hardly_known_does_not_move():
    """All that is measured is relative; the smoother must not wander about within what it does not know."""
    models = replace(MODELS, initial_position_sigma=10.0, initial_rotation_sigma=0.1)
    data = drive(90, points=500)
    backend = tracked(data, models=models)
    assert errors(backend.trajectory().poses, data.poses)[0].max() < 0.3
    deviations = np.sqrt(np.diag(backend.estimate(landmarks=False).covariance))
    assert deviations[:3].min() > 0.09 and deviations[:3].max() < 0.15, "the start's uncertainty stays"
    assert deviations[3:].min() > 9


def test_what_is_known_of_a_landmark_outlasts_the_poses_that_measured_it():
    """It was found anew from the measurements of those poses alone that were kept: .09 m and .40 m off for .03 m."""
    backend, known = SmootherBackend(RIG, MODELS, past=10), set()
    seen_last: dict[int, tuple[int, np.ndarray, np.ndarray]] = {}
    for k, (stamp, _, seen) in enumerate(drive(90, points=500)):
        step(backend, stamp, seen, known)
        marks = backend.state.landmarks
        for i, last, position, own in zip(marks.ids.tolist(), marks.pose.max(axis=1), marks.position, marks.own):
            if last == k - 17:  # by now it stands still: its poses have left the lag
                seen_last[i] = last, position, own
    old = [i for i, (last, *_) in seen_last.items() if last == marks.pose.max(axis=1)[marks.rows_of([i])[0]]]
    assert len(old) > 15 and backend.state.first > 40
    for what, number in (("position", 1), ("own", 2)):
        expected = np.array([seen_last[i][number] for i in old])
        np.testing.assert_allclose(getattr(marks, what)[marks.rows_of(old)], expected, rtol=1e-6, atol=1e-9)
    assert np.linalg.eigvalsh(backend.estimate().covariances).min() > 0, "also where no pose is kept any more"


def test_landmarks_behind_the_camera_are_as_uncertain_as_when_they_were_seen_last():
    """Their measurements were taken for some of a later pose, which sees nothing behind it: a median NEES of 70."""
    poses, known = path(100, DT, np.array([0.0, 0.0, 4.0]), np.zeros(3)), set()
    models = EstimatorModels(MotionModel(1.0, 0.3), 0.7, initial_velocity_sigma=15.0)
    backend, data, then = SmootherBackend(RIG, models), scene(poses, points=1000, limit=40, sigma=0.7), {}
    for stamp, _, seen in data:
        step(backend, stamp, seen, known)
        found = backend.estimate()
        P = dict(zip(found.ids.tolist(), np.trace(found.covariances, axis1=1, axis2=2)))
        then.update((i, P[i]) for i in seen.ids.tolist() if i in P)
    off = (found.positions - data.points[found.ids])[:, :, None]
    squared = (np.swapaxes(off, 1, 2) @ np.linalg.solve(found.covariances, off)).ravel()
    passed = data.points[found.ids, 2] < poses[-1][2, 3] - 8
    assert passed.sum() > 20 and np.median(squared[passed]) < 6  # χ²₃: 2.4; they share the path's error
    grown = np.sqrt([P[i] / then[i] for i in found.ids[passed].tolist()])
    assert grown.max() < 1.05, "not by the path since"


def swaying(frames: int, points: int):
    """A camera that sways before a few points."""
    sway = np.cos(np.arange(frames) / 12)
    return scene(
        se3.pose(np.tile(np.eye(3), (frames, 1, 1)), (sway - 1)[:, None] * np.array([0.4, 0, 0.2])),
        points=points, limit=points,
    )  # fmt: skip


def test_a_landmark_measured_for_longer_than_the_lag_keeps_what_was_known_of_it():
    """A camera sways before the same few points: its error does not grow with every lag."""
    # A variable is made only where a landmark's distance is at least 30 of its deviations: with 3 px few would be.
    data, models = swaying(150, 8), replace(MODELS, pixel_sigma=1.0)
    kept, anew = (SmootherBackend(RIG, models, landmarks=n) for n in (20, 0))
    for backend in (kept, anew):
        run(backend, data)
    deviations = [sigma(backend) for backend in (kept, anew)]
    assert deviations[0] < 0.5 * deviations[1], deviations
    assert errors(kept.trajectory().poses[-1], data.poses[-1])[0] < 3 * deviations[0]
    estimate = kept.estimate()
    off = estimate.positions - data.points[estimate.ids]
    distances = np.einsum("ni,nij,nj->n", off, np.linalg.inv(estimate.covariances), off)
    assert np.median(distances) < 6 and kept.state.landmarks.variable.sum() >= 4


def test_landmarks_that_are_variables_outlast_more_than_a_lag_of_frames_that_measured_nothing():
    """They had left the graph before they were measured again, and there was nothing but the motion model."""
    data, backend, known = swaying(60, 8), SmootherBackend(RIG, MODELS, lag=6), set()
    for k, (stamp, _, seen) in enumerate(data):
        if 40 <= k < 50:
            enter(backend, k, stamp, seen)
        else:
            assert not (step(backend, stamp, seen, known).reason and k), "it is not built anew"
        if k == 39:
            before, variables = sigma(backend), backend.state.landmarks.variable
    assert variables.sum() >= 4
    assert backend.state.landmarks.variable[: len(variables)][variables].all()
    assert errors(backend.trajectory().poses[-1], data.poses[-1])[0] < 3 * sigma(backend) < 4.5 * before


@pytest.mark.parametrize(("every", "frames"), [(9, 118), (20, 121)])
def test_frames_that_measure_are_held_together_however_many_lie_between(every, frames):
    """Each landmark's factor was taken for one that had not been measured for long: sigma was 1.7 to 5.7 m."""
    poses, known = path(frames, DT, np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.03, 0.0])), set()
    backend = SmootherBackend(RIG, MODELS)
    for k, (stamp, _, seen) in enumerate(scene(poses, points=300, limit=40)):
        step(backend, stamp, Observations.empty() if k % every else seen, known)
    assert errors(backend.trajectory().poses[-1], poses[-1])[0] < 3 * sigma(backend) < 0.1


def test_the_map_is_where_it_was_after_a_hundred_frames_in_the_dark():
    """The problem began anew with the pose as predicted: it and the map were 2.2 m off from then on."""
    models = EstimatorModels(
        MotionModel(0.05, 0.02), 0.5, initial_velocity_sigma=0.1, initial_angular_velocity_sigma=0.05
    )
    data, backend, known = swaying(140, 40), SmootherBackend(RIG, models), set()
    for k, (stamp, _, seen) in enumerate(data):
        step(backend, stamp, Observations.empty() if 20 <= k < 130 else seen, known)
    assert errors(backend.trajectory().poses[-1], data.poses[-1])[0] < 3 * sigma(backend) < 0.1
    assert backend.trajectory().stamps.tolist() == data.stamps.tolist()


def test_landmarks_that_return_after_a_lap_are_measured_again_without_a_lag():
    """What the camera had drifted since did not count: 16 good measurements were refused."""
    models, refused = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=1.0), 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        rays = rng.standard_normal((400, 3)) * (1, 0.35, 1)
        points = rays / np.linalg.norm(rays, axis=1)[:, None] * rng.uniform(3, 8, (400, 1))
        backend, known = SmootherBackend(RIG, models, lag=None), set()
        for k, T in enumerate(path(130, DT, np.array([0.6, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))):
            report = step(backend, k * DT, observe(T, points, 1.0, rng, 10), known)
            refused += len(report.rejected) if k > 62 else 0
    assert refused < 5


# --- measurements that are mended ---


def off_by(seen: Observations, offset: float) -> Observations:
    """Observations with right pixels moved along the row."""
    return Observations(seen.ids, seen.uv_left, seen.uv_right + np.array([offset, 0.0]))


@pytest.mark.parametrize("options", [{}, {"lag": None}, {"lag": 10}], ids=str)
def test_right_pixels_are_mended_afterwards(options):
    data = drive(24, points=200)
    right, mended, spoilt = (SmootherBackend(RIG, MODELS, **options) for _ in range(3))
    known: list[set[int]] = [set(), set(), set()]
    for k, (stamp, _, seen) in enumerate(data):
        if k == 14:
            before = mended.estimate(landmarks=False).T_world_left
            mended.revise(lambda z: z + np.array([0.0, 0.0, 0.8]))
            np.testing.assert_allclose(mended.estimate(landmarks=False).T_world_left, before, atol=1e-9)
            np.testing.assert_allclose(mended.trajectory().poses[-1], before, atol=1e-9)
        early = off_by(seen, -0.8) if k < 14 else seen
        for backend, ids, given in zip((right, mended, spoilt), known, (seen, early, early)):
            step(backend, stamp, given, ids)

    def shape(backend):  # the newest pose stays, so the path has moved in the world
        poses = backend.trajectory().poses
        return se3.inverse(poses[0]) @ poses

    off = [errors(shape(backend), data.poses)[0].max() for backend in (right, mended, spoilt)]
    assert off[1] < off[0] + 0.005 < off[2], off
    ours, theirs = mended.estimate(), right.estimate()
    np.testing.assert_array_equal(ours.ids, theirs.ids)
    local, truth = (se3.transform(se3.inverse(e.T_world_left), e.positions) for e in (ours, theirs))
    seen = np.isin(ours.ids, data.observations[-1].ids)
    deviations = np.sqrt(np.trace(theirs.covariances, axis1=1, axis2=2))
    assert np.median((np.linalg.norm(local - truth, axis=1) / deviations)[seen]) < 0.6  # of its own uncertainty


def test_a_revision_that_changes_nothing_leaves_the_covariances():
    """Up to what poses that have left the lag told of it: the graph is built anew from the poses of the lag alone."""
    data = drive(30, points=250)
    backend = tracked(data)
    before = backend.estimate()
    backend.revise(lambda z: z)
    after = backend.estimate()
    np.testing.assert_allclose(after.covariance, backend.recent(1).covariance, rtol=1e-6, atol=1e-12)
    deviations = [np.sqrt(np.diag(e.covariance)) for e in (before, after)]
    assert (deviations[1] > 0.99 * deviations[0]).all() and (deviations[1] < 1.3 * deviations[0]).all()
    seen = np.isin(before.ids, data.observations[-1].ids)
    sizes = [np.sqrt(np.trace(e.covariances, axis1=1, axis2=2))[seen] for e in (before, after)]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=0.12)
    assert abs(np.median(sizes[1] / sizes[0]) - 1) < 0.01


def test_a_revision_in_the_dark_keeps_how_far_the_camera_may_have_gone():
    """Landmarks that come back were looked for within a tenth of the uncertainty of their pixels."""
    data, backend, known = scene(path(60, DT, np.array([0.0, 0.0, 0.1]), np.zeros(3)), points=60), tracked([]), set()
    for k, (stamp, _, seen) in enumerate(data):
        if k < 40:
            step(backend, stamp, seen, known)
        else:
            before = backend.predict(stamp)
    backend.revise(lambda z: z)
    after, at = backend.predict(60 * DT), {i: row for row, i in enumerate(before.ids.tolist())}
    both = [(row, at[i]) for row, i in enumerate(after.ids.tolist()) if i in at]
    ratio = [np.sqrt(np.trace(after.innovation[a]) / np.trace(before.innovation[b])) for a, b in both]
    assert len(ratio) > 20 and 0.9 < np.median(ratio) < 1.3, "one more frame in the dark adds a little"


def test_mended_measurements_do_not_part_the_path_from_poses_that_have_left():
    data = drive(60, points=400)
    backend = tracked(data, lag=6, past=0)
    before, first = backend.trajectory().poses, backend.state.first
    backend.revise(lambda z: z + np.array([0.0, 0.0, 1.0]))
    after = backend.trajectory().poses
    relative, earlier = (se3.inverse(poses[:-1]) @ poses[1:] for poses in (after, before))
    moved = errors(relative, earlier)[0]
    assert moved[: first - 1].max() < 1e-9 and moved[first:].max() > 1e-3
    assert moved.max() < 0.05, "no step between what has left and what has not"


# --- parts ---


def test_the_motion_model_does_not_pull_at_the_path_as_a_whole():
    """Nothing else holds it: linearised at other poses than the rest, the model moved a lag by up to 9 m in a bend."""
    rng = np.random.default_rng(0)
    factor = FactorMaker(RectifiedStereo.of(RIG), MODELS).motion([X(i) for i in range(3)], np.array([0.1, 0.2]))
    for _ in range(3):
        values, poses = gtsam.Values(), se3.exp(rng.normal(0, 0.3, (3, 6)))
        for i, T in enumerate(poses):
            values.insert(X(i), to_pose3(T))
        A, b = factor.linearize(values).jacobian()
        whole = se3.adjoint(se3.inverse(poses)).reshape(-1, 6)  # the poses' perturbations where the world moves
        assert np.linalg.norm(A.T @ b) > 1 and np.abs(whole.T @ A.T @ b).max() < 1e-6 * np.linalg.norm(A.T @ b)


def test_a_known_landmark_tells_what_is_known_of_it():
    """The information of its factor on the landmark is the inverse of its covariance, wherever the camera is."""
    rng = np.random.default_rng(0)
    A, local = rng.normal(0, 0.1, (3, 3)), np.array([1.0, -0.5, 4.0])
    P, T = A @ A.T, se3.exp(rng.normal(0, 0.5, 6))
    factor = FactorMaker(RectifiedStereo.of(RIG), MODELS).known_from(3, 7, local, P)
    values = gtsam.Values()
    values.insert(X(3), to_pose3(T))
    values.insert(L(7), se3.transform(T, local[None])[0])
    linear, R = factor.linearize(values), T[:3, :3]
    assert linear.keys() == [X(3), L(7)]
    np.testing.assert_allclose(np.linalg.inv(linear.information()[6:, 6:]), R @ P @ R.T, rtol=1e-6, atol=1e-9)
    assert np.abs(linear.jacobian()[1]).max() < 1e-6


# --- what goes on from one graph to the next ---


@pytest.mark.parametrize("off", [None, 2.0])
def test_a_predicted_pose_has_the_covariance_of_the_velocity_that_it_moves_on_with(off):
    """The velocity is that between the last two poses, whose errors it has a part in; also after a revision."""
    models, known = EstimatorModels(MotionModel(0.1, 0.02), pixel_sigma=2.0), set()
    backend = SmootherBackend(RIG, models)
    for stamp, _, seen in drive(12, points=60, limit=14):
        step(backend, stamp, seen if off is None else off_by(seen, -off), known)
    if off is not None:
        backend.revise(lambda z: z + np.array([0.0, 0.0, off]))
    last = backend.recent(2)
    for k in range(2):
        predicted = backend.predict(1.2 + 0.1 * k)
        T, J, noise, _ = motion.predicted(models, last.poses, DT, DT)
        P = np.block(
            [[last.covariance, last.covariance @ J.T], [J @ last.covariance, J @ last.covariance @ J.T + noise]]
        )
        np.testing.assert_allclose(predicted.T_world_left, T, atol=1e-9)
        np.testing.assert_allclose(predicted.covariance, P[12:, 12:], rtol=1e-4, atol=1e-9)
        last = backend.recent(2)
        np.testing.assert_allclose(last.covariance[6:, 6:], P[12:, 12:], rtol=1e-4, atol=1e-9)
