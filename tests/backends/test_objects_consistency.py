"""Whether the covariances of moving bodies are honest: NEES over Monte Carlo seeds, and the parts it rests on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import backends
from backends.ekf import EkfBackend
from backends.ekf.objects_body import RIGID, CameraBelief, _learnt, advanced, found, transported
from backends.ekf.objects_measurement import BodyMeasurement, BodyPoints, change_between, moved
from backends.smoother.objects_factors import System, VelocityPrior, add_measurements, add_motion, velocities
from backends.smoother.objects_window import CameraWindow, Prior, _prior_at, opened, with_frame, with_points
from slam.evaluation.metrics import chi_square_band, nees
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from slam.object_data import ObjectObservations
from slam.object_models import ObjectModels
from slam.objects.points import Shape, drift, first_frame, points_to_replace, shape_of, with_shape
from slam.window.stereo import RectifiedStereo
from tests.backends import scenes
from tests.backends.objects_scene import HANDHELD, KITTI, SIGMA, box_points, box_scene, car_scene, follow, score

BOTH = pytest.mark.parametrize("name", ["ekf", "smoother"])
SEEDS = 20
LATEST = (1, 4, 8)  #: frames judged; they are some frames apart, so nearly independent


def monte_carlo(name, make, **options):
    """Mean NEES of pose and velocity over seeds, at each frame after the first."""
    pose, velocity = [], []
    for seed in range(SEEDS):
        scene = make(seed=seed, frames=10, **options)
        found = score(scene, list(follow(backends.create(name, scene.rig, models=scene.models), scene, seed)))
        pose.append(found.pose_nees)
        velocity.append(found.velocity_nees)
    return np.mean(pose, axis=0), np.mean(velocity, axis=0)


@pytest.mark.slow
@BOTH
def test_nees_of_a_box_before_a_moving_camera(name):
    """Pose NEES inside its 95 % band. The box moves less than the model allows for, so velocity NEES only has its top.

    Each of three frames would leave its band once in twenty by chance; the mean of the three is judged by the band of
    one, which is wider than that of three independent ones.
    """
    low, high = chi_square_band(6, SEEDS)
    pose, velocity = monte_carlo(name, box_scene)
    assert low < pose[list(LATEST)].mean() < high
    assert 2 < velocity[list(LATEST)].mean() < high


@pytest.mark.slow
@BOTH
def test_nees_of_a_car(name):
    """A car at 15 m that moves just as the model says. Its depth is known to 4 % only: linearisation costs something.

    Tolerances: the 95 % band of a single frame over the seeds, and a fifth more at the top.
    """
    low, high = chi_square_band(6, SEEDS)
    pose, velocity = monte_carlo(name, car_scene)
    assert low < pose[list(LATEST)].mean() < 1.2 * high
    assert low < velocity[list(LATEST)].mean() < 1.2 * high


@BOTH
def test_the_cameras_error_is_not_taken_for_new_in_every_frame(name):
    """Camera not sure of its place, body and camera at rest: the body's motion since found is known all the same.

    The world may be shifted by 3 cm and turned by 0.3 degrees, but that is the same in all frames. The filter, which
    linearises each frame at another estimate, cannot quite keep the two apart; nor can its camera.
    """
    scene = box_scene(seed=1, frames=12, moving=False, still=True)
    unsure = replace(scene.models, initial_position_sigma=0.03, initial_rotation_sigma=0.005)
    results = []
    for models in (scene.models, unsure):
        s = replace(scene, models=models)
        results.append(list(follow(backends.create(name, s.rig, models=models), s))[-1][1])
    sure, last = (np.sqrt(np.diag(e.covariance)) for e in results)
    np.testing.assert_allclose(last[:3], sure[:3], rtol=0.3)
    assert last[3:].max() < 0.3 * 0.03 if name == "ekf" else last[3:].max() < 0.15 * 0.03


def test_the_cameras_error_since_the_first_sight_is_in_the_covariance():
    """Without landmarks a moving camera loses its way: so does the body that it sees, as far as the world goes."""
    scene = box_scene(seed=1, frames=12)
    lost = replace(scene, landmarks=np.zeros((0, 3)))

    def deviations(name, s):
        return np.sqrt(np.diag(list(follow(backends.create(name, s.rig, models=s.models), s))[-1][1].covariance))

    blind = {name: deviations(name, lost) for name in ("ekf", "smoother")}
    for name in blind:
        assert (blind[name] > 5 * deviations(name, scene)).all()
    # 5 to 16 degrees and 15 to 21 cm, from the motion model alone. Rotations this uncertain are no longer linear: the
    # filter transports its covariance to each corrected state and says up to three times as much as the smoother.
    ratio = blind["smoother"] / blind["ekf"]
    assert (ratio > 0.25).all() and (ratio < 2.5).all()


# --- parts of the filter ---


def test_points_of_a_body_and_their_derivatives():
    """Positions by the poses of the first cameras, and derivatives there, back, and by the frame."""
    rng = np.random.default_rng(8)
    T = se3.exp(rng.normal(0, 0.4, 6))
    h = np.array([[0.2, -0.1, 3.0], [-0.5, 0.3, 2.0], [0.1, 0.4, 5.0]])
    points = BodyPoints.at(T, h)
    Y = points.cartesian()
    np.testing.assert_allclose(Y, se3.transform(T, h), atol=1e-12)
    np.testing.assert_allclose(points.derivatives() @ points.by_position(), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    for k, step in enumerate(1e-6 * np.eye(3)):
        moved_points = points.plus(np.tile(step, (3, 1))).cartesian()
        np.testing.assert_allclose((moved_points - Y) / 1e-6, points.derivatives()[:, :, k], rtol=1e-4, atol=1e-4)
    by_frame = points.by_position() @ np.concatenate([se3.hat(Y), np.tile(-np.eye(3), (3, 1, 1))], axis=2)
    np.testing.assert_allclose(points.by_frame(), by_frame.reshape(9, 6), atol=1e-12)
    behind = BodyPoints(points.T_body_anchor, points.coordinates * [1, 1, -1])
    assert np.isnan(behind.cartesian()).all()


def test_derivatives_of_the_measurement():
    rng = np.random.default_rng(0)
    T = se3.exp(np.array([0.2, -0.1, 0.1, 0.1, 0.05, -1.5]))
    h = box_points(4, np.full(3, 0.3), np.array([0.05, 0, 1.5]), rng)
    model = BodyMeasurement(HANDHELD, T, BodyPoints.at(T, h))
    x = np.concatenate([[0.03, -0.02, 0.05, 0.1, -0.2, 0.15], 0.01 * rng.standard_normal(12)])
    line = model.linearise(x)
    for j in range(18):
        step = np.zeros(18)
        step[j] = 1e-6
        numeric = (model.predict(x + step) - model.predict(x - step)) / 2e-6
        if j < 6:
            expected = -line.by_relative[..., j] if j < 3 else line.by_relative[..., j]
        else:
            expected = np.zeros_like(numeric)
            expected[(j - 6) // 3] = line.by_landmark[(j - 6) // 3, :, (j - 6) % 3]
        np.testing.assert_allclose(expected, numeric, atol=1e-4)  # of derivatives up to 200 px/m


def test_changes_of_a_pose():
    T, target = (se3.exp(np.array(xi)) for xi in ([0.1, 0.2, -0.3, 1, 2, 3], [-0.4, 0.1, 0.2, 0, 2, 1]))
    np.testing.assert_allclose(moved(T, change_between(T, target)), target, atol=1e-12)
    small = 1e-5 * np.arange(1.0, 7.0)
    np.testing.assert_allclose(moved(T, small), T @ se3.exp(small), atol=1e-8)


def test_a_turn_of_the_body_stays_what_it_is_while_it_turns_on():
    """The covariance of a pose after a step is that of poses perturbed before it."""
    xi, models = 1e-4 * np.arange(1.0, 7.0), ObjectModels()
    body = replace(
        found(1, se3.pose(np.eye(3), [0.1, 0.2, 1.0]), *models.first_velocity(None), 0),
        velocity=np.array([3.0, 5, -4, 0.2, 0, 1]),
    )
    P = np.zeros((RIGID, RIGID))
    P[:6, :6] = np.outer(xi, xi)
    one = advanced(replace(body, covariance=P), 0.1, models)
    other = advanced(replace(body, T=body.T @ se3.exp(xi)), 0.1, models)
    after = se3.log(se3.inverse(one.T) @ other.T)
    np.testing.assert_allclose(
        (one.covariance - one.noise)[:6, :6], np.outer(after, after), rtol=2e-3
    )  # of 3e-4 in size


def test_the_filter_never_learns_where_in_a_body_its_frame_lies():
    """What only the frame is unsure of stays so after the points were changed, whatever their coordinates."""
    rng = np.random.default_rng(4)
    h = box_points(5, np.full(3, 0.3), np.array([0.05, 0, 1.2]), rng)
    body = found(1, se3.pose(np.eye(3), [0, 0, 1.2]), *ObjectModels().first_velocity(None), 8)
    points = BodyPoints.at(se3.inverse(body.T), h)
    frame = np.concatenate([np.eye(6), np.zeros((6, 6)), points.by_frame()])
    with_map = np.concatenate([np.zeros((6, 6)), np.ones((6, 2))], axis=1)  # and none with the camera
    none = np.zeros(5, np.int64)
    before = replace(
        body, ids=np.arange(5), points=points, covariance=1e-4 * frame @ frame.T, cross=frame @ with_map,
        failures=none, seen=none, sights=none,
    )  # fmt: skip
    change = np.concatenate([np.zeros(RIGID), 0.02 * rng.standard_normal(15)])
    nothing = np.zeros((len(change), 1))
    camera = CameraBelief(np.eye(4), np.eye(6), np.zeros((8, 6)))
    after = transported(_learnt(before, change, nothing, nothing, np.zeros((1, 8))), before.points, camera)
    frame = np.concatenate([np.eye(6), np.zeros((6, 6)), after.points.by_frame()])
    np.testing.assert_allclose(after.covariance, 1e-4 * frame @ frame.T, atol=1e-12)
    np.testing.assert_allclose(after.cross, frame @ with_map, atol=1e-9)


# --- parts of the smoother ---


def test_the_smoothers_prior_never_learns_where_in_a_body_its_frame_lies():
    """Measurements in the prior say nothing of the frame, also where the points are no longer where they were then."""
    rng, stereo = np.random.default_rng(5), RectifiedStereo.of(HANDHELD)
    T, points = se3.pose(np.eye(3), [0, 0, 1.2]), box_points(4, np.full(3, 0.3), np.zeros(3), rng)
    z, _ = stereo.project(se3.transform(T, points))
    window = with_frame(
        opened(0, 0.0, T, np.eye(4), VelocityPrior(*ObjectModels().first_velocity(None))), 1, 0.1, T, np.eye(4), 1.0
    )
    window = with_points(window, np.arange(4), points, Shape(T[:3, 3], np.eye(3)), z)
    X = np.tile(np.eye(4), (2, 1, 1))
    system = System.empty(24 + 12)
    add_measurements(system, stereo, SIGMA, np.array([z, z]), window.T, points, 24)
    window = replace(window, prior=Prior(system, window.T, X, points))
    shift = 0.01 * rng.standard_normal((4, 3))
    xi = np.array([0.3, -0.2, 0.4, 0.1, 0.2, -0.1])
    D = se3.exp(xi)
    cases = [(window.T, points + shift), (window.T @ D, se3.transform(se3.inverse(D), points))]
    for T, Y in cases:
        at = _prior_at(replace(window, T=T, points=Y), X)
        frame = np.concatenate([xi, np.zeros(6), xi, np.zeros(6), (np.cross(Y, xi[:3]) - xi[3:]).reshape(-1)])
        assert np.abs(at.information @ frame).max() < 1e-9 * np.abs(at.information).max()
    # another frame altogether, with the points where they were in the world, is as good
    np.testing.assert_allclose(at.vector, 0, atol=1e-6 * np.abs(at.information).max())


def _error(stereo, z, T, X, points, stamps, models):
    """Stacked whitened residuals of a window, by other means than the window's own."""
    out = []
    for k in range(len(T)):
        h = se3.transform(se3.inverse(X[k]) @ T[k], points)
        out.append(((z[k] - stereo.project(h)[0]) / SIGMA).reshape(-1))
    v = velocities(T, stamps)[0]
    q = np.sqrt(np.repeat(models.velocity_variance(stamps[2] - stamps[1])[::-1], 3))
    out.append(-(v[1] - v[0]) / q)
    return np.concatenate(out)


def test_normal_equations():
    """Information and vector of a window against numeric derivatives of its residuals."""
    rng, models = np.random.default_rng(1), ObjectModels()
    stereo, points = RectifiedStereo.of(HANDHELD), box_points(3, np.full(3, 0.3), np.zeros(3), rng)
    X = np.array([se3.exp(0.05 * rng.standard_normal(6)) for _ in range(3)])
    T = np.array([se3.pose(np.eye(3), [0, 0, 1.2]) @ se3.exp(0.1 * rng.standard_normal(6)) for _ in range(3)])
    z = np.array([stereo.project(se3.transform(se3.inverse(x) @ t, points))[0] for x, t in zip(X, T)])
    z += rng.standard_normal(z.shape)
    stamps = np.array([0.0, 0.03, 0.07])
    system = System.empty(36 + 9)
    add_measurements(system, stereo, SIGMA, z, se3.inverse(X) @ T, points, 36)
    add_motion(system, models, T, stamps, np.ones(3), None, range(2))

    def at(d):
        f = d[:36].reshape(3, 2, 6)
        return _error(
            stereo, z, T @ se3.exp(f[:, 0]), X @ se3.exp(f[:, 1]), points + d[36:].reshape(3, 3), stamps, models
        )

    eye = 1e-6 * np.eye(45)
    J = -np.array([(at(e) - at(-e)) / 2e-6 for e in eye]).T
    scale = np.sqrt(np.outer(np.diag(J.T @ J), np.diag(J.T @ J)))
    np.testing.assert_allclose(system.information / scale, J.T @ J / scale, atol=1e-6)
    np.testing.assert_allclose(
        system.vector, J.T @ at(np.zeros(45)), rtol=1e-4, atol=1e-3 * np.abs(system.vector).max()
    )


def test_elimination_keeps_the_marginal():
    rng = np.random.default_rng(2)
    A = rng.standard_normal((12, 8))
    system = System(A.T @ A, rng.standard_normal(8))
    rest = system.eliminated(np.array([0, 3]))
    kept = [1, 2, 4, 5, 6, 7]
    np.testing.assert_allclose(np.linalg.inv(rest.information), np.linalg.inv(system.information)[np.ix_(kept, kept)])
    whole = np.linalg.solve(system.information, system.vector)[kept]
    np.testing.assert_allclose(np.linalg.solve(rest.information, rest.vector), whole, rtol=1e-9)


# --- first sights ---


def test_first_frame_leaves_out_what_lies_far_off():
    h = np.array([[0.0, 0, 1], [0.2, 0, 1], [0, 0.2, 1.1], [0.1, 0.1, 0.9], [0, 0, 30], [np.nan] * 3])
    T, taken = first_frame(se3.pose(np.eye(3), [1.0, 0, 0]), h)
    np.testing.assert_array_equal(taken, [True] * 4 + [False] * 2)
    np.testing.assert_allclose(T, se3.pose(np.eye(3), np.array([1.0, 0, 0]) + h[:4].mean(axis=0)))


def test_shape_is_what_noise_leaves():
    """The spread of a car's points is found where stereo scatters them further than that."""
    rng = np.random.default_rng(3)
    points = box_points(2000, np.array([1.7, 1.4, 4.0]), np.array([0, 0, 25.0]), rng)
    z, _ = KITTI.project_stereo(points)
    z += SIGMA * rng.standard_normal(z.shape)
    h = KITTI.triangulate(z[:, :2], np.stack([z[:, 2], z[:, 1]], axis=1))
    shape = shape_of(h, KITTI.triangulation_covariance(h, SIGMA))
    np.testing.assert_allclose(np.sqrt(np.diag(shape.covariance)), points.std(axis=0), rtol=0.15)
    assert h[:, 2].std() > 1.5 * points[:, 2].std()
    better, covariance = with_shape(KITTI.project_stereo, z, h, SIGMA, shape)
    assert np.abs(better - points)[:, 2].mean() < 0.7 * np.abs(h - points)[:, 2].mean()
    assert 0.8 < np.mean((better - points)[:, 2] ** 2 / covariance[:, 2, 2]) < 1.2


def test_few_points_show_no_shape():
    covariances = np.tile(0.01 * np.eye(3), (2, 1, 1))
    shape = shape_of(np.array([[0.0, 0, 1], [0.1, 0, 1]]), covariances)
    np.testing.assert_allclose(shape.covariance, np.eye(3))
    assert isinstance(shape.seen_from(np.eye(4)), Shape)


# --- who makes room ---


def test_points_seen_from_farther_round_are_less_certain_across_the_line_of_sight():
    point, first = np.zeros((1, 3)), np.array([[0.0, 0.0, -2.0]])
    now = 3.0 * np.array([np.sin(0.4), 0.0, -np.cos(0.4)])
    turned, root = drift(point, first, now, np.zeros(1), 0.01)
    np.testing.assert_allclose(turned, 0.4)
    np.testing.assert_allclose(root @ root, [(0.01 * 3.0) ** 2 * 0.4 * (np.eye(3) - np.outer(now, now) / 9.0)])
    again, none = drift(point, first, 0.5 * (first[0] + now), turned, 0.01)
    assert again == turned and not none.any()  # it has been seen from farther round


def test_noise_added_to_unknowns_is_that_of_their_covariance():
    rng = np.random.default_rng(3)
    A, root = rng.standard_normal((9, 9)), 0.3 * np.eye(3)[None]
    system = System(A @ A.T + np.eye(9), rng.standard_normal(9))
    wider = system.diffused(np.arange(3, 6), root)
    expected = np.linalg.inv(system.information)
    expected[3:6, 3:6] += 0.09 * np.eye(3)
    np.testing.assert_allclose(np.linalg.inv(wider.information), expected, atol=1e-12)
    mean = np.linalg.solve(system.information, system.vector)
    np.testing.assert_allclose(np.linalg.solve(wider.information, wider.vector), mean, atol=1e-9)


def test_points_unseen_for_longer_than_they_were_seen_make_room():
    unseen, sights = np.array([0, 3, 1, 9, 0]), np.array([5, 2, 20, 8, 1])
    np.testing.assert_array_equal(points_to_replace(unseen, sights, 0, 5), False)
    np.testing.assert_array_equal(points_to_replace(unseen, sights, 1, 5), [0, 1, 0, 0, 0])
    np.testing.assert_array_equal(points_to_replace(unseen, sights, 4, 5), [0, 1, 0, 1, 0])  # seldom missed: stays


def test_a_body_that_has_turned_round_takes_up_new_points():
    unseen, sights = np.full(10, 2), np.full(10, 50)
    assert points_to_replace(unseen, sights, 8, 10).sum() == 5  # half of its points at least shall be in view
    assert points_to_replace(unseen, sights, 3, 10).sum() == 3
    assert not points_to_replace(np.zeros(10, np.int64), sights, 8, 10).any()


# --- bodies and the camera ---


def drive_with_body(seed: int, body: str, frames: int = 60) -> tuple[list[float], EkfBackend]:
    """NEES of the camera in each frame and the filter at the end of a walk; a body is seen in frames 10 to 39.

    `body` is "none", "right" (it sways before the camera) or "wrong" (its points jump about).
    """
    rng, noise = np.random.default_rng(500 + seed), np.random.default_rng(seed)
    motion = MotionModel(0.3, 0.15)
    poses = scenes.random_path(frames, 0.1, np.array([0, 0, 0.5]), motion, rng)
    points = scenes.cloud(poses, 4 * frames + 100, rng)
    models = EstimatorModels(motion, pixel_sigma=0.5, initial_angular_velocity_sigma=0.2)
    backend, known, found = EkfBackend(scenes.RIG, models), set(), []
    shape = noise.uniform(-0.5, 0.5, (12, 3))
    for k, T in enumerate(poses):
        scenes.step(backend, 0.1 * k, scenes.observe(T, points, 0.5, rng, 25), known)
        if body != "none" and 10 <= k < 40:
            h, sigma = shape + np.array([0.5 * np.sin(0.1 * k), 0, 5.0]), 20.0 if body == "wrong" else 0.5
            uv = np.stack(scenes.RIG.project(h)) + sigma * noise.standard_normal((2, 12, 2))
            uv[1, :, 0] = np.minimum(uv[1, :, 0], uv[0, :, 0] - 1)
            backend.update_objects([ObjectObservations(1, np.arange(12), uv[0], uv[1])])
        elif body != "none" and k == 40:
            backend.remove_objects([1])
        estimate = backend.estimate(landmarks=False)
        xi = se3.log(se3.inverse(estimate.T_world_left) @ T)
        found.append(float(nees(xi, estimate.covariance)))
    return found, backend


@pytest.mark.parametrize("body", ["right", "wrong"])
def test_a_body_changes_neither_camera_nor_map(body):
    """Not while it is there, and not afterwards; so it cannot do the map harm, and the filter stays consistent."""
    expected, found = (drive_with_body(0, which)[1].estimate() for which in ("none", body))
    np.testing.assert_array_equal(found.T_world_left, expected.T_world_left)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.covariances, expected.covariances)


@pytest.mark.slow
def test_the_camera_is_consistent_with_bodies_and_after_them():
    """NEES over eight walks, mean of three frames with the body and of three after it."""
    found = np.mean([drive_with_body(seed, "right")[0] for seed in range(8)], axis=0)
    low, high = chi_square_band(6, 8)
    assert low < found[[20, 29, 38]].mean() < high
    assert low < found[[41, 50, 59]].mean() < high


def test_what_older_camera_poses_say_given_the_later_ones():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(24, 24))
    P = A @ A.T
    difference = np.linalg.inv(P)
    difference[12:, 12:] -= np.linalg.inv(P[12:, 12:])
    given = CameraWindow(np.tile(np.eye(4), (4, 1, 1)), P).given_later(2)
    np.testing.assert_allclose(given, difference, atol=1e-9 * np.abs(difference).max())


def test_it_never_says_less_than_nothing_though_poses_are_nearly_one():
    """Poses of a camera that all have one large error, and small ones of their own."""
    rng = np.random.default_rng(4)
    A = rng.normal(size=(18, 18))
    P = 1e-6 * A @ A.T + 1e6 * np.tile(np.eye(6), (3, 3))
    given = CameraWindow(np.tile(np.eye(4), (3, 1, 1)), P).given_later(1)
    assert np.linalg.eigvalsh((given + given.T) / 2).min() > -1e-9 * np.abs(given).max()
