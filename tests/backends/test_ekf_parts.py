"""The filter's arithmetic, each part against the plain dense formula or finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from backends.ekf.backend import EkfConfig
from backends.ekf.camera import from_body_axes, gauge_by_error, pose_by_error, predicted, prior
from backends.ekf.covariance import CAMERA, HEAD, Covariance
from backends.ekf.innovation import Update
from backends.ekf.landmarks import Euclidean, FilterLandmarks, InverseDepth, Slide
from backends.ekf.motion import EulerCamera
from backends.ekf.solve import gated_correction
from backends.ekf.state import FilterState
from backends.iekf.filter import InvariantCamera
from slam.geometry import se3
from slam.geometry.se3 import body_rate_matrix, rotation
from slam.models import EstimatorModels, MotionModel
from slam.window.stereo import RectifiedMeasurement
from tests.backends.ekf_runs import dense
from tests.backends.scenes import RIG
from tests.slam.numeric import jacobian, positive

ATTITUDES = [np.array(phi) for phi in ([0.0, 0, 0], [0.3, -0.7, 2.0], [1.5, 1.2, -3.0], [-2.0, -1.4, 0.5])]


# --- the angles' world ---


def camera_at(phi) -> EulerCamera:
    rng = np.random.default_rng(0)
    x = rng.standard_normal(12)
    x[3:6] = phi
    return EulerCamera(x, se3.so3_exp(rng.standard_normal(3)), False)


RNG = np.random.default_rng(1)
INVARIANT = InvariantCamera(se3.exp(RNG.standard_normal(6)), RNG.standard_normal(3), RNG.standard_normal(3))


@pytest.mark.parametrize("camera", [*map(camera_at, ATTITUDES), INVARIANT])
def test_the_pose_by_the_error(camera):
    def perturbation(xi):
        return se3.log(se3.inverse(camera.pose) @ camera.plus(np.pad(xi, (0, 6))).pose)

    np.testing.assert_allclose(pose_by_error(camera), jacobian(perturbation, np.zeros(6)), atol=1e-8)
    error = 0.3 * RNG.standard_normal(12)
    np.testing.assert_allclose(camera.plus(error).minus(camera), error, atol=1e-12)


@pytest.mark.parametrize("phi", ATTITUDES)
def test_a_new_angles_world_is_the_same_state(phi):
    camera = camera_at(phi)
    new, J = camera.with_new_angles(camera.pose)
    np.testing.assert_allclose(new.pose, camera.pose, atol=1e-12)
    body = body_rate_matrix(phi) @ camera.x[9:12]
    np.testing.assert_allclose(body_rate_matrix(new.x[3:6]) @ new.x[9:12], body, atol=1e-12)
    np.testing.assert_array_equal(new.x[[0, 1, 2, 6, 7, 8]], camera.x[[0, 1, 2, 6, 7, 8]])

    def moved(error):  # the same change of variables with the new world held fixed
        after = camera.plus(error)
        x = new.at(after.pose).x
        x[:3], x[6:9] = after.x[:3], after.x[6:9]
        x[9:12] = np.linalg.solve(body_rate_matrix(x[3:6]), body_rate_matrix(after.x[3:6]) @ after.x[9:12])
        return x

    np.testing.assert_allclose(J, jacobian(moved, np.zeros(12)), atol=1e-7)


def test_a_step_in_pieces_has_the_noise_of_a_whole_one():
    """A fast turn runs through the singularity; its position, and turns about the body, had less than a slow one's."""
    first = EulerCamera.first(MODELS, True)
    shifts, turns = [], []
    for rate in (np.zeros(3), np.array([0.0, 4.0, 0.0])):
        camera = replace(first, x=np.concatenate([first.x[:9], rate]))
        after, _, noise = predicted(camera, MODELS, 1e-4 * np.eye(12), 0.5, False)
        E = body_rate_matrix(after.x[3:6])
        shifts.append(noise[:3, :3])
        turns.append(np.trace(E @ noise[3:6, 3:6] @ E.T))
    np.testing.assert_allclose(turns[1], turns[0], rtol=0.1)
    np.testing.assert_allclose(shifts[1], shifts[0], rtol=1e-12)


# --- measurements ---


def covariance_of(P: np.ndarray) -> Covariance:
    """Of a camera and landmarks with a joint covariance, and of no poses before."""
    P = np.insert(np.insert(P, [CAMERA] * (HEAD - CAMERA), 0.0, axis=0), [CAMERA] * (HEAD - CAMERA), 0.0, axis=1)
    return Covariance(P, np.zeros((len(P), 0)))


# --- the landmarks' coordinates ---


@pytest.mark.parametrize("coordinates", [InverseDepth(), Euclidean()], ids=["inverse depth", "euclidean"])
def test_coordinates_there_and_back(coordinates):
    rng = np.random.default_rng(0)
    anchors = np.concatenate([se3.so3_exp(rng.standard_normal((5, 3))), rng.standard_normal((5, 3, 1))], axis=2)
    local = rng.uniform((-2, -2, 1), (2, 2, 60), (5, 3))
    points = (anchors[:, :, :3] @ local[:, :, None])[:, :, 0] + anchors[:, :, 3]
    c = coordinates.of(anchors, points)
    np.testing.assert_allclose(coordinates.points(anchors, c), points, atol=1e-10)
    for i, D in enumerate(coordinates.jacobian(anchors, c)):
        numeric = jacobian(lambda x, i=i: coordinates.points(anchors[[i]], x[None])[0], c[i], 1e-6 * abs(c[i, 2]))
        np.testing.assert_allclose(D, numeric, rtol=1e-4, atol=1e-4)


# --- the filter's steps against the printed formulas ---

MODELS = EstimatorModels(MotionModel(0.3, 0.3), pixel_sigma=0.5)


def state_of(landmarks: int, coordinates) -> tuple[FilterState, np.ndarray, np.random.Generator]:
    """A camera that moves among landmarks, and their true places in its coordinates."""
    rng = np.random.default_rng(5)
    h = rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (landmarks, 3))
    camera = EulerCamera.first(MODELS, False)
    P = from_body_axes(camera, prior(MODELS))
    camera = replace(camera, x=np.concatenate([rng.standard_normal(3), ATTITUDES[1], np.zeros(6)]))
    s = replace(FilterState.first(camera, P), stamp=0.0, frame=0)
    s = replace(s, covariance=s.covariance.camera_moved(np.eye(CAMERA), 1e-4 * positive(CAMERA, rng)))
    return s.augmented(coordinates, np.arange(landmarks), h, RIG.triangulation_covariance(h, 0.5)), h, rng


def update_of(s: FilterState, z: np.ndarray, coordinates, iterations: int, probability: float = 0.9999) -> Update:
    """Of all landmarks of a state, by measurements (N, 3)."""
    measure = RectifiedMeasurement(RIG, replace(MODELS, gate_probability=probability))
    rows, limits = np.arange(len(z)), measure.limits(z)
    return Update(s.camera, s.covariance, s.landmarks, rows, z, measure, coordinates, iterations, limits)


def in_deviations(P: np.ndarray, of: np.ndarray) -> np.ndarray:
    """A covariance in units of another's standard deviations: entries of m², m rad/s and 1/m² become comparable."""
    deviation = np.sqrt(np.diag(of))
    return P / np.outer(deviation, deviation)


def test_the_prediction_is_as_printed():
    s, _, _ = state_of(4, InverseDepth())
    camera, P, dt = s.camera.x + 0.1 * np.arange(12.0) / 12, dense(s.covariance), 0.25
    s = replace(s, camera=replace(s.camera, x=camera))
    found = s.advanced(dt, MODELS, False)
    A, W = np.eye(len(P)), np.zeros((len(P), 6))
    A[:6, 6:12] = dt * np.eye(6)
    W[:6], W[6:12] = dt * np.eye(6), np.eye(6)
    linear, angular = MODELS.motion.velocity_variance(dt)
    np.testing.assert_allclose(found.camera.x, A[:12, :12] @ camera, rtol=0, atol=1e-12)
    expected = A @ P @ A.T + W @ np.diag([linear] * 3 + [angular] * 3) @ W.T
    found, expected = (in_deviations(P, expected) for P in (dense(found.covariance), expected))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)  # but for the order of sums


@pytest.mark.parametrize("coordinates", [InverseDepth(), Euclidean()], ids=["inverse depth", "euclidean"])
def test_the_update_is_the_joseph_form(coordinates):
    s, h, rng = state_of(12, coordinates)
    P, marks = dense(s.covariance), s.landmarks
    z = RIG.project_stereo(h + 0.01 * rng.standard_normal(h.shape))[0] + 0.3 * rng.standard_normal((12, 3))
    update = update_of(s, z, coordinates, 1)
    solution = gated_correction(update.linearised(s.camera))
    assert solution.used.all()
    x = np.concatenate([s.camera.x, marks.c.reshape(-1)])

    def predict(change):
        return update.linearised(s.camera.plus(change[:12]), change[12:]).h.reshape(-1)

    H, nu = jacobian(predict, 0 * x, 1e-5), z.reshape(-1) - predict(0 * x)
    S = H @ P @ H.T + 0.25 * np.eye(36)
    K = np.linalg.solve(S, H @ P).T
    J = np.eye(len(P)) - K @ H
    joseph = J @ P @ J.T + 0.25 * K @ K.T
    after = s.corrected(solution)
    difference = in_deviations(dense(after.covariance) - joseph, joseph)
    assert np.abs(difference).max() < 1e-5  # what the differences leave in H
    found = np.concatenate([after.camera.x, after.landmarks.c.reshape(-1)])
    np.testing.assert_allclose(found, x + K @ nu, rtol=1e-6, atol=1e-6)
    assert solution.nis == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-6)


@pytest.mark.parametrize("coordinates", [InverseDepth(), Euclidean()], ids=["inverse depth", "euclidean"])
def test_augmentation_is_the_derivative_of_triangulation(coordinates):
    s, _, _ = state_of(3, coordinates)
    h = np.array([[0.4, -0.3, 6.0]])
    noise, P, camera = RIG.triangulation_covariance(h, 0.5), dense(s.covariance), s.camera.x
    after = s.augmented(coordinates, np.array([9]), h, noise)

    def of(x):
        turned = s.camera.R_world_angles @ rotation(x[3:6])
        return coordinates.of(after.landmarks.anchors[-1:], x[:3] + (h + x[6:]) @ turned.T)[0]

    J = jacobian(of, np.concatenate([camera[:6], np.zeros(3)]))
    cross = J[:, :6] @ P[:6]
    own = J[:, :6] @ P[:6, :6] @ J[:, :6].T + J[:, 6:] @ noise[0] @ J[:, 6:].T
    expected = np.block([[P, cross.T], [cross, own]])
    # central differences by 1e-6 leave 1e-10 in J
    found = in_deviations(dense(after.covariance), expected)
    np.testing.assert_allclose(found, in_deviations(expected, expected), atol=1e-7)
    np.testing.assert_allclose(after.landmarks.points[-1], (s.pose @ np.append(h[0], 1))[:3], atol=1e-12)


# --- the update: iterated, gated ---


def far_off(iterations: int, spread: float = 0.05) -> tuple[FilterState, Update]:
    """An update whose prior is 1.5 m and 0.15 rad off; points at 4 to 8 m are known to `spread` [m] in depth."""
    rng = np.random.default_rng(13)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (12, 3))
    s = FilterState.first(EulerCamera.first(MODELS, False), np.eye(12))
    truth = s.camera.plus(np.concatenate([[0.3, -0.2, 1.5, 0.05, 0.15, -0.1], np.zeros(6)])).pose
    z = RIG.project_stereo(se3.transform(se3.inverse(truth), points))[0] + 0.5 * rng.standard_normal((12, 3))
    off = np.tile([spread / 3, spread / 3, spread], (12, 1))
    known = points + off * rng.standard_normal((12, 3))
    marks = FilterLandmarks.at(Euclidean(), np.arange(12), np.zeros((12, 3, 4)), known, 0)
    P = np.diag(np.concatenate([np.full(3, 1.5**2), np.full(3, 0.2**2), np.ones(6), off.ravel() ** 2]))
    s = replace(s, landmarks=marks, covariance=covariance_of(P))
    return s, update_of(s, z, Euclidean(), iterations, 1 - 1e-9)


def ungated(update: Update):
    """What all measurements give, whether they agree or not."""
    return gated_correction(replace(update, limits=np.full(len(update.z), 1e9)).linearised(update.camera))


def corrected(s: FilterState, update: Update) -> np.ndarray:
    """The change of the state (48,) that an update makes."""
    after = s.corrected(ungated(update))
    return np.concatenate([after.camera.x - s.camera.x, (after.landmarks.c - s.landmarks.c).reshape(-1)])


def residuals(s: FilterState, update: Update, change: np.ndarray) -> np.ndarray:
    """Whitened: of the prior, whose covariance is diagonal, and of the measurements."""
    z = update.linearised(s.camera.plus(change[:12]), change[12:]).h
    prior = change / np.sqrt(np.diag(dense(s.covariance)))
    return np.concatenate([prior, ((update.z - z) / update.sigma).reshape(-1)])


@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_the_iterated_update_is_the_maximum_of_the_posterior(spread, monkeypatch):
    """Also where landmarks move by much: an error of the pose displaces them from where they are by now."""
    monkeypatch.setattr("backends.ekf.solve._LINEAR", 1e-6)
    s, update = far_off(50, spread)
    deviation = np.sqrt(np.diag(dense(s.covariance)))
    solution = ungated(update)
    assert solution.used.all() and solution.linear and not ungated(replace(update, iterations=2)).linear
    cost = lambda x: residuals(s, update, deviation * x)  # noqa: E731
    best = least_squares(cost, np.zeros(48), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(corrected(s, update), deviation * best.x, atol=1e-5)
    assert solution.nis == pytest.approx(2 * best.cost, rel=1e-3)  # νᵀS⁻¹ν there is the least cost


def far_in_depth(seed: int) -> tuple[FilterState, Update, np.ndarray]:
    """By default, pose to .3 m and .1 rad, points in inverse depth, known to 1 mrad and 20 %; and the true pose."""
    rng, n = np.random.default_rng(seed), 15
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (n, 3))
    s = FilterState.first(EulerCamera.first(MODELS, True), np.eye(12))
    sigma = np.repeat([0.3, 0.1], 3)
    truth = s.camera.plus(np.pad(sigma * rng.standard_normal(6), (0, 6))).pose
    z = RIG.project_stereo(se3.transform(se3.inverse(truth), points))[0] + 0.5 * rng.standard_normal((n, 3))
    anchors = np.tile(np.eye(3, 4), (n, 1, 1))
    c = InverseDepth().of(anchors, points)
    off = np.stack([np.full(n, 1e-3), np.full(n, 1e-3), 0.2 * c[:, 2]], axis=1)
    known = InverseDepth().points(anchors, c + off * rng.standard_normal((n, 3)).clip(-2.5, 2.5))
    P = np.diag(np.concatenate([sigma**2, np.full(6, 0.01), off.ravel() ** 2]))
    marks = FilterLandmarks.at(InverseDepth(), np.arange(n), anchors, known, 0)
    s = replace(s, landmarks=marks, covariance=covariance_of(P))
    return s, update_of(s, z, InverseDepth(), EkfConfig().iterations, 1 - 1e-9), truth


def test_depths_that_move_do_not_bend_the_pose():
    """An error of the pose moves landmarks from where they are by now, also where the covariance is transported.

    Every update comes to its end: after five linearisations one of a hundred was still .17 m off.
    """
    off = []
    for seed in range(100):
        s, update, truth = far_in_depth(seed)
        after = s.corrected(ungated(update))
        off.append(np.linalg.norm(after.pose[:3, 3] - truth[:3, 3]))
    assert (
        max(off) < 0.1 and np.sqrt(np.mean(np.square(off))) < 0.035
    )  # .028, as least squares; .047 with the lever of the prior


def test_a_coordinate_at_its_limit_has_changed_by_so_much():
    """The innovation counts the change that was made, not the one that was asked for."""
    s, update, _ = far_in_depth(0)
    asked = np.zeros(45)
    asked[2] = -2 * s.landmarks.c[0, 2]
    camera = replace(s.camera, transports=False)
    at = replace(update, camera=camera).linearised(camera, asked)
    made = (InverseDepth().plus(s.landmarks.c, asked.reshape(-1, 3)) - s.landmarks.c).reshape(-1)
    assert made[2] > asked[2]
    np.testing.assert_array_equal(at.change[HEAD:], made)
    expected = (update.z - at.h + (at.H_landmark @ made.reshape(-1, 3, 1))[:, :, 0]).reshape(-1)
    np.testing.assert_allclose(at.nu, expected, atol=1e-9)


def test_a_distance_is_by_how_much_the_nis_falls_without_a_landmark():
    _, update = far_off(1)
    at, whole = update.linearised(update.camera), np.ones(12, bool)
    every = at.solved(whole)
    for gone in (0, 5, 11):
        without = at.solved(np.arange(12) != gone)
        assert every.nis - without.nis == pytest.approx(every.conditional_distances[gone], rel=1e-6)
        assert without.conditional_distances[gone] == pytest.approx(every.conditional_distances[gone], rel=1e-6)


def test_an_update_by_some_landmarks_depends_on_no_others():
    """Against the formulas of S, ν and H of the used ones alone."""
    _, update = far_off(1)
    at, used, C = update.linearised(update.camera), np.arange(12) % 3 != 1, update.covariance.P
    rows, solution = np.flatnonzero(np.repeat(used, 3)), at.solved(used)
    S, HP, nu = at.S[np.ix_(rows, rows)], at.HP[rows], at.nu[rows]
    np.testing.assert_allclose(solution.change, np.linalg.solve(S, HP).T @ nu, rtol=1e-8, atol=1e-12)
    V, _ = solution.reduction()
    np.testing.assert_allclose(V @ V.T, HP.T @ np.linalg.solve(S, HP), atol=1e-12 * np.abs(C).max())
    cross = at.S[3:6, rows]  # landmark 1 is left out
    off = at.nu[3:6] - cross @ np.linalg.solve(S, nu)
    conditional = at.S[3:6, 3:6] - cross @ np.linalg.solve(S, cross.T)
    assert solution.conditional_distances[1] == pytest.approx(off @ np.linalg.solve(conditional, off), rel=1e-6)
    z = update.z + np.where(np.arange(12) == 4, 1e15, 0.0)[:, None]  # left out, however wrong it is
    other = replace(update, z=z).linearised(update.camera).solved(used)
    np.testing.assert_allclose(other.change, solution.change, rtol=1e-9, atol=1e-12)
    assert other.conditional_distances[[1, 2]] == pytest.approx(solution.conditional_distances[[1, 2]])


@pytest.mark.parametrize("transports", [True, False])
@pytest.mark.parametrize("coordinates", [InverseDepth(), Euclidean()], ids=["inverse depth", "euclidean"])
def test_no_linearisation_measures_a_displacement_of_the_world(coordinates, transports):
    """By metres, seen from wherever, with landmarks changed by whatever: H is zero along it."""
    s, _, rng = state_of(12, coordinates)
    s = replace(s, camera=replace(s.camera, transports=transports))
    update = update_of(s, np.full((12, 3), 100.0), coordinates, 5, 0.9)
    update = replace(update, covariance=covariance_of(np.eye(48)))
    there = s.camera.at(s.pose @ se3.exp(np.array([0.05, -0.1, 0.02, 0.5, -0.2, 0.3])))
    for camera in (s.camera, there):
        change = 0.02 * rng.standard_normal((12, 3)) * s.landmarks.c
        at = update.linearised(camera, change.reshape(-1))
        H = np.delete(at.HP, np.s_[CAMERA:HEAD], axis=1)
        U = np.zeros((48, 6))
        U[:6] = np.linalg.inv(gauge_by_error(s.camera if transports else at.camera))
        marks = s.landmarks if transports else s.landmarks.moved(coordinates, slice(None), change)
        U[12:] = marks.gauge.reshape(-1, 6)
        np.testing.assert_allclose(H @ U, 0, atol=1e-7)  # [px/m], [px/rad]


# --- features that slide ---


@pytest.mark.parametrize("coordinates", [InverseDepth(), Euclidean()], ids=["inverse depth", "euclidean"])
def test_a_landmark_slides_across_its_line_of_sight_with_the_angle_of_view(coordinates):
    s, _, _ = state_of(4, coordinates)
    slide, rows, x = Slide(0.01, 0.0, 0.0), np.array([0, 2]), s.camera.x.copy()
    x[0] += 0.5
    there = replace(s, camera=replace(s.camera, x=x))
    first, now = (s.landmarks.points - T[:3, 3] for T in (s.pose, there.pose))
    size, distance = np.linalg.norm(first, axis=1), np.linalg.norm(now, axis=1)
    angle = np.arccos(np.einsum("ni,ni->n", first, now) / distance / size)
    unknown = replace(there, landmarks=replace(there.landmarks, sights=np.full((4, 3), np.nan)))
    found = there.slid(slide, rows, there.pose[:3, 3])
    # no more until it is seen from elsewhere; on the way back it slides again
    for before, after, sight, by in (
        (there, found, now, angle),
        (found, found.slid(replace(slide, least=1e-6), rows, there.pose[:3, 3]), now, 0 * angle),
        (found, found.slid(slide, rows, s.pose[:3, 3]), first, angle),
        (unknown, unknown.slid(replace(slide, unknown=0.3, least=1.0), rows, there.pose[:3, 3]), now, np.full(4, 0.3)),
    ):  # fmt: skip
        added = dense(after.covariance) - dense(before.covariance)
        for row in range(4):
            at = slice(CAMERA + 3 * row, CAMERA + 3 * row + 3)
            D = coordinates.jacobian(s.landmarks.anchors[row : row + 1], s.landmarks.c[row : row + 1])[0]
            across = (
                slide.density**2 * by[row] * ((sight[row] @ sight[row]) * np.eye(3) - np.outer(sight[row], sight[row]))
            )
            np.testing.assert_allclose(D @ added[at, at] @ D.T, across if row in rows else 0 * across, atol=1e-12)
            added[at, at] = 0
        assert not added.any()
