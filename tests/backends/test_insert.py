"""Landmarks whose place is known beforehand, in the world or before the camera, in every back end."""

import numpy as np
import pytest

import backends
from backends.ekf.landmarks import Slide
from slam.data import Observations, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry import se3
from slam.interfaces import MapBackend
from slam.models import EstimatorModels, SlideModel
from tests.backends.scenes import RIG, observe, path

SIGMA = 0.5
DT = 0.1
KNOWN = 0.01  # standard deviation of what is known of a landmark [m]
NAMES = ("ekf", "smoother", "window", "batch")
START = se3.exp(np.array([0.1, -0.2, 0.05, 0.3, 0.2, -0.4]))  # the camera's true place at first


class Scene:
    """Points known to within `KNOWN`, and a camera that flies slowly before them from `START`."""

    def __init__(self, frames: int = 12) -> None:
        rng = np.random.default_rng(3)
        self.points = rng.uniform((-3, -2, 4), (3, 2, 9), (40, 3))
        self.ids = np.arange(40)
        self.believed = self.points + KNOWN * rng.standard_normal((40, 3))
        self.covariances = np.tile(KNOWN**2 * np.eye(3), (40, 1, 1))
        self.poses = START @ path(frames, DT, np.array([0.2, -0.1, 0.3]), np.array([0.02, 0.1, -0.05]))
        self.seen = [observe(T, self.points, SIGMA, rng, 40) for T in self.poses]


def models(**changes):
    vague = {"initial_position_sigma": 1.0, "initial_rotation_sigma": 0.5}
    return EstimatorModels(pixel_sigma=SIGMA, **{**vague, **changes})


def tracked(name, scene, disturb=lambda k, backend: None):
    """A back end after all frames, which begins at the origin while the camera is at `START`."""
    backend = backends.create(name, RIG, models=models())
    backend.insert(scene.ids, scene.believed, scene.covariances)
    for k, seen in enumerate(scene.seen):
        prediction = backend.predict(DT * k)
        report = backend.update(seen, START if k < 2 else None)
        assert report.status is UpdateStatus.OK and len(report.used) > 0.9 * len(seen), (k, report.reason)
        assert k < 2 or len(prediction.ids) > 20
        disturb(k, backend)
    return backend


@pytest.mark.parametrize("name", NAMES)
def test_the_camera_is_found_in_a_prior_map_which_becomes_better(name):
    scene = Scene(frames=20)
    backend = tracked(name, scene)
    assert isinstance(backend, MapBackend)
    estimate = backend.estimate()
    # 40 points known to 1 cm, 4 to 9 m away, fix the place to 15 mm; χ²₆ exceeds 25 once in 3000 times
    off = se3.log(se3.inverse(estimate.T_world_left) @ scene.poses[-1])
    assert np.linalg.norm(off[3:]) < 0.05 and off @ np.linalg.solve(estimate.covariance, off) < 25
    assert np.sqrt(np.trace(estimate.covariance[3:, 3:])) < 0.02
    assert (estimate.ids == scene.ids).all()
    errors = estimate.positions - scene.points
    assert np.square(errors).mean() < np.square(scene.believed - scene.points).mean()
    assert np.trace(estimate.covariances, axis1=1, axis2=2).mean() < 3 * KNOWN**2
    distances = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(estimate.covariances), errors)
    assert 0.5 < distances.mean() / 3 < 1.6  # 40 landmarks, correlated through the pose


@pytest.mark.parametrize("name", NAMES)
def test_the_first_poses_prior_counts_as_much_as_the_map(name):
    """Four landmarks known to 10 cm see it 5 cm off, where it is known to 3 cm; also after a revision."""
    points = np.array([[-2.0, -1.0, 6.0], [2.0, -1.0, 7.0], [-1.5, 1.2, 6.0], [1.5, 1.0, 5.5]])
    backend = backends.create(name, RIG, models=models(initial_position_sigma=0.03, initial_rotation_sigma=1e-4))
    backend.insert(np.arange(4), points, np.tile(0.01 * np.eye(3), (4, 1, 1)))
    backend.predict(0.0)
    backend.update(Observations(np.arange(4), *RIG.project(points - [0.05, 0.0, 0.0])))
    backend.revise(lambda z: z)
    found = backend.estimate()
    assert found.T_world_left[0, 3] == pytest.approx(0.05 * 0.03**2 / (0.03**2 + 0.01 / 4), rel=0.1)
    assert found.covariance[3, 3] == pytest.approx(1 / (1 / 0.03**2 + 4 / 0.01), rel=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_inserted_and_never_seen_stays_as_it_is(name):
    scene = Scene(frames=6)
    backend = backends.create(name, RIG, models=models())
    behind, P = np.array([[1.0, 2.0, -30.0]]), np.diag([0.01, 0.04, 0.09])[None]
    backend.insert(np.array([5000]), behind, P)
    backend.insert(scene.ids, scene.believed, scene.covariances)
    for k, seen in enumerate(scene.seen):
        backend.predict(DT * k)
        backend.update(seen, START)
    estimate = backend.estimate()
    np.testing.assert_allclose(estimate.positions[-1], behind[0], atol=1e-6)
    np.testing.assert_allclose(estimate.covariances[-1], P[0], rtol=1e-3, atol=1e-6)
    assert backend.positions(np.array([5000])).shape == (1, 3)
    backend.remove([5000])
    with pytest.raises(MeasurementError, match="5000"):
        backend.positions(np.array([5000]))


@pytest.mark.parametrize("name", ["ekf", "iekf"])
def test_landmarks_of_which_next_to_nothing_is_known_agree_with_what_is_seen(name):
    scene = Scene(1)
    backend = backends.create(name, RIG, models=models(T_world_left=START))
    backend.insert(scene.ids, scene.points, np.tile(1e8 * np.eye(3), (40, 1, 1)))  # to 10 km; all were refused
    backend.predict(0.0)
    assert len(backend.update(scene.seen[0]).used) == len(scene.seen[0])


@pytest.mark.parametrize("share", [0.4, 0.96, 1.0])
def test_a_prior_maps_features_slide_up_to_the_first_sight_and_on(share):
    """By what of the noise is none of a frame; nothing slides before a camera that stands and seems to sway."""
    known = models(slide=SlideModel(3.0, share), initial_position_sigma=1e-6, initial_rotation_sigma=1e-6)
    backend, point = backends.create("iekf", RIG, models=known), np.array([[0.0, 0.0, 5.0]])
    backend.insert(np.array([7]), point, 1e-6 * np.eye(3)[None])
    backend.predict(0.0)
    backend.state = backend.state.with_active(np.array([7]))

    def walked(x: float) -> float:  # variance across the line of sight [px²], over what was known
        backend.state = backend.state.slid(Slide.of(known, 400.0), np.array([0]), np.array([x, 0.0, 0.0]))
        return float((backend.estimate().covariances[0, 0, 0] - 1e-6) * (400.0 / 5) ** 2)

    first = (1 - share**2) * SIGMA**2
    for k in range(200):
        assert walked(5e-4 * (k % 2)) == pytest.approx(first, rel=1e-6, abs=1e-9)
    assert walked(0.5) == pytest.approx(first + 3.0**2 * np.arctan(0.1), rel=0.02)


@pytest.mark.parametrize(("frames", "atol"), [(12, 1e-3), (30, 1.2e-2)])  # of 15 mm; with the lag, less is known
def test_the_smoother_keeps_what_was_known_when_it_is_rebuilt(frames, atol):
    """And counts nothing twice: neither what the first pose measured, nor what is known of the landmarks."""
    scene, last = Scene(frames), frames - 7
    plain = tracked("smoother", scene).estimate()
    rebuilt = tracked("smoother", scene, lambda k, b: b.revise(lambda z: z) if k in (0, 5, last) else None).estimate()
    np.testing.assert_allclose(rebuilt.T_world_left, plain.T_world_left, atol=atol)
    np.testing.assert_allclose(rebuilt.positions, plain.positions, atol=atol)
    deviations = [np.sqrt(np.diag(one.covariance)) for one in (rebuilt, plain)]
    assert (deviations[0] > 0.97 * deviations[1]).all() and (deviations[0] < 2 * deviations[1]).all()


@pytest.mark.parametrize("name", NAMES)
def test_landmarks_placed_before_the_camera_move_with_its_pose(name):
    """With the camera's own place known to 5 cm, so is theirs; the next pose is known relative to them."""
    scene = Scene(frames=8)
    backend = backends.create(
        name, RIG, models=models(initial_position_sigma=0.05, initial_rotation_sigma=1e-3, T_world_left=START.tolist())
    )
    backend.predict(0.0)
    first = scene.seen[0]
    local = RIG.triangulate(first.uv_left, first.uv_right)
    backend.place(first.ids, local, RIG.triangulation_covariance(local, SIGMA))
    spread = np.sqrt(backend.estimate().covariances[:, 0, 0])
    assert (spread > 0.05).all()
    for k, seen in enumerate(scene.seen[1:], start=1):
        backend.predict(DT * k)
        report = backend.update(seen.select(np.isin(seen.ids, first.ids)))
        assert len(report.used) > 0.8 * len(seen)
    last = backend.estimate().T_world_left
    # the first pose is believed where it is: what was placed is seen from there
    assert np.linalg.norm(last[:3, 3] - scene.poses[-1][:3, 3]) < 0.03


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda i, x, P: (i, x[:-1], P), "positions"),
        (lambda i, x, P: (np.r_[i[:-1], i[0]], x, P), "twice"),
        (lambda i, x, P: (i, x * np.nan, P), "not finite"),
        (lambda i, x, P: (i, x, -P), "positive definite"),
        (lambda i, x, P: (i, x, P + np.triu(P + 1, 1)), "positive definite"),
    ],
)
def test_bad_input_is_refused_with_one_line(name, change, words):
    scene = Scene(frames=1)
    backend = backends.create(name, RIG, models=models())
    with pytest.raises(MeasurementError, match=words):
        backend.insert(*change(scene.ids, scene.believed, scene.covariances))
    backend.insert(scene.ids, scene.believed, scene.covariances)
    with pytest.raises(MeasurementError, match=r"landmark 0 .*already"):
        backend.insert(scene.ids, scene.believed, scene.covariances)
    with pytest.raises(MeasurementError, match="before the first predict"):
        backend.place(scene.ids + 1000, scene.believed, scene.covariances)


@pytest.mark.parametrize("name", (*NAMES, "iekf"))
def test_a_revision_leaves_known_landmarks_that_were_never_measured(name):
    """No pixels have placed them, so that corrected pixels cannot move them, nor what is said of the rig's errors."""
    backend, ids = backends.create(name, RIG, models=models()), np.arange(3)
    positions = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 8.0], [-1.0, 0.5, 20.0]])
    backend.consider(lambda z: np.ones((len(z), 3, 1)))
    backend.insert(ids, positions, np.tile(1e-4 * np.eye(3), (3, 1, 1)))
    backend.predict(0.0)
    before = backend.positions(ids), backend.sensitivities(ids)[1]
    backend.revise(lambda z: z + np.array([0.0, 0.0, 0.5]))
    np.testing.assert_array_equal(backend.positions(ids), before[0])
    np.testing.assert_array_equal(backend.sensitivities(ids)[1], before[1])
