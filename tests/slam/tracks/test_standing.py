"""Whether the camera stands: by features that stay, whatever moves in front of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import slam
from frontends import create
from slam.chi_square import chi_square_limit
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.geometry import se3
from slam.geometry.se3 import exp, inverse, log, transform
from slam.system import StereoSlam
from slam.tracks.standing import Standing
from slam.tracks.step import HIDDEN
from tests.slam.scene import BACKENDS, RIG, Cloud, features_at

SIGMA = 0.3


class Scene:
    """Points before a camera; some are a body's."""

    def __init__(self, body: float, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        depth = self.rng.uniform(2, 8, 400)
        xy = self.rng.uniform(-0.4, 0.4, (400, 2))
        self.points = np.column_stack([xy * depth[:, None], depth])
        self.body = np.arange(400) < body * 400
        self.descriptors = np.linalg.qr(self.rng.standard_normal((400, 400)))[0].astype(np.float32)

    def seen(self, k: int, camera: np.ndarray, shift: np.ndarray, body: bool | None = None) -> StereoFeatures:
        """The frame k from a pose (4, 4), with the body shifted (3,) [m], within the view or without it if asked."""
        local = transform(inverse(camera), self.points + shift * self.body[:, None])
        z, _ = RIG.project_stereo(local, jacobian=False)
        z = z + self.rng.normal(0, SIGMA, z.shape)
        shown = ~self.body if body is False else RIG.left.in_view(local) | (body is None)
        return features_at(z[shown, :2], z[shown][:, [2, 1]], self.descriptors[shown], 0.1 * k)


def after(frames: list[StereoFeatures]) -> Standing:
    standing = Standing()
    for features in frames:
        standing = standing.after(RIG, SIGMA, features)
    return standing


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_at_rest_is_never_taken_for_moving_by_noise(seed):
    scene, standing = Scene(0.0, seed), Standing()
    for k in range(60):
        standing = standing.after(RIG, SIGMA, scene.seen(k, np.eye(4), np.zeros(3)))
        assert standing.frames == k


@pytest.mark.parametrize(("share", "stands"), [(0.0, True), (0.6, False)], ids=["leaves", "a body"])
def test_features_that_are_found_nowhere_again_say_nothing(share, stands):
    """With leaves and shadows, others in each frame, a camera at rest was taken for moving: it drifted by 1 cm."""
    scene, frames = Scene(share), []
    for k in range(8):
        shift = np.array([0.05 * k, 0.0, 0.0])
        seen, others = scene.seen(k, np.eye(4), shift), Scene(0.0, seed=10 + k).seen(k, np.eye(4), np.zeros(3))
        if stands:
            z = np.concatenate([f.uv_left for f in (seen.select(slice(160)), others.select(slice(240)))])
            right = np.concatenate([f.uv_right for f in (seen.select(slice(160)), others.select(slice(240)))])
            seen = features_at(z, right, np.concatenate([seen.descriptors[:160], others.descriptors[:240]]), 0.1 * k)
        frames.append(seen)
    assert after(frames).stands is stands


def test_one_frame_in_which_all_seems_to_move_does_not_end_a_rest():
    """Light that changes moves all features; a camera that moves goes on."""
    scene = Scene(0.0)
    frames = [scene.seen(k, np.eye(4), np.zeros(3)) for k in range(20)]
    apart = np.array([0.0, 0.4])
    moved = [replace(f, uv_left=f.uv_left + apart, uv_right=f.uv_right + apart) for f in frames]
    rest = after(frames[:8])
    once = rest.after(RIG, SIGMA, moved[8])
    assert once.frames == rest.frames and once.blind == 1
    assert once.after(RIG, SIGMA, frames[9]).blind == 0
    assert not once.after(RIG, SIGMA, moved[9]).stands


@pytest.mark.parametrize("motion", [[0, 0, 0, 0.01, 0, 0], [0, 0, 0, 0, 0, 0.04], [0, 0.002, 0, 0, 0, 0]])
def test_a_camera_that_moves_slowly_does_not_stand(motion):
    scene = Scene(0.0)
    step = np.array(motion, float)
    standing = after([scene.seen(k, exp(k * step), np.zeros(3)) for k in range(12)])
    assert not standing.stands


def test_a_motion_that_explains_landmarks_and_moves_no_witness_ends_the_rest():
    scene = Scene(0.0)
    standing = after([scene.seen(k, np.eye(4), np.zeros(3)) for k in range(6)])
    there = exp(np.array([0, 0, 0, 0.3, 0, 0]))
    features = scene.seen(6, there, np.zeros(3))
    none = replace(standing, witnesses=np.zeros(0, np.intp))
    assert not none.contested(RIG, SIGMA, features, np.arange(400), there).stands
    assert standing.contested(RIG, SIGMA, scene.seen(6, np.eye(4), np.zeros(3)), np.arange(400), there).stands


@pytest.mark.parametrize("far", [0.012, 0.014, 0.016])
def test_landmarks_that_stay_do_not_end_the_rest_where_their_pose_is_somewhat_off(far):
    """By a centimetre near points would move by more than noise: they have not, so the pose is no motion."""
    scene = Scene(0.0)
    standing = after([scene.seen(k, np.eye(4), np.zeros(3)) for k in range(6)])
    features, there = scene.seen(6, np.eye(4), np.zeros(3)), exp(np.array([0, 0, 0, far, 0, 0]))
    assert standing.contested(RIG, SIGMA, features, standing.witnesses[:100], there).stands


def test_a_rest_lasts_while_something_hides_all_that_stays_for_some_frames():
    scene = Scene(0.9)
    standing = after([scene.seen(k, np.eye(4), np.zeros(3), False) for k in range(8)])
    body, frames = replace(standing, witnesses=np.flatnonzero(scene.body)), []
    for k in range(12):
        moved = scene.seen(8 + k, np.eye(4), np.array([0.3 * (k + 1), 0.0, 0.0]))
        standing = standing.after(RIG, SIGMA, moved.select(body.witnesses))
        frames.append(standing.stands)
    assert all(frames[:5])
    assert not frames[-1]


@pytest.mark.parametrize("backend", ["ekf"])
def test_a_truck_that_passes_does_not_take_the_camera_along(backend):
    """Nine of ten features are its, and it goes 6 m; noise of the frames before the rest is noticed makes 3 mm."""
    scene, farthest = Scene(0.9), 0.0
    system = slam.StereoSlam(RIG, backend=backend, kind="driving")
    for k in range(40):
        passes = 10 <= k < 30
        shift = np.array([0.3 * (k - 20), 0.0, 0.0])
        result = system.process_features(scene.seen(k, np.eye(4), shift, passes))
        farthest = max(farthest, float(np.linalg.norm(result.estimate.T_world_left[:3, 3])))
    assert farthest < 1e-2


@pytest.mark.parametrize(("backend", "share"), [("ekf", 0.05), ("smoother", 0.05), ("window", 0.05), ("ekf", 0.15)])
def test_a_bonnet_in_view_does_not_hold_a_car_that_starts_with_a_turn(backend, share):
    """What stays at its pixels is nearer than all else, so that it would outvote it; it is left out from then on."""
    scene, camera = Scene(share), np.eye(4)
    scene.points[scene.body] *= 1.0 / scene.points[scene.body, 2:]
    scene.points[~scene.body] *= 2.0
    system = slam.StereoSlam(RIG, backend=backend, kind="driving")
    for k in range(45):
        camera = camera @ exp(np.array([0, 0.004, 0, 0, 0, 0.08]) * min(1.0, max(0, k - 14) / 8))
        fastened = transform(camera, scene.points) - scene.points
        result = system.process_features(scene.seen(k, camera, fastened, True))
    assert np.linalg.norm(camera[:3, 3]) > 2.0
    assert np.linalg.norm(result.estimate.T_world_left[:3, 3] - camera[:3, 3]) < 0.1
    bonnet = scene.descriptors[scene.body]
    assert (result.features.descriptors @ bonnet.T > 0.5).any(axis=1).sum() < 0.2 * len(bonnet)


def test_what_was_taken_for_fastened_is_seen_again_at_the_next_rest():
    scene, found = Scene(0.0), []
    frames = [scene.seen(k, np.eye(4), np.zeros(3)) for k in range(6)]
    standing = after(frames[:1])
    assert standing.places is not None
    standing = replace(standing, fastened=standing.places.select(slice(50)))
    for features in frames[1:]:
        standing = standing.after(RIG, SIGMA, features, wheels=True)
        found.append((standing.stands, standing.fastened is None, len(standing.without_fastened(SIGMA, features))))
    assert found[0][:2] == (False, False) and found[0][2] < 360 and found[-1] == (True, True, 400)


@pytest.mark.parametrize("towards", [-0.06, 0.1])
def test_a_body_that_shows_half_of_the_features_and_starts_does_not_take_a_standing_car_along(towards):
    scene = Scene(0.5)
    system = slam.StereoSlam(RIG, backend="ekf", kind="driving")
    shift = np.zeros(3)
    for k in range(40):
        shift[2] += towards * min(1.0, max(0, k - 15) / 8)
        result = system.process_features(scene.seen(k, np.eye(4), shift, True))
        assert np.linalg.norm(result.estimate.T_world_left[:3, 3]) < 1e-2


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_standing_camera_does_not_believe_each_frame_for_itself(backend):
    """Light moves its features slowly and alike."""
    scene, found = Scene(0.0), []
    system = slam.StereoSlam(RIG, backend=backend)
    for k in range(40):
        seen, slow = scene.seen(k, np.eye(4), np.zeros(3)), np.array([0.0, 0.006 * max(0, k - 5)])
        seen = replace(seen, uv_left=seen.uv_left + slow, uv_right=seen.uv_right + slow)
        result = system.process_features(seen)
        found.append(result.estimate)
        assert result.status.value in ("started", "tracked")
        assert k < 5 or len(result.report.used) > 50
    assert np.array_equal(found[8].T_world_left, found[-1].T_world_left)
    assert np.all(np.diag(found[-1].covariance) >= 0.9 * np.diag(found[8].covariance))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_camera_that_stands_is_found_again(backend):
    """Lost before it stood: a pose that was predicted does not hold."""
    scene, results = Scene(0.0), []
    system = slam.StereoSlam(RIG, backend=backend)
    away = Scene(0.0, seed=7)
    there = exp(np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0]))
    for k in range(40):
        if k < 10:
            features = scene.seen(k, exp(np.array([0.0, 0.0, 0.0, 0.02 * k, 0.0, 0.0])), np.zeros(3))
        elif k < 20:
            features = away.seen(k, there, np.zeros(3)).select(np.arange(0))
        else:
            features = scene.seen(k, there, np.zeros(3))
        results.append(system.process_features(features))
    assert results[-1].status.value == "tracked"
    assert np.linalg.norm(results[-1].estimate.T_world_left[:3, 3] - there[:3, 3]) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["ekf", "smoother"])
def test_what_fills_the_view_of_a_standing_vehicle_does_not_take_it_along(backend):
    """It hides all for three seconds, so that a new map begins on it; then the old view is recognised."""
    world, truck, results = Scene(0.0), Scene(1.0, seed=1), []
    system = slam.StereoSlam(RIG, backend=backend, kind="driving")
    for k in range(60):
        shift = np.array([0.15 * (k - 25), 0.0, 0.0])
        features = truck.seen(k, np.eye(4), shift, True) if 10 <= k < 40 else world.seen(k, np.eye(4), np.zeros(3))
        results.append(system.process_features(features))
    assert system.restarted
    assert any(result.reason == HIDDEN for result in results)
    positions = np.array([result.estimate.T_world_left[:3, 3] for result in results])
    assert np.linalg.norm(positions, axis=1).max() < 2e-2
    assert results[-1].status.value == "tracked"
    assert results[35].estimate.covariance[3, 3] > 1.0 > 1e-3 > results[-1].estimate.covariance[3, 3]


@pytest.fixture(scope="module")
def street(slam_data):
    """A still camera before people who walk by: the sequence, and the features of its first frames."""
    sequence = slam.open_sequence(f"{slam_data / 'still_camera_people'}?calibration=calib.txt&fps=30")
    frontend = create("surf", sequence.rig, **SystemConfig.for_kind(sequence.kind).frontend)
    return sequence, [frontend.extract(frame) for frame in sequence.frames(0, 70)]


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_people_who_walk_by_hardly_move_the_camera(street, backend):
    """Two people are in view at most; their shadows, through which the ground is seen, are no bodies."""
    sequence, seen = street
    system = slam.StereoSlam(sequence.rig, backend=backend, kind=sequence.kind)
    results = [system.process_features(features) for features in seen]
    assert {result.status.value for result in results} == {"started", "tracked"}
    assert max(len(result.objects) for result in results) <= 3
    errors = np.array([log(result.estimate.T_world_left) for result in results])
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 5e-3
    assert np.degrees(np.linalg.norm(errors[:, :3], axis=1).max()) < 0.1
    P = results[-1].estimate.covariance
    assert errors[-1] @ np.linalg.solve(P, errors[-1]) < chi_square_limit(6, 0.999)


ROWS = ("uv_left", "uv_right", "scale", "angle", "response", "laplacian", "descriptors")


@pytest.mark.parametrize("backend", ["ekf", "smoother"])
def test_a_camera_that_something_large_took_along_comes_back(backend):
    """It stands; something passes, covers all of its view for a second, and moves by more than a metre meanwhile."""
    world, mover = Cloud(150), Cloud(600, seed=9)
    mover.points = mover.points * (3, 0.8, 0.15) + (0, 0, 1.2)
    system = StereoSlam(RIG, None, backend, config=SystemConfig.for_kind("handheld", None))
    results = []
    for k in range(85):
        here, _ = world.features(np.eye(4), k / 30, 0.3)
        there, _ = mover.features(se3.exp(np.array([0, 0, 0, -0.04 * (k - 10), 0, 0])), k / 30, 0.3)
        edge = 14.0 * (k - 20)
        covered = [(f.uv_left[:, 0] < edge) & (f.uv_left[:, 0] > edge - 520) for f in (here, there)]
        a, b = here.select(~covered[0]), there.select(covered[1])
        features = replace(a, **{name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in ROWS})
        results.append(system.process_features(features))
    off = [float(np.linalg.norm(r.estimate.T_world_left[:3, 3])) for r in results]
    assert max(off) > 0.3  # taken along: that it is, others see to
    sigmas = [float(np.sqrt(np.trace(r.estimate.covariance[3:, 3:]))) for r in results]
    assert all(error < 3 * sigma for error, sigma in zip(off, sigmas))  # it grows where what fills the view changes
    assert max(off[k] for k, r in enumerate(results) if r.loop == 0) < 0.05
    assert off[-1] < 0.2 * max(off)
