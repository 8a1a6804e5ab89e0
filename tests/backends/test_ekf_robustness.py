from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

import backends
from backends.ekf import EkfBackend
from backends.ekf.innovation import Correction, Linearisation
from backends.ekf.solve import correction
from backends.iekf import IekfBackend
from slam.data import Observations, UpdateStatus
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel, SlideModel, models_for
from tests.backends.ekf_runs import DRIVE, FORWARD, MODELS, ROLL, STILL, YAW, dense, errors, predicted
from tests.backends.hostile_calls import play
from tests.backends.scenes import RIG, cloud, nees, observe, path, run, scene, step

# --- gaps and turns ---

BOTH = pytest.mark.parametrize("make", [EkfBackend, IekfBackend], ids=["ekf", "iekf"])


@pytest.mark.parametrize("rate", [YAW, ROLL, np.array([0.6, 0.6, 0.6])], ids=["heading", "roll", "all"])
def test_the_angles_singularity_is_harmless(rate):
    data = scene(path(70, 0.1, 0.2 * FORWARD, rate), points=1000)  # turns by 400 degrees
    backend = EkfBackend(RIG, MODELS)
    reports = run(backend, data)
    assert errors(backend, data.poses).max() < 0.03
    assert nees(backend, data.poses[-1]) < chi2.ppf(0.9999, 6)
    assert sum(len(r.rejected) for r in reports) < 10


@BOTH
@pytest.mark.parametrize(
    ("gap", "place", "turn"), [(10.0, 10.0, 0.05), (1e9, 10.0, 1.0), (10.0, 1e4, 0.05), (1e9, 1e4, 0.05)]
)
def test_a_gap_measures_no_displacement_of_the_world(make, gap, place, turn):
    """The camera comes back to the same view, after it may have turned anyhow: its place is no better known."""
    models = replace(MODELS, initial_position_sigma=place, initial_rotation_sigma=turn)
    data, known = scene(np.tile(path(10, 0.1, 0.2 * FORWARD, STILL), (3, 1, 1)), points=200), set()
    backend = make(RIG, models)
    for k, (stamp, _, seen) in enumerate(data):
        step(backend, stamp + gap * (k // 10), seen, known)
        if k % 10 == 9:
            P = backend.estimate().covariance
            assert np.sqrt(np.trace(P[3:, 3:]) / 3) == pytest.approx(place, rel=0.01)
            assert np.sqrt(np.trace(P[:3, :3]) / 3) == pytest.approx(turn, rel=0.01)


@BOTH
@pytest.mark.parametrize("gap", [1e3, 1e5, 1e9])
def test_a_gap_of_any_length(make, gap):
    """A paused recording, while the camera was moved a little: tracked again from the first frame on."""
    for moved in (np.zeros(6), np.array([0.1, -0.3, 0.05, 0.4, -0.2, 0.3])):
        before = path(15, 0.1, 0.5 * FORWARD, 0.1 * YAW)
        poses = np.concatenate([before, before[-1] @ se3.exp(moved) @ path(15, 0.1, 0.5 * FORWARD, 0.1 * YAW)])
        data = scene(poses, points=200)
        backend, known = make(RIG, MODELS), set()
        for k, (stamp, _, seen) in enumerate(data):
            report = step(backend, stamp + (gap if k >= 15 else 0), seen, known)
            assert k == 0 or len(report.used) > 5 * len(report.rejected)
        assert errors(backend, poses)[1] < 0.05
        P = dense(backend.state.covariance)
        assert np.linalg.eigvalsh(P / np.sqrt(np.outer(P.diagonal(), P.diagonal()))).min() > 0


@BOTH
@pytest.mark.parametrize(("kind", "gap"), [("handheld", 3.0), ("driving", 10.0), ("driving", 1e3)])
def test_wrong_matches_after_a_gap_are_left_out(make, kind, gap):
    """Of a prior as wide as after a gap nothing is lost in rounding where landmarks are left out."""
    models, forward = replace(models_for(kind), slide=SlideModel()), path(11, 0.1, np.array([0, 0, 0.2]), np.zeros(3))
    for seed in range(3):
        data, rng = scene(forward, 600, models.pixel_sigma, seed=seed, limit=40), np.random.default_rng(seed)
        backend, known = make(RIG, models), set()
        run(backend, list(data)[:-1], known)
        seen, wrong = data.observations[-1], rng.random((40, 1)) < 0.2
        left, right = rng.uniform(-200, 200, (2, 40, 2)) * wrong
        seen = Observations(seen.ids, seen.uv_left + left, seen.uv_right + right)
        report = step(backend, data.stamps[-1] + gap, seen, known)
        assert report.status is UpdateStatus.OK, report.reason
        assert nees(backend, data.poses[-1]) < chi2.ppf(0.9999, 6)


@BOTH
@pytest.mark.parametrize("count", [5, 7, 20])
def test_known_landmarks_are_found_again_after_a_blind_stretch(make, count):
    """The camera went where the motion model does not expect it, and sees but landmarks it knows: it starts there."""
    before, after = path(15, 0.1, 0.3 * FORWARD, STILL), path(20, 0.1, 0.3 * FORWARD, 0.1 * YAW)
    hidden = se3.exp(np.array([0.05, 0.3, -0.1, 1.5, -0.5, 1.0]))
    poses = np.concatenate([before, before[-1] @ hidden @ after])
    rng = np.random.default_rng(2)
    points = cloud(poses[:1], 60, rng, 6.0, 12.0)
    backend, known = make(RIG, EstimatorModels(MotionModel(0.02, 0.02), pixel_sigma=0.5)), set()
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


@pytest.mark.parametrize("name, seed", [("ekf", 207), ("iekf", 212), ("ekf", 14), ("ekf", 315), ("iekf", 318)])
def test_no_landmark_loses_its_variance(name, seed):
    """Calls with gaps of years and landmarks of little parallax: large numbers cancel, or a step has no meaning."""
    play(partial(backends.create, name), seed)


# --- robustness ---


@BOTH
@pytest.mark.parametrize("share", [0.1, 0.5])
def test_wrong_matches_are_found(make, share):
    rng = np.random.default_rng(3)
    backend, known, missed, false, wrong = make(RIG, MODELS), set(), 0, 0, 0
    for stamp, _, seen in DRIVE:
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
    assert errors(backend, DRIVE.poses).max() < 0.04


def test_a_landmark_in_contradiction_with_the_others_is_found():
    """An innovation within its own wide gate, but not where the others say: the velocity is unknown at first."""
    models = replace(models_for("driving"), pixel_sigma=0.5, slide=SlideModel())
    backend, seen = predicted(DRIVE, 1, models=models)
    uv_left, uv_right = seen.uv_left.copy(), seen.uv_right.copy()
    uv_left[5] += [8.0, -6.0]
    uv_right[5] += [8.0, -6.0]
    report = backend.update(Observations(seen.ids, uv_left, uv_right))
    np.testing.assert_array_equal(report.rejected, seen.ids[[5]])


@pytest.mark.parametrize("entry", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("where", ["pose", "landmark"])
def test_a_broken_covariance_is_a_status_with_a_reason(entry, where):
    backend, seen = predicted(DRIVE, 5)
    P = backend.state.covariance
    broken, row = P.P.copy(), 1 if where == "pose" else P.indices(backend.state.landmarks.rows_of(seen.ids[3:4]))[0, 0]
    broken[row, row] = entry
    backend.state = replace(backend.state, covariance=replace(P, P=broken))
    before = backend.state
    report = backend.update(seen)
    assert report.status is UpdateStatus.FAILED and "ekf" in report.reason
    assert len(report.used) == 0
    assert backend.state.covariance is before.covariance and backend.state.landmarks is before.landmarks
    np.testing.assert_array_equal(backend.state.camera, before.camera)


@pytest.mark.parametrize("turn", [4.0, np.nan])
def test_a_step_of_more_than_half_a_turn_is_a_status_with_a_reason(monkeypatch, turn):
    backend, seen = predicted(DRIVE, 5)
    solved = Linearisation.solved

    def turned(self: Linearisation, used: np.ndarray) -> Correction:
        found = solved(self, used)
        found.change[3] += turn
        return found

    monkeypatch.setattr(Linearisation, "solved", turned)
    report = backend.update(seen)
    assert report.status is UpdateStatus.FAILED and "half a turn" in report.reason


@BOTH
@pytest.mark.parametrize("degrees", [80, 88, 180])
def test_a_roll_in_one_step(make, degrees):
    """Beyond what the motion model expects, to where Euler angles are singular: all landmarks count in the end."""
    poses, found = path(10, 0.1, np.array([0, 0, 0.5]), STILL), []
    for seed in range(5):
        rng, known, backend = np.random.default_rng(seed), set(), make(RIG, MODELS)
        points = cloud(poses, 60, rng)
        for k, T in enumerate(poses):
            step(backend, 0.1 * k, observe(T, points, 0.5, rng), known)
        rolled = poses[-1] @ se3.exp(np.array([0, 0, np.radians(degrees), 0, 0, 0.05]))
        seen = observe(rolled, points, 0.5, rng, 60)
        backend.predict(1.9)
        report = backend.update(seen.select(np.isin(seen.ids, list(known))), rolled)
        assert report.status is UpdateStatus.OK and len(report.rejected) <= 1
        found.append(nees(backend, rolled))
    assert max(found) < chi2.ppf(0.9999, 6)


def test_of_two_agreements_of_minorities_the_larger_counts(monkeypatch):
    agreeing = iter([4, 1])
    found = lambda _: SimpleNamespace(used=np.arange(12) < next(agreeing))  # noqa: E731
    monkeypatch.setattr("backends.ekf.solve._plausible", found)
    camera, covariance = SimpleNamespace(pose=np.eye(4), at=lambda T: T), SimpleNamespace(P=np.eye(3))
    update = SimpleNamespace(camera=camera, covariance=covariance, z=np.zeros((12, 3)), linearised=lambda camera: None)
    assert correction(update, np.eye(4), lambda: None).used.sum() == 4
