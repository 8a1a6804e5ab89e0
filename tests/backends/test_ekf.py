from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

import backends.ekf.filter as ekf_filter
from backends.ekf import EkfBackend
from slam.data import Observations, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel, models_for
from tests.backends.scenes import RIG, Scene, cloud, observe, path, random_path, run, scene, step
from tests.slam.numeric import assert_equal_to_rounding, jacobian

FORWARD, STILL = np.array([0, 0, 1.5]), np.zeros(3)
YAW, ROLL = np.array([0, 1.0, 0]), np.array([0, 0, 1.0])
MODELS = EstimatorModels(MotionModel(0.3, 0.3), pixel_sigma=0.5)


def errors(backend: EkfBackend, truth: np.ndarray) -> np.ndarray:
    """Largest rotation [rad] and translation error [m] over the trajectory."""
    xi = se3.log(se3.inverse(truth) @ backend.trajectory().poses)
    return np.array([np.linalg.norm(xi[:, :3], axis=1).max(), np.linalg.norm(xi[:, 3:], axis=1).max()])


def nees(backend: EkfBackend, truth: np.ndarray) -> float:
    found = backend.estimate(landmarks=False)
    xi = se3.log(se3.inverse(found.T_world_left) @ truth)
    return float(xi @ np.linalg.solve(found.covariance, xi))


def in_deviations(P: np.ndarray, of: np.ndarray) -> np.ndarray:
    """A covariance in units of another's standard deviations: entries of m², m rad/s and 1/m² become comparable."""
    deviation = np.sqrt(np.diag(of))
    return P / np.outer(deviation, deviation)


def halfway(data: Scene, frames: int, models: EstimatorModels = MODELS, **options) -> tuple[EkfBackend, set[int]]:
    """A filter after some frames of a scene, and the landmarks it knows."""
    backend, known = EkfBackend(data.rig, models, **options), set()
    for stamp, _, seen in list(data)[:frames]:
        step(backend, stamp, seen, known)
    return backend, known


def predicted(data: Scene, frames: int, **options) -> tuple[EkfBackend, Observations]:
    """A filter with frame number `frames` predicted, and what it will see there of its map."""
    backend, known = halfway(data, frames, **options)
    backend.predict(float(data.stamps[frames]))
    seen = data.observations[frames]
    return backend, seen.select(np.array([i in known for i in seen.ids.tolist()]))


@pytest.fixture(scope="module")
def drive() -> Scene:
    return scene(path(30, 0.1, FORWARD, 0.3 * YAW), points=300)


# --- options ---


@pytest.mark.parametrize(
    "options, message",
    [
        (
            {"iteration": 3},
            r"unknown option 'iteration' \(did you mean 'iterations'\?\); known: measurement, iterations",
        ),
        ({"measurement": "mono"}, "measurement"),
        ({"landmarks": "polar"}, "landmarks"),
        ({"iterations": 0}, "iterations"),
        ({"iterations": 2.5}, "iterations"),
        ({"iterations": True}, "iterations"),
        ({"consistent": 1}, "consistent"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ConfigurationError, match=message):
        EkfBackend(RIG, **options)


def test_defaults_need_nothing_but_the_rig():
    assert EkfBackend(RIG).predict(0.0).T_world_left.shape == (4, 4)


# --- arithmetic of a step ---


def test_prediction_is_as_printed(drive):
    backend, _ = halfway(drive, 5, consistent=False)
    before, P = backend._camera.copy(), backend._covariance.full()
    dt = 0.25
    backend.predict(float(drive.stamps[4] + dt))
    A = np.eye(len(P))
    A[:6, 6:12] = dt * np.eye(6)
    W = np.zeros((len(P), 6))
    W[:6], W[6:12] = dt * np.eye(6), np.eye(6)
    linear, angular = MODELS.motion.velocity_variance(dt)
    assert_equal_to_rounding(backend._camera, A[:12, :12] @ before)
    expected = A @ P @ A.T + W @ np.diag([linear] * 3 + [angular] * 3) @ W.T
    assert_equal_to_rounding(in_deviations(backend._covariance.full(), expected), in_deviations(expected, expected))


@pytest.mark.parametrize("landmarks", ["inverse_depth", "euclidean"])
def test_the_update_is_the_joseph_form(drive, landmarks):
    backend, seen = predicted(drive, 10, iterations=1, landmarks=landmarks, consistent=False)
    P, state = backend._covariance.full(), backend._landmarks.state.copy()
    x = np.concatenate([backend._camera, state.reshape(-1)])
    slots = backend._landmarks.slots(seen.ids)
    backend._covariance.make_local(slots)
    problem = backend._problem(seen, slots, None)
    line = problem.model.linearise(problem.prior)
    small = jacobian(lambda y: problem.model.predict(y).reshape(-1), problem.prior, 1e-5)
    report = backend.update(seen)
    assert len(report.used) == len(seen) > 20
    H = np.zeros((3 * len(seen), len(P)))
    H[:, :6] = small[:, :6]
    for i, s in enumerate(slots):
        H[:, 12 + 3 * s : 15 + 3 * s] = small[:, 6 + 3 * i : 9 + 3 * i]
    R = 0.25 * np.eye(len(H))
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    J = np.eye(len(P)) - K @ H
    nu = (problem.z - line.z).reshape(-1)
    joseph = J @ P @ J.T + K @ R @ K.T
    scale = np.sqrt(np.outer(np.diag(joseph), np.diag(joseph)))
    assert np.abs((backend._covariance.full() - joseph) / scale).max() < 1e-5  # what the differences leave in H
    found = np.concatenate([backend._camera, backend._landmarks.state.reshape(-1)])
    np.testing.assert_allclose(found, x + K @ nu, rtol=1e-6, atol=1e-6)
    assert report.nis == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-6)
    assert report.dof == 3 * len(seen)


@pytest.mark.parametrize("landmarks", ["inverse_depth", "euclidean"])
def test_augmentation_is_the_derivative_of_triangulation(drive, landmarks):
    backend, known = halfway(drive, 6, landmarks=landmarks)
    left, right = RIG.project(np.array([[0.4, -0.3, 6.0]]))
    new = Observations(np.array([max(known) + 1]), left, right)
    P, camera = backend._covariance.full(), backend._camera.copy()
    backend.add(new)
    marks, h = backend._landmarks, RIG.triangulate(new.uv_left, new.uv_right)
    R = ekf_filter.attitude(backend._R_world_angles, camera[3:6])

    def coordinates(x):
        turned = ekf_filter.attitude(backend._R_world_angles, x[3:6])
        return marks.coordinates.of(marks.anchors[-1:], x[:3] + (h + x[6:]) @ turned.T)[0]

    J = jacobian(coordinates, np.concatenate([camera[:6], np.zeros(3)]))
    whole = backend._covariance.full()
    noise = J[:, 6:] @ RIG.triangulation_covariance(h, 0.5)[0] @ J[:, 6:].T
    cross = J[:, :6] @ P[:6]
    expected = np.block([[P, cross.T], [cross, J[:, :6] @ P[:6, :6] @ J[:, :6].T + noise]])
    # central differences by 1e-6 leave 1e-10 in J
    np.testing.assert_allclose(in_deviations(whole, expected), in_deviations(expected, expected), atol=1e-7)
    np.testing.assert_allclose(backend.positions(new.ids)[0], camera[:3] + R @ h[0], atol=1e-12)


# --- accuracy ---


@pytest.mark.parametrize("sigma", [1e-2, 1e-3])
def test_without_noise_the_path_is_exact(sigma):
    data = scene(path(200, 0.1, np.array([0.2, 0.1, 0.5]), np.array([0.3, 0.2, 0.4])), points=600, sigma=0.0)
    models = EstimatorModels(pixel_sigma=sigma, initial_position_sigma=1e-6, initial_rotation_sigma=1e-7)
    backend = EkfBackend(RIG, models)
    run(backend, data)
    assert errors(backend, data.poses).max() < 1e-4


@pytest.mark.parametrize("measurement, dof", [("stereo", 3), ("left", 2)])
def test_both_measurements_follow_the_camera(drive, measurement, dof):
    backend = EkfBackend(RIG, MODELS, measurement=measurement)
    reports = run(backend, drive)
    assert errors(backend, drive.poses).max() < 0.15  # the left pixel alone lets the depth drift
    assert all(r.dof == dof * len(r.used) for r in reports)


@pytest.mark.parametrize("rate", [YAW, ROLL, np.array([0.6, 0.6, 0.6])], ids=["heading", "roll", "all"])
def test_the_angles_singularity_is_harmless(rate):
    data = scene(path(70, 0.1, 0.2 * FORWARD, rate), points=1000)  # turns by 400 degrees
    backend = EkfBackend(RIG, MODELS)
    reports = run(backend, data)
    assert errors(backend, data.poses).max() < 0.03
    assert nees(backend, data.poses[-1]) < chi2.ppf(0.9999, 6)
    assert sum(len(r.rejected) for r in reports) < 10


def test_a_turn_through_the_singularity_in_one_step():
    data = scene(path(30, 0.5, STILL, 4 * ROLL), points=300)  # 115 degrees a frame
    backend = EkfBackend(RIG, replace(MODELS, initial_angular_velocity_sigma=3.0))
    known: set[int] = set()
    for stamp, guess, seen in data:
        backend.predict(stamp)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        backend.update(seen.select(old), guess)
        backend.add(seen.select(~old))
        known.update(seen.ids.tolist())
        assert np.linalg.eigvalsh(backend.estimate(False).covariance).min() > 0
    assert errors(backend, data.poses)[0] < 0.02


def test_the_first_step_may_be_long():
    """A car at 15 m/s with points at 10 m, when nothing is known of its speed."""
    for seed in range(5):
        poses, rng = path(3, 0.1, 10 * FORWARD, 0.1 * YAW), np.random.default_rng(seed)
        points = cloud(poses, 60, rng, 6.0, 14.0)
        backend, known = EkfBackend(RIG, replace(models_for("driving"), pixel_sigma=0.5)), set()
        for k, T in enumerate(poses):
            report = step(backend, 0.1 * k, observe(T, points, 0.5, rng, 60), known)
        assert len(report.used) > 15 and len(report.rejected) <= 1
        assert errors(backend, poses).max() < 0.12
        assert nees(backend, poses[-1]) < chi2.ppf(0.9999, 6)


@pytest.mark.parametrize("gap", [1.0, 3.0])
def test_gaps_of_seconds(gap):
    poses, rng = path(6, gap, 3 * FORWARD, 0.05 * YAW), np.random.default_rng(0)
    points = cloud(poses, 300, rng, 5.0, 40.0)
    backend, known = EkfBackend(RIG, replace(models_for("driving"), pixel_sigma=0.5)), set()
    for k, T in enumerate(poses):
        report = step(backend, gap * k, observe(T, points, 0.5, rng, 40), known)
        assert k == 0 or len(report.used) > 5 * len(report.rejected)
    assert np.linalg.norm(backend.trajectory().poses[-1][:3, 3] - poses[-1][:3, 3]) < 0.05 * 5 * gap * 4.5


def test_a_shock_beyond_the_motion_model_is_followed():
    before = path(15, 0.1, 0.3 * FORWARD, STILL)
    after = before[-1] @ path(15, 0.1, np.array([1.2, 0, 0]), 0.8 * YAW)[1:]
    data = scene(np.concatenate([before, after]), points=300)
    backend = EkfBackend(RIG, EstimatorModels(MotionModel(0.1, 0.1), pixel_sigma=0.5))
    reports = run(backend, data)
    assert all(len(r.used) > len(r.rejected) for r in reports[1:])
    assert errors(backend, data.poses).max() < 0.05


@pytest.mark.parametrize("gap", [1e3, 1e5, 1e9])
def test_a_gap_of_any_length(gap):
    """A paused recording, while the camera was moved a little: tracked again from the first frame on."""
    for moved in (np.zeros(6), np.array([0.1, -0.3, 0.05, 0.4, -0.2, 0.3])):
        before = path(15, 0.1, 0.5 * FORWARD, 0.1 * YAW)
        poses = np.concatenate([before, before[-1] @ se3.exp(moved) @ path(15, 0.1, 0.5 * FORWARD, 0.1 * YAW)])
        data = scene(poses, points=200)
        backend, known = EkfBackend(RIG, MODELS), set()
        for k, (stamp, _, seen) in enumerate(data):
            report = step(backend, stamp + (gap if k >= 15 else 0), seen, known)
            assert k == 0 or len(report.used) > 5 * len(report.rejected)
        assert errors(backend, poses)[1] < 0.05
        P = backend._covariance.full()
        assert np.linalg.eigvalsh(P / np.sqrt(np.outer(P.diagonal(), P.diagonal()))).min() > 0


@pytest.mark.parametrize("count", [5, 7, 20])
def test_known_landmarks_are_found_again_after_a_blind_stretch(count):
    """The camera went where the motion model does not expect it, and sees but landmarks it knows: it starts there."""
    before, after = path(15, 0.1, 0.3 * FORWARD, STILL), path(20, 0.1, 0.3 * FORWARD, 0.1 * YAW)
    hidden = se3.exp(np.array([0.05, 0.3, -0.1, 1.5, -0.5, 1.0]))
    poses = np.concatenate([before, before[-1] @ hidden @ after])
    rng = np.random.default_rng(2)
    points = cloud(poses[:1], 60, rng, 6.0, 12.0)
    backend, known = EkfBackend(RIG, EstimatorModels(MotionModel(0.02, 0.02), pixel_sigma=0.5)), set()
    for k, T in enumerate(before):
        step(backend, 0.1 * k, observe(T, points, 0.5, rng, 60), known)
    backend.predict(1.6)
    for k, T in enumerate(poses[15:]):
        backend.predict(1.7 + 0.1 * k)
        seen = observe(T, points, 0.5, rng, 60)
        report = backend.update(seen.select(np.array([i in known for i in seen.ids.tolist()])).select(np.arange(count)))
        assert k == 0 or len(report.used) > len(report.rejected)
    assert np.linalg.norm(backend.trajectory().poses[-1][:3, 3] - poses[-1][:3, 3]) < 0.05
    assert nees(backend, poses[-1]) < chi2.ppf(0.9999, 6)


@pytest.mark.parametrize("landmarks", ["inverse_depth", "euclidean"])
def test_an_update_that_ends_a_great_uncertainty_keeps_all_its_digits(landmarks):
    """Two maps, each seen after a gap of years, joined by one look: half of the landmarks are not in it."""
    backend, rng = EkfBackend(RIG, EstimatorModels(pixel_sigma=0.5), landmarks=landmarks), np.random.default_rng(0)
    points = cloud(np.eye(4)[None], 80, rng)
    ids = np.arange(len(points))

    def seen(which: np.ndarray) -> Observations:
        all_ = observe(np.eye(4), points, 0.5, rng, limit=80)
        return all_.select(np.isin(all_.ids, which))

    backend.predict(0.0)
    backend.add(seen(ids[:30]))
    backend.predict(1e9)
    backend.add(seen(ids[30:]))
    backend.predict(1e9 + 1e5)
    report = backend.update(seen(ids[::2]))
    assert report.status is UpdateStatus.OK and len(report.used) > 15
    P = backend._covariance.full()
    deviation = np.sqrt(P.diagonal())
    assert np.linalg.eigvalsh(P / np.outer(deviation, deviation))[0] > 0
    assert (np.linalg.eigvalsh(backend.estimate().covariances)[:, 0] > 0).all()


def test_a_pair_that_is_not_in_step_moves_nothing():
    """The first right images were taken at other times, at 10 m/s: their landmarks contradict all that follows."""
    poses, rng = path(10, 0.1, 6.7 * FORWARD, STILL), np.random.default_rng(1)
    models = replace(models_for("driving"), pixel_sigma=0.5)
    points = cloud(poses, 150, rng, 10.0, 50.0)
    backend, known = EkfBackend(RIG, models), set()
    late = se3.pose(np.eye(3), [0, 0, 0.5])
    for k, T in enumerate(poses):
        seen = observe(T, points, 0.5, rng, 150)
        if k < 2:
            local = se3.transform(se3.inverse(T @ late if k else T @ se3.inverse(late)), points[seen.ids])
            seen = Observations(seen.ids, seen.uv_left, RIG.project(local)[1])
        if k in (1, 2):  # as long as there is nothing else to see
            seen = seen.select(np.array([i in known for i in seen.ids.tolist()], bool))
        step(backend, 0.1 * k, seen, known)
        off = se3.log(se3.inverse(T) @ backend.trajectory().poses[-1])
        assert np.linalg.norm(off[:5]) < 0.3 and abs(off[5]) < 0.7 * T[2, 3] + 0.1


def test_the_trajectory_is_not_revised(drive):
    backend, known = EkfBackend(RIG, MODELS), set()
    said = []
    for stamp, _, seen in drive:
        step(backend, stamp, seen, known)
        said.append(backend.estimate(landmarks=False).T_world_left)
    np.testing.assert_array_equal(backend.trajectory().poses, said)


# --- robustness ---


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_wrong_matches_are_found(drive, share):
    rng = np.random.default_rng(3)
    backend, known, missed, false, wrong = EkfBackend(RIG, MODELS), set(), 0, 0, 0
    for stamp, _, seen in drive:
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        backend.predict(stamp)
        bad = old & (rng.random(len(seen)) < share)
        shift = np.where(bad[:, None], rng.normal(0, 30, (len(seen), 2)), 0.0)
        spoilt = Observations(seen.ids, seen.uv_left + shift, seen.uv_right + shift)
        report = backend.update(spoilt.select(old))
        backend.add(seen.select(~old))
        known.update(seen.ids.tolist())
        wrong += bad.sum()
        missed += np.isin(seen.ids[bad], report.used).sum()
        false += np.isin(seen.ids[old & ~bad], report.rejected).sum()
    assert wrong > 50 and missed < 0.03 * wrong  # some shifts are small
    assert false < 10
    assert errors(backend, drive.poses).max() < 0.04


def test_a_landmark_in_contradiction_with_the_others_is_found(drive):
    """An innovation within its own wide gate, but not where the others say: the velocity is unknown at first."""
    models = replace(models_for("driving"), pixel_sigma=0.5)
    backend, seen = predicted(drive, 1, models=models)
    uv_left, uv_right = seen.uv_left.copy(), seen.uv_right.copy()
    uv_left[5] += [8.0, -6.0]
    uv_right[5] += [8.0, -6.0]
    report = backend.update(Observations(seen.ids, uv_left, uv_right))
    np.testing.assert_array_equal(report.rejected, seen.ids[[5]])


def test_a_point_predicted_behind_the_camera_does_no_harm(drive):
    backend, seen = predicted(drive, 5)
    behind = backend._landmarks.slots(seen.ids[:1])
    backend._landmarks.state[behind] *= [1, 1, -1]
    report = backend.update(seen)
    assert report.status is UpdateStatus.OK and report.rejected.tolist() == seen.ids[:1].tolist()


def test_nothing_that_agrees_leaves_the_prediction(drive):
    backend, seen = predicted(drive, 5)
    before = backend.estimate()
    rng = np.random.default_rng(0)
    noise = rng.uniform(100, 200, (len(seen), 2)) * rng.choice([-1, 1], (len(seen), 2))
    report = backend.update(Observations(seen.ids, seen.uv_left + noise, seen.uv_right + noise[::-1]))
    assert report.status is UpdateStatus.EMPTY and report.reason
    np.testing.assert_array_equal(report.rejected, seen.ids)
    np.testing.assert_array_equal(backend.estimate().T_world_left, before.T_world_left)
    np.testing.assert_array_equal(backend.estimate().covariance, before.covariance)


@pytest.mark.parametrize("entry", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("where", ["pose", "landmark"])
def test_a_broken_covariance_is_a_status_with_a_reason(drive, entry, where):
    backend, seen = predicted(drive, 5)
    backend._covariance.make_local(backend._landmarks.slots(seen.ids))  # these are local now
    row = 1 if where == "pose" else 12 + 3 * int(backend._covariance._place[backend._landmarks.slots(seen.ids[3:4])[0]])
    backend._covariance._local[row, row] = entry
    before, camera, points = backend._covariance.full(), backend._camera.copy(), backend._landmarks.points.copy()
    report = backend.update(seen)
    assert report.status is UpdateStatus.FAILED and "ekf" in report.reason
    assert len(report.used) == 0
    np.testing.assert_array_equal(backend._covariance.full(), before)
    np.testing.assert_array_equal(backend._camera, camera)
    np.testing.assert_array_equal(backend._landmarks.points, points)


@pytest.mark.parametrize("landmarks", ["inverse_depth", "euclidean"])
def test_far_points_stay_before_the_camera(landmarks):
    """Points at 60 to 400 m, whose disparity is all noise: no position and no covariance loses its meaning.

    Nor do they hold up the first steps: the inverse depth of some wants to be negative.
    """
    rng = np.random.default_rng(5)
    poses = path(40, 0.1, np.array([0, 0, 2.0]), 0.02 * YAW)
    points = np.concatenate([cloud(poses, 60, rng, 4.0, 15.0), cloud(poses, 120, rng, 60.0, 400.0)])
    backend, known = EkfBackend(RIG, replace(MODELS, pixel_sigma=0.7), landmarks=landmarks), set()
    for k, T in enumerate(poses):
        step(backend, 0.1 * k, observe(T, points, 0.7, rng, 180), known)
        found = backend.estimate()
        depth = ((found.positions - T[:3, 3]) @ T[:3, :3])[found.ids >= 60, 2]
        assert landmarks == "euclidean" or (depth > 0).all()
        assert np.linalg.eigvalsh(found.covariances).min() > 0
        np.testing.assert_array_equal(found.covariances, np.swapaxes(found.covariances, 1, 2))
    assert landmarks == "euclidean" or errors(backend, poses)[1] < 0.05


@pytest.mark.parametrize("landmarks", ["inverse_depth", "euclidean"])
@pytest.mark.parametrize("disparity", [1e-6, 1e-12])
def test_hardly_any_disparity(drive, disparity, landmarks):
    backend, known = halfway(drive, 6, landmarks=landmarks)
    new, seen = max(known) + 1, drive.observations[6]
    left = np.array([[300.0, 200.0]])
    backend.add(Observations(np.array([new]), left, left - [disparity, 0]))
    backend.predict(0.6)
    report = backend.update(seen.select(np.array([i in known for i in seen.ids.tolist()])))
    assert report.status is UpdateStatus.OK and len(report.rejected) < 3
    P = backend._covariance.full()
    d = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(d, d)).min() > 0
    assert np.linalg.eigvalsh(backend.estimate().covariances).min() > 0


@pytest.mark.parametrize("pixel", [1e7, 1e300])
def test_no_pixel_of_a_camera(drive, pixel):
    backend, seen = predicted(drive, 5)
    uv = seen.uv_left.copy()
    uv[3, 0] = pixel
    with pytest.raises(MeasurementError, match="pixel"):
        backend.update(Observations(seen.ids, uv, seen.uv_right))
    uv[3, 0] = 0.9e6  # no camera has it, but a number that can be worked with
    report = backend.update(Observations(seen.ids, uv, seen.uv_right))
    np.testing.assert_array_equal(report.rejected, seen.ids[[3]])


# --- consistency ---


def test_nees_and_nis_are_in_their_bands():
    """Twelve runs whose motion and noise are as assumed, 30 frames each: the linearisation is fair for so long."""
    runs, frames, motion = 12, 30, MotionModel(0.3, 0.15)
    models = EstimatorModels(motion, pixel_sigma=0.5, initial_angular_velocity_sigma=0.2)
    pose_nees, nis, dof, landmark_nees = [], 0.0, 0, []
    for seed in range(runs):
        poses = random_path(frames, 0.1, 0.5 * FORWARD, motion, np.random.default_rng(100 + seed))
        data = scene(poses, points=200, seed=seed, limit=25)
        backend = EkfBackend(RIG, models)
        reports = run(backend, data)
        pose_nees.append(nees(backend, poses[-1]))
        nis, dof = nis + sum(r.nis for r in reports if r.dof), dof + sum(r.dof for r in reports)
        found = backend.estimate()
        off = (found.positions - data.points[found.ids])[:, :, None]
        landmark_nees.append((np.swapaxes(off, 1, 2) @ np.linalg.solve(found.covariances, off)).ravel())
    lower, upper = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs
    assert lower < np.mean(pose_nees) < upper
    assert nis / dof == pytest.approx(1.0, abs=0.05)  # 20,000 degrees of freedom: 5 standard deviations; less the gate
    assert 1.5 < np.median(np.concatenate(landmark_nees)) < 4.0  # χ²₃: 2.4; landmarks of a run are correlated


def drive_past_far_points(seed: int, landmarks: str) -> tuple[float, float, float]:
    """Position error [m], NEES of the pose and median NEES of the landmarks, which are 15 to 50 m away."""
    poses, rng = path(20, 0.1, np.array([0, 0, 4.0]), 0.02 * YAW), np.random.default_rng(seed)
    points = cloud(poses, 60, rng, 15.0, 50.0)
    models = EstimatorModels(MotionModel(1.0, 0.3), pixel_sigma=0.5, initial_velocity_sigma=5.0)
    backend, known = EkfBackend(RIG, models, landmarks=landmarks), set()
    for k, T in enumerate(poses):
        step(backend, 0.1 * k, observe(T, points, 0.5, rng, 60), known)
    found = backend.estimate()
    off = (found.positions - points[found.ids])[:, :, None]
    marks = np.swapaxes(off, 1, 2) @ np.linalg.solve(found.covariances, off)
    moved = np.linalg.norm(found.T_world_left[:3, 3] - poses[-1][:3, 3])
    return float(moved), nees(backend, poses[-1]), float(np.median(marks))


def test_far_points_are_believed_what_they_are_worth():
    """Eight drives: a far point's depth is Gaussian in its inverse, not in metres."""
    inverse, euclidean = (
        np.array([drive_past_far_points(seed, landmarks) for seed in range(8)]).T
        for landmarks in ("inverse_depth", "euclidean")
    )
    lower, upper = chi2.ppf([0.001, 0.999], 6 * 8) / 8
    assert lower < inverse[1].mean() < upper
    assert 2.0 < inverse[2].mean() < 2.8  # χ²₃ has its median at 2.37
    assert np.sqrt(np.mean(inverse[0] ** 2)) < 0.7 * np.sqrt(np.mean(euclidean[0] ** 2))  # 0.05 m and 0.10 m


def test_the_papers_filter_is_as_printed(drive):
    """With the left pixel alone nothing is added to the printed update, whatever the option says."""
    found = [
        halfway(drive, 8, measurement="left", iterations=1, landmarks="euclidean", **more)[0].estimate()
        for more in ({}, {"consistent": False})
    ]
    np.testing.assert_array_equal(found[0].T_world_left, found[1].T_world_left)
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


@pytest.mark.parametrize("iterations", [1, 5])
@pytest.mark.parametrize("landmarks", ["inverse_depth", "euclidean"])
def test_what_nothing_measures_stays_unknown(drive, landmarks, iterations):
    """A displacement of camera and landmarks together stays as uncertain as the first pose was.

    The information (the inverse of the covariance) on it is that of the prior, 1 in units of its sigmas, and so it is
    after any number of updates, also of those that are linearised anew; the plain filter believes to have measured it.
    """
    sigma = 0.01
    models = replace(MODELS, initial_position_sigma=sigma, initial_rotation_sigma=sigma)
    learnt = []
    for consistent in (True, False):
        backend, _ = halfway(drive, 25, models, landmarks=landmarks, consistent=consistent, iterations=iterations)
        marks, camera = backend._landmarks, backend._camera
        A = backend._turning(camera)
        shift = np.zeros((12 + 3 * len(marks), 6))
        shift[:3, :3], shift[:3, 3:] = np.eye(3), -se3.hat(camera[:3])
        shift[3:6, 3:] = np.linalg.inv(A)
        shift[6:9, 3:] = -se3.hat(camera[6:9])
        if not consistent:
            marks.transport(np.arange(len(marks)))
        shift[12:] = marks.gauge_jacobian.reshape(-1, 6)
        information = sigma**2 * shift.T @ np.linalg.solve(backend._covariance.full(), shift)
        learnt.append(np.diag(information))
    assert (learnt[0] < 1.01).all()  # less than 1 where the model's impulses have loosened it
    assert learnt[1].max() > 2.0


def test_the_result_does_not_depend_on_blas_threads(drive):
    results = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            backend, _ = halfway(drive, 12)
            results.append(backend.estimate())
    np.testing.assert_array_equal(results[0].T_world_left, results[1].T_world_left)
    np.testing.assert_array_equal(results[0].covariances, results[1].covariances)


def test_the_covariance_stays_positive_definite(drive):
    """Some hundred updates from a standing camera, where every one shrinks the same directions."""
    backend, seen = predicted(drive, 1, models=replace(MODELS, initial_velocity_sigma=15.0))
    rng = np.random.default_rng(0)
    local = RIG.project(drive.points[seen.ids])
    for k in range(300):
        noise = 0.5 * rng.standard_normal((2, len(seen), 2))
        report = backend.update(Observations(seen.ids, local[0] + noise[0], local[1] + noise[1]))
        assert report.status is UpdateStatus.OK
        backend.predict(1.0 + 0.1 * k)
    P = backend._covariance.full()
    d = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(d, d)).min() > 0


def test_removal_leaves_the_others_untouched(drive):
    backend, _ = halfway(drive, 20)
    before = backend.estimate()
    gone = before.ids[[0, 3, 7, -1]]
    backend.remove(gone)
    after = backend.estimate()
    kept = ~np.isin(before.ids, gone)
    np.testing.assert_array_equal(after.ids, before.ids[kept])
    np.testing.assert_array_equal(after.positions, before.positions[kept])
    np.testing.assert_array_equal(after.covariances, before.covariances[kept])
    np.testing.assert_array_equal(after.covariance, before.covariance)
