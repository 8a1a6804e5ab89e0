"""Landmarks that have left the filter's state: where they are, how uncertain, and what they do once seen again."""

from copy import deepcopy

import numpy as np
import pytest

import backends
from backends.ekf.camera import gauge_by_error
from slam.data import Observations
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from slam.window.stereo import relative_covariance
from tests.backends.scenes import RIG, cloud, nees, observe, step

MODELS = EstimatorModels(
    MotionModel(0.5, 0.5), pixel_sigma=0.7, initial_position_sigma=0.01, initial_rotation_sigma=0.01
)
DT, KEPT = 0.1, 40
BOTH = pytest.mark.parametrize("name", ["ekf", "iekf"])


def sway(frames: int = 100) -> np.ndarray:
    """Poses (F, 4, 4) of a camera that turns by 90 degrees to one side, to the other, and back."""
    t = DT * np.arange(frames)
    turns = np.stack([0 * t, 1.6 * np.sin(2 * np.pi * t / 8), 0.02 * np.sin(t)], axis=1)
    shifts = np.stack([0.8 * np.sin(t / 3), 0.2 * np.sin(t), 0.3 * np.sin(t / 2)], axis=1)
    poses = np.array([se3.pose(se3.so3_exp(w), p) for w, p in zip(turns, shifts)])
    return se3.inverse(poses[0]) @ poses


def swayed(name: str, frames: int, seed: int = 0, considers: bool = False, **options):
    """A back end that is shown the sway up to a frame; the true poses, points, and what is seen."""
    rng, poses = np.random.default_rng(seed), sway()
    points = cloud(poses, 500, rng, 3, 9)
    sights = [observe(T, points, MODELS.pixel_sigma, rng, 40) for T in poses]
    backend, known = backends.create(name, RIG, models=MODELS, **options), set()
    if considers:
        backend.consider(lambda z: np.tile([[1.0, 0.3], [0.0, 0.2], [0.5, 0.0]], (len(z), 1, 1)), np.full((6, 2), 1e-3))
    for k in range(frames):
        step(backend, DT * k, sights[k], known)
    return backend, poses, points, sights


def inactive(state) -> np.ndarray:
    """Ids of the inactive landmarks."""
    return state.landmarks.ids[state.covariance.active :]


@BOTH
def test_a_landmark_that_leaves_stays_where_it_is_and_as_uncertain(name):
    """In the world, as seen from the camera, and by the rig's errors; those in the state do not notice."""
    backend, *_ = swayed(name, 30, considers=True, kept=None)
    whole, s = backend.estimate(), backend.state
    ids, J = whole.ids, backend.sensitivities(whole.ids)
    seen = s.relative_covariances(s.landmarks.rows_of(ids))
    backend.state = s = s.with_most_active(KEPT)
    assert len(inactive(s)) > 50 and s.covariance.active <= KEPT
    assert s.landmarks.last[s.covariance.active :].max() <= s.landmarks.last[: s.covariance.active].min()
    after, rows = backend.estimate(), s.landmarks.rows_of(ids)
    np.testing.assert_array_equal(after.ids, ids)
    np.testing.assert_array_equal(after.positions, whole.positions)
    np.testing.assert_array_equal(backend.positions(ids), whole.positions)
    np.testing.assert_allclose(after.covariances, whole.covariances, rtol=1e-9, atol=1e-15)
    for found, expected in zip(backend.sensitivities(ids), J):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_allclose(s.relative_covariances(rows), seen, rtol=1e-9, atol=1e-12)


@BOTH
def test_one_that_is_measured_again_is_new_to_the_camera(name):
    """As uncertain as the camera's way since has made it, and independent of the pose as seen from the camera."""
    backend, *_ = swayed(name, 60, considers=True, kept=KEPT)
    s, P = backend.state, backend.estimate(landmarks=False).covariance
    ids = inactive(s)
    rows = s.landmarks.rows_of(ids)
    seen, gone = s.relative_covariances(rows), s.landmarks.select(rows)
    assert (np.trace(seen - gone.relative, axis1=1, axis2=2) > 0).all()  # with the camera's way
    J = backend.sensitivities(ids)[1]
    backend.state = s = s.with_active(ids)
    assert not len(inactive(s))
    rows = s.landmarks.rows_of(ids)
    np.testing.assert_allclose(s.relative_covariances(rows), seen, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(backend.sensitivities(ids)[1], J)
    np.testing.assert_array_equal(backend.estimate(landmarks=False).covariance, P)
    # a measurement of them, however exact, says nothing of the camera
    at = s.covariance.indices(rows).ravel()
    G, H = s.landmarks.gauge[rows], np.eye(len(s.covariance.P))[at]
    H[:, :6] = -(G @ gauge_by_error(s.camera)).reshape(-1, 6)
    np.testing.assert_allclose(H @ s.covariance.P[:, :6], 0, atol=1e-12)
    # nor do many together know where the pose is that the last of them left, better than by the way from there
    half = len(ids) // 2
    U, E = G[:half].reshape(-1, 6), H[: 3 * half]
    known = np.linalg.inv(U.T @ np.linalg.solve(E @ s.covariance.P @ E.T, U))
    way = s.covariance.drift(gauge_by_error(s.camera)) + s.drifts[gone.reference[half - 1]]
    assert half > 50 and np.linalg.eigvals(np.linalg.solve(way, known)).real.min() > 1.0


def uncertain(backend, ids) -> np.ndarray:
    """Of landmarks: the deviations [rad] of their directions as seen from the camera."""
    found = backend.state.relative_covariances(backend.state.landmarks.rows_of(ids))
    return np.sqrt(np.trace(found[:, :2, :2], axis1=1, axis2=2))


@BOTH
def test_in_the_dark_one_that_has_left_is_as_uncertain_as_one_that_stayed(name):
    """And once the camera has seen others again, hardly more."""
    stayed, _, _, sights = swayed(name, 40, kept=None)
    left = deepcopy(stayed)
    left.state = left.state.with_most_active(KEPT)
    ids = inactive(left.state)
    assert len(ids) > 50
    for k in range(30):
        for backend in (left, stayed):
            backend.predict(DT * (40 + k))
        if k + 1 not in (1, 3, 10, 30):
            continue
        np.testing.assert_allclose(uncertain(left, ids), uncertain(stayed, ids), rtol=0.01)
        again = []
        for backend in map(deepcopy, (left, stayed)):
            backend.predict(DT * (41 + k))
            backend.update(sights[39].select(~np.isin(sights[39].ids, ids)))
            again.append(uncertain(backend, ids))
        ratio = again[0] / again[1]
        assert ratio.min() > 0.9 and np.median(ratio) < 1.6


@BOTH
def test_a_camera_that_hovers_knows_where_those_that_have_left_are(name):
    """Hardly worse than if they had stayed, though others go on to leave, and no worse with time."""
    found: list[np.ndarray] = []
    frames = 40
    ids = np.arange(500)
    for kept in (KEPT, None):
        backend, poses, points, _ = swayed(name, frames, kept=kept)
        known, rng = set(backend.state.landmarks.ids.tolist()), np.random.default_rng(5)
        ids = np.intersect1d(ids, inactive(backend.state)) if kept else ids
        for k in range(30):
            T = poses[frames - 1].copy()
            T[0, 3] += 0.01 * np.sin(0.3 * k)
            step(backend, DT * (frames + k), observe(T, points, MODELS.pixel_sigma, rng, 40), known)
        ids = np.intersect1d(ids, inactive(backend.state)) if kept else ids
        found.append(uncertain(backend, ids))
    ratio = found[0] / found[1]
    assert len(ids) > 30 and ratio.min() > 0.9 and np.median(ratio) < 1.5


@pytest.mark.slow
@BOTH
def test_a_camera_that_turns_away_and_back_knows_how_far_it_is_off(name):
    """In the world, and over its last steps, where those that have left come back; nothing is counted twice."""
    whole, steps, again = [], [], 0
    for seed in range(4):
        backend, poses, _, sights = swayed(name, 0, seed, kept=KEPT)
        known: set[int] = set()
        for k, T in enumerate(poses):
            gone = set(inactive(backend.state).tolist())
            report = step(backend, DT * k, sights[k], known)
            again += len(gone & set(report.used.tolist()))
            whole.append(nees(backend, T))
            if k >= 5:
                past = backend.recent(5)
                first, last = past.poses[[0, -1]]
                P = relative_covariance(past.covariance, first, last)
                xi = se3.log(se3.inverse(se3.inverse(first) @ last) @ se3.inverse(poses[k - 4]) @ T)
                steps.append(xi @ np.linalg.solve(P, xi))
    assert again > 400
    assert np.mean(whole) < 6 * 1.4 and 0.85 < np.mean(steps) / 6 < 1.2


@BOTH
def test_landmarks_that_have_left_are_revised_too(name):
    """As they are where all are in the state; what moves them is the last error of the rig."""
    found = []
    for kept in (KEPT, None):
        backend, *_ = swayed(name, 30, considers=True, kept=None)
        s = backend.state = backend.state if kept is None else backend.state.with_most_active(kept)
        ids = np.sort(s.landmarks.ids)
        before, J = backend.positions(ids), backend.sensitivities(ids)[1]
        backend.revise(lambda z: z + np.array([1e-3, 0.0, -1e-3]))  # [px], so little that it is linear
        moved = backend.positions(ids) - before
        found.append((moved, (backend.sensitivities(ids)[1] - J)[:, :, -1]))
        assert kept is None or np.linalg.norm(moved[np.isin(ids, inactive(s))], axis=1).min() > 1e-5
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-12)
    size = np.abs(found[0][0]).max()
    for moved, change in found:
        np.testing.assert_allclose(change, -moved, atol=0.05 * size)


@BOTH
def test_they_are_removed_and_those_of_a_prior_map_stay_in_the_state(name):
    backend, poses, _, sights = swayed(name, 0, kept=0)
    ids = np.arange(1000, 1040)
    inside = cloud(poses[:1], 40, np.random.default_rng(3))
    backend.insert(ids, inside, np.tile(1e-4 * np.eye(3), (40, 1, 1)))
    known: set[int] = set()
    for k in range(4):
        uv = RIG.project(se3.transform(se3.inverse(poses[k]), inside))
        good = RIG.left.in_image(uv[0]) & RIG.right.in_image(uv[1])
        backend.predict(DT * k)
        backend.update(Observations(ids[good], uv[0][good], uv[1][good]))
        backend.add(sights[k].select(~np.isin(sights[k].ids, list(known))))
        known |= set(sights[k].ids.tolist())
    backend.predict(1.0)
    s = backend.state
    inserted, state = s.landmarks.known, s.landmarks.last[: s.covariance.active]
    assert (s.landmarks.last[inserted] >= 0).sum() > 20
    assert set(s.landmarks.ids[: len(state)]) >= set(s.landmarks.ids[inserted & (s.landmarks.last >= 0)])
    assert set(inactive(s).tolist()) >= known - set(sights[3].ids.tolist())
    backend.remove(inactive(s)[::2])
    assert len(inactive(backend.state)) == len(inactive(s)) // 2
