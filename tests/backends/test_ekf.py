from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from backends.ekf import EkfBackend
from backends.ekf.camera import gauge_by_error
from backends.ekf.camera import predicted as motion
from backends.iekf import IekfBackend
from backends.iekf.filter import InvariantCamera
from backends.window import WindowBackend
from experiments.corridor import run as corridor
from slam.data import Observations
from slam.errors import ConfigurationError
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel, SlideModel, models_for
from slam.third_party import OnlinePose, derived_recent
from tests.backends.ekf_runs import DRIVE, FORWARD, MODELS, YAW, dense, halfway
from tests.backends.scenes import RIG, cloud, nees, observe, path, random_path, run, scene, step
from tests.slam.numeric import jacobian

# --- options ---


def test_wrong_options_are_refused():
    with pytest.raises(ConfigurationError, match=r"unknown option 'iteration' \(did you mean 'iterations'\?\)"):
        EkfBackend(RIG, iteration=3)
    with pytest.raises(ConfigurationError, match="landmarks must be one of"):
        EkfBackend(RIG, landmarks="polar")
    with pytest.raises(ConfigurationError, match="papers=true chooses"):
        EkfBackend(RIG, papers=True, iterations=2)


# --- consistency ---


@pytest.mark.parametrize("make", [EkfBackend, IekfBackend, WindowBackend], ids=["ekf", "iekf", "window"])
def test_nees_and_nis_are_in_their_bands(make):
    """Twelve runs whose motion and noise are as assumed, 30 frames each: the linearisation is fair for so long."""
    runs, frames, motion = 12, 30, MotionModel(0.3, 0.15)
    models = EstimatorModels(motion, pixel_sigma=0.5, initial_angular_velocity_sigma=0.2)
    pose_nees, nis, dof, landmark_nees = [], 0.0, 0, []
    for seed in range(runs):
        poses = random_path(frames, 0.1, 0.5 * FORWARD, motion, np.random.default_rng(100 + seed))
        data = scene(poses, points=200, seed=seed, limit=25)
        backend = make(RIG, models)
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


def test_the_papers_filter_has_one_name():
    printed = {"measurement": "left", "iterations": 1, "landmarks": "euclidean", "consistent": False}
    one, other = (halfway(DRIVE, 8, **options)[0].estimate() for options in ({"papers": True}, printed))
    np.testing.assert_array_equal(one.T_world_left, other.T_world_left)
    np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (EkfBackend, {}),
        (EkfBackend, {"fast": True}),  # 0.3 rad a frame
        (EkfBackend, {"iterations": 1}),
        (EkfBackend, {"landmarks": "euclidean"}),
        (EkfBackend, {"landmarks": "euclidean", "iterations": 1}),
        (EkfBackend, {"measurement": "left"}),  # the option had no effect then
        (IekfBackend, {"iterations": 1}),
        (IekfBackend, {"iterations": 5}),
    ],
    ids=str,
)
def test_what_nothing_measures_stays_unknown(make, options):
    """A displacement of camera and landmarks together stays as uncertain as the first pose was.

    The information (the inverse of the covariance) on it is that of the prior, 1 in units of its sigmas, and so it is
    after any number of updates, also of those that are relinearised; the plain filter believes to have measured it.
    """
    sigma, learnt, ekf = 0.01, [], make is EkfBackend
    models = replace(MODELS, initial_position_sigma=sigma, initial_rotation_sigma=sigma)
    options, fast = {k: v for k, v in options.items() if k != "fast"}, "fast" in options
    data = scene(path(30, 0.1, FORWARD, 3 * YAW), points=1000) if fast else DRIVE
    for consistent in ({"consistent": True}, {"consistent": False}) if ekf else ({},):
        backend = make(RIG, models, **options, **consistent)
        run(backend, list(data)[:25])
        camera, marks = backend.state.camera, backend.state.landmarks
        shift = np.zeros((12 + 3 * backend.state.covariance.active, 6))
        shift[:6], shift[6:9, 3:] = np.linalg.inv(gauge_by_error(camera)), -se3.hat(camera.v)
        shift[12:] = marks.gauge[: backend.state.covariance.active].reshape(-1, 6)
        information = sigma**2 * shift.T @ np.linalg.solve(dense(backend.state.covariance), shift)
        learnt.append(np.diag(information))
    assert (learnt[0] < (1.01 if ekf else 1.001)).all()  # less than 1 where the model's impulses have loosened it
    assert not ekf or learnt[1].max() > 2.0


def test_the_last_poses_are_known_together():
    """Their joint covariance fits the errors of 25 runs, above all the errors of how the camera has moved."""
    runs, motion, whole, between = 25, MotionModel(0.3, 0.15), [], []
    models = EstimatorModels(motion, pixel_sigma=0.5, initial_angular_velocity_sigma=0.2)
    for seed in range(runs):
        poses = random_path(12, 0.1, 0.5 * FORWARD, motion, np.random.default_rng(300 + seed))
        backend = EkfBackend(RIG, models)
        run(backend, scene(poses, points=150, seed=seed, limit=25))
        found = backend.recent(5)
        np.testing.assert_allclose(found.stamps, 0.1 * np.arange(7, 12))
        np.testing.assert_array_equal(found.poses, backend.trajectory().poses[-5:])
        np.testing.assert_allclose(found.covariance[-6:, -6:], backend.estimate(False).covariance, atol=1e-15)
        x = se3.log(se3.inverse(found.poses) @ poses[-5:])
        whole.append(x.reshape(-1) @ np.linalg.solve(found.covariance, x.reshape(-1)))
        J = np.concatenate([-se3.adjoint(se3.inverse(found.poses[-1]) @ found.poses[0]), np.eye(6)], axis=1)
        ends = np.r_[0:6, 24:30]
        off = J @ x[[0, -1]].reshape(-1)
        between.append(off @ np.linalg.solve(J @ found.covariance[np.ix_(ends, ends)] @ J.T, off))
    for distances, dof in ((whole, 30), (between, 6)):
        low, high = chi2.ppf([0.001, 0.999], dof * runs) / runs
        assert low < np.mean(distances) < high
    assert len(backend.recent(1)) == 1 and len(backend.recent(100)) == 5


def test_what_is_derived_of_the_last_poses_is_what_the_filter_knows():
    """Of poses whose own covariance alone is told: the deviation of a motion over four frames."""
    models, known, online, shares = models_for("handheld"), set(), [], []
    data = scene(path(25, 0.1, 0.4 * FORWARD, 0.1 * YAW), points=900, sigma=models.pixel_sigma, limit=40)
    backend = EkfBackend(RIG, models)
    for stamp, _, seen in data:
        used = np.isin(seen.ids, step(backend, stamp, seen, known).used)
        pixels = seen.uv_left[used], seen.uv_right[used]
        pose = OnlinePose.seen(RIG, models.pixel_sigma, backend.estimate(False), *pixels)
        online = [*online[-4:], pose]
        told, derived = backend.recent(5), derived_recent(online)
        J = np.concatenate([-se3.adjoint(se3.inverse(told.poses[-1]) @ told.poses[0]), np.eye(6)], axis=1)
        ends = np.r_[0:6, -6:0]
        P, Q = (J @ one.covariance[np.ix_(ends, ends)] @ J.T for one in (derived, told))
        shares.append(np.sqrt(np.diag(P) / np.diag(Q)) if len(online) == 5 else np.ones(6))
        np.testing.assert_allclose(derived.covariance[-6:, -6:], told.covariance[-6:, -6:], rtol=1e-6, atol=1e-11)
        assert np.linalg.eigvalsh(derived.covariance).min() > -1e-11
    np.testing.assert_allclose(np.median(shares[5:], axis=0), 1.0, atol=0.05)
    N = replace(pose, estimate=replace(pose.estimate, covariance=1e2 * np.eye(6))).noise
    surer = replace(pose, estimate=replace(pose.estimate, covariance=0.1 * N))  # it has a tenth of the frame's error
    np.testing.assert_allclose(surer.noise, 0.01 * N, rtol=1e-3, atol=1e-5 * np.abs(N).max())


@pytest.mark.parametrize("make", [EkfBackend, IekfBackend], ids=["ekf", "iekf"])
def test_pixels_that_are_mended_do_not_measure_the_world(make):
    """Landmarks move at a revision; the attitude stays as unknown as it began."""
    sigma = 0.05
    models = EstimatorModels(MODELS.motion, 0.3, initial_rotation_sigma=sigma, initial_position_sigma=1e-3)
    poses, known = path(25, 0.1, np.array([0, 0, 1.0]), np.zeros(3)), set()
    backend, rng = make(RIG, models), np.random.default_rng(0)
    points = cloud(poses, 120, rng)
    for k, T in enumerate(poses):
        if k % 5 == 4:
            backend.revise(lambda z, by=0.3 * (-1) ** k: z + np.array([0, 0, by]))
        step(backend, 0.1 * k, observe(T, points, 0.3, rng), known)
    assert (np.sqrt(np.diag(backend.estimate(False).covariance))[:3] > 0.99 * sigma).all()


@pytest.mark.parametrize("make", [EkfBackend, IekfBackend], ids=["ekf", "iekf"])
def test_landmarks_that_come_back_after_a_revision_do_not_move_the_camera(make):
    """The pixels are mended while it looks elsewhere: NEES was 150 when the first landmarks were seen again."""
    turns, found = np.concatenate([np.linspace(0, 1.4, 15), np.linspace(1.4, 0, 15)]), []
    poses = np.array([se3.pose(se3.so3_exp(np.array([0, a, 0])), np.zeros(3)) for a in turns])
    for seed in range(4):
        rng, known = np.random.default_rng(seed), set()
        points = rng.permutation(np.concatenate([cloud(poses[[k]], 40, rng, 5, 12) for k in (0, 7, 14)]))
        backend = make(RIG, EstimatorModels(MotionModel(0.3, 0.5), pixel_sigma=0.3))
        for k, T in enumerate(poses):
            seen = observe(T, points, 0.3, rng, 60)
            if k == 15:
                backend.revise(lambda z: z + np.array([0, 0, 1.0]))
            seen = Observations(seen.ids, seen.uv_left, seen.uv_right - np.array([1.0 if k < 15 else 0.0, 0]))
            step(backend, 0.1 * k, seen, known)
            found += [nees(backend, T)] if k > 20 else []
    assert np.mean(found) < 20


def test_features_slide_to_where_the_camera_is_seen_to_be():
    """At the first step of a drive it is predicted where it was; without a slide NEES was 22 there."""
    poses, found, models = path(2, 0.1, 10 * FORWARD, np.zeros(3)), [], models_for("driving")
    for seed in range(20):
        rng, backend = np.random.default_rng(seed), EkfBackend(RIG, models)
        points = cloud(poses[1:], 60, rng, 4.0, 30.0)
        known: set[int] = set()
        step(backend, 0.0, observe(poses[0], points, 0.28, rng, 60), known)
        seen = observe(poses[1], points, 0.28, rng, 60)
        rays = [(points - T[:3, 3]) / np.linalg.norm(points - T[:3, 3], axis=1)[:, None] for T in poses]
        angle = np.arccos((rays[0] * rays[1]).sum(axis=1).clip(-1, 1))[seen.ids]
        by = models.slide.density * np.sqrt(angle)[:, None] * rng.standard_normal((len(seen), 2))
        seen = Observations(seen.ids, seen.uv_left + by, seen.uv_right + by).select(np.isin(seen.ids, list(known)))
        backend.predict(0.1)
        backend.update(seen, poses[1])
        found.append(nees(backend, poses[1]))
    assert np.mean(found) < chi2.ppf(0.9999, 120) / 20


@pytest.mark.parametrize("make", [EkfBackend, IekfBackend], ids=["ekf", "iekf"])
def test_a_long_step_does_not_depend_on_where_the_world_is(make):
    """Points far away move by much in depth; an unknown place of all in the world must not explain that."""
    start = se3.pose(np.eye(3), [30.0, 5.0, 100.0])
    known = replace(models_for("driving"), slide=SlideModel())  # these features do not slide
    for seed in range(4):
        rng, ends = np.random.default_rng(seed), []
        T = se3.exp(np.concatenate([0.03 * rng.standard_normal(3), [0, 0, 1.5]]))
        points = cloud(T[None], 80, rng, 10.0, 60.0)
        first, second = (observe(pose, points, known.pixel_sigma, rng, 80) for pose in (np.eye(4), T))
        for rotation, position in ((1e-5, 1e-4), (0.1, 1.0)):
            prior = {"initial_rotation_sigma": rotation, "initial_position_sigma": position}
            backend, seen = make(RIG, replace(known, T_world_left=start, **prior)), set()
            step(backend, 0.0, first, seen)
            step(backend, 0.1, second.select(np.isin(second.ids, list(seen))), seen)
            ends.append(backend.estimate(False).T_world_left)
        np.testing.assert_allclose(ends[1], ends[0], atol=0.01)  # 1 m where the mean followed it


def test_the_motion_and_its_derivatives():
    dt, P, rng = 0.2, 1e-4 * np.eye(12), np.random.default_rng(1)
    start = InvariantCamera(se3.exp(rng.standard_normal(6)), rng.standard_normal(3), rng.standard_normal(3))
    camera, J, noise = motion(start, MODELS, P, dt, False)
    T = start.pose
    np.testing.assert_allclose(camera.pose[:3, :3], T[:3, :3] @ se3.so3_exp(dt * start.rate), atol=1e-12)
    np.testing.assert_allclose(camera.pose[:3, 3], T[:3, 3] + dt * start.v, atol=1e-12)

    def moved(xi):
        return start.plus(xi).advanced(dt)[0].minus(camera)

    np.testing.assert_allclose(J, jacobian(moved, np.zeros(12)), atol=1e-8)

    def disturbed(w):  # an impulse at the beginning of the step
        return replace(start, v=start.v + w[:3], rate=start.rate + w[3:]).advanced(dt)[0].minus(camera)

    W = jacobian(disturbed, np.zeros(6))
    Q = np.diag(np.repeat(MODELS.motion.velocity_variance(dt), 3))
    np.testing.assert_allclose(noise, W @ Q @ W.T, rtol=1e-4, atol=1e-8)


def test_a_camera_far_from_zero_loses_no_digits():
    """At map coordinates of a country."""
    there = se3.pose(np.eye(3), [4e5, -2e5, 5e6])
    backends = [IekfBackend(RIG, replace(MODELS, T_world_left=T)) for T in (np.eye(4), there)]
    for backend in backends:
        run(backend, DRIVE)
    one, other = (backend.estimate(landmarks=False) for backend in backends)
    assert np.abs(se3.inverse(there) @ other.T_world_left - one.T_world_left).max() < 1e-6
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-12)


def test_nothing_of_second_order_adds_up():
    """Corrections of centimetres, frame after frame, leave landmarks where they are: the path is the other filter's."""
    one, other = (corridor(name, {}, 80, seed=0) for name in ("ekf", "iekf"))
    assert np.abs((one.errors - other.errors)[-1] / one.deviations[-1]).max() < 0.01
