"""What the contract does not ask of the smoother: its factors' lives, revisits, gaps, a fixed lag."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from backends.smoother.solver import SolverError

from backends.smoother import SmootherBackend, factor_builder, factor_graph, rebuild
from slam.data import Observations, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import RIG, observe, path, run, scene, step

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


def measurements_in_factors(backend: SmootherBackend) -> list[int]:
    """Rows of all measurements that are in some factor, with repetition."""
    measurement_log = backend.measurement_log
    rows = [row for finished in measurement_log.history.finished for row in finished.tolist()]
    rows += [row for explicit in measurement_log.history.explicit.values() for row in explicit]
    return rows + [row for track in measurement_log.landmarks.tracks.values() for row in track.rows]


@pytest.mark.parametrize("options", [{}, {"explicit": 0}, {"track": 3, "explicit": 5}, {"lag": 12}], ids=str)
def test_every_measurement_is_in_one_factor(options):
    data = drive(45, points=250)
    backend = SmootherBackend(RIG, MODELS, **options)
    run(backend, data)
    rows = measurements_in_factors(backend)
    assert len(rows) == len(set(rows)), "a measurement is used twice"
    accepted = np.flatnonzero(backend.measurement_log.measurements.landmark >= 0)
    # Only what never became a factor may be missing: tracks of one measurement that ended, and what left with the lag.
    assert "lag" in options or len(set(accepted.tolist()) - set(rows)) < 0.1 * len(accepted)
    moved, turned = errors(backend.trajectory().poses, data.poses)
    assert moved.max() < 0.1 and turned.max() < 0.01


def test_smart_factors_grow_and_are_finished():
    data = drive(30)
    backend = SmootherBackend(RIG, MODELS, track=5, explicit=0)
    known: set[int] = set()
    longest, restarted = 0, 0
    for k, (stamp, _, seen) in enumerate(data):
        step(backend, stamp, seen, known)
        tracks = backend.measurement_log.landmarks.tracks.values()
        longest = max([longest, *(len(t) for t in tracks)])
        restarted += sum(len(t) == 0 for t in tracks)
        assert all(len(t) < t.limit for t in tracks), f"frame {k}: a track is longer than its limit"
        assert all((t.factor >= 0) == t.informative for t in tracks)
    assert 5 <= longest < 2 * 5, "limits lie between one and two times the option"
    assert restarted and len(backend.measurement_log.history.finished) > 20
    lengths = {len(rows) for rows in backend.measurement_log.history.finished}
    assert max(lengths) < 10 and len(lengths) > 1


def test_well_known_landmarks_become_variables_up_to_the_limit():
    data = drive(30)
    backend = SmootherBackend(RIG, MODELS, track=4, explicit=7)
    run(backend, data)
    marks = backend.measurement_log.landmarks
    explicit = marks.variable[marks.used()]
    assert (explicit >= 0).any() and len(set(explicit[explicit >= 0].tolist())) == (explicit >= 0).sum()
    in_view = np.isin(marks.ids, data.observations[-1].ids) & (marks.variable >= 0)
    assert in_view.sum() <= 7
    assert backend.measurement_log.history.finished, "the others go on in smart factors"


def test_what_removed_landmarks_have_told_stays_known():
    data = drive(25)
    backend = SmootherBackend(RIG, MODELS)
    run(backend, data)
    before, P = backend.trajectory(), backend.estimate().covariance
    rows = sorted(measurements_in_factors(backend))
    informative = {
        row for t in backend.measurement_log.landmarks.tracks.values() if not t.informative for row in t.rows
    }
    backend.remove(backend.estimate().ids)
    assert len(backend.estimate().ids) == 0
    assert set(measurements_in_factors(backend)) == set(rows) - informative
    # To rounding: the answer is solved for again, with the factors in another order.
    np.testing.assert_allclose(backend.trajectory().poses, before.poses, rtol=0, atol=1e-14)
    np.testing.assert_allclose(backend.estimate().covariance, P, rtol=0, atol=1e-12 * np.abs(P).max())
    report = step(backend, 2.5, Observations.empty(), set())
    assert report.status is UpdateStatus.EMPTY
    grown = backend.estimate().covariance
    assert np.linalg.eigvalsh(grown - P).max() > 0


def test_frames_without_observations_and_a_time_gap():
    data = drive(40)
    backend = SmootherBackend(RIG, MODELS)
    known: set[int] = set()
    deviations = []
    for k, (stamp, _, seen) in enumerate(data):
        if 15 <= k < 20:
            seen = Observations.empty()
        if 28 <= k < 33:
            continue  # no frame at all: a gap of 0.6 s
        report = step(backend, stamp, seen, known)
        deviations.append(np.sqrt(np.trace(backend.estimate(landmarks=False).covariance[3:, 3:])))
        assert report.status is (UpdateStatus.OK if len(seen) and k else UpdateStatus.EMPTY)
    assert (np.diff(deviations[14:20]) > 0).all(), "uncertainty grows while nothing is seen"
    assert deviations[20] < 0.5 * deviations[19]
    trajectory = backend.trajectory()
    assert len(trajectory) == 35
    kept = np.r_[0:28, 33:40]
    moved, turned = errors(trajectory.poses, data.poses[kept])
    # Frames without measurements lie between measured ones: their motion noise is 0.5 m/s/√s over 0.3 s at most.
    assert moved.max() < 0.15 and turned.max() < 0.1
    assert moved[-5:].max() < 0.05 and turned[-5:].max() < 0.01


def test_a_gap_of_minutes_is_bridged_by_the_landmarks():
    data = drive(20)
    backend = SmootherBackend(RIG, MODELS)
    known: set[int] = set()
    for stamp, _, seen in data:
        step(backend, stamp, seen, known)
    prediction = backend.predict(300.0)
    assert np.isfinite(prediction.covariance).all() and np.isfinite(prediction.innovation).all()
    last = data.observations[-1]
    again = last.select(np.isin(last.ids, list(known)))
    report = backend.update(again, guess=data.poses[-1])
    assert report.status is UpdateStatus.OK and len(report.used) > 10
    moved, turned = errors(backend.estimate().T_world_left, data.poses[-1])
    assert moved < 0.05 and turned < 0.01


def loop(laps: float, frames_a_lap: int):
    """Poses (F, 4, 4) around a circle, looking outwards, and the points (N, 3) around it."""
    around = np.linspace(0, 2 * np.pi * laps, round(laps * frames_a_lap) + 1)
    poses = np.array(
        [se3.exp(np.array([0, a, 0, 0, 0, 0])) @ se3.pose(np.eye(3), np.array([0, 0, 3.0])) for a in around]
    )
    rng = np.random.default_rng(3)
    angle, distance = rng.uniform(0, 2 * np.pi, 500), rng.uniform(8, 14, 500)
    points = np.stack([distance * np.sin(angle), rng.uniform(-3, 3, 500), distance * np.cos(angle)], axis=1)
    return se3.inverse(poses[0]) @ poses, se3.transform(se3.inverse(poses[0]), points)


@pytest.mark.slow
def test_landmarks_seen_again_tie_the_trajectory_together():
    frames = 90
    poses, points = loop(1.15, frames)
    models = EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=1.0)
    ends, deviations = [], []
    for known_again in (False, True):
        backend, known = SmootherBackend(RIG, models), set()
        rng = np.random.default_rng(1)
        for k, T in enumerate(poses):
            seen = observe(T, points, 1.0, rng, limit=12)
            if k > frames // 2 and not known_again:  # the same landmarks under other names
                seen = Observations(seen.ids + 1000, seen.uv_left, seen.uv_right)
            step(backend, DT * k, seen, known)
        ends.append(errors(backend.trajectory().poses, poses)[0][-1])
        deviations.append(np.sqrt(np.trace(backend.estimate(landmarks=False).covariance[3:, 3:])))
    assert ends[1] < 0.5 * ends[0], f"the end is off by {ends[1]:.3f} m with, {ends[0]:.3f} m without revisits"
    assert deviations[1] < 0.5 * deviations[0], "the smoother knows that it knows better"


@pytest.mark.slow
def test_a_fixed_lag_keeps_the_path_and_bounds_the_problem():
    data = drive(80, points=400)
    full, lagged = SmootherBackend(RIG, MODELS, lag=None), SmootherBackend(RIG, MODELS, lag=15, window=10, explicit=30)
    run(full, data)
    known: set[int] = set()
    sizes = []
    for stamp, _, seen in data:
        assert step(lagged, stamp, seen, known).status in (UpdateStatus.OK, UpdateStatus.EMPTY)
        sizes.append(lagged._graph.solver.values().size())
    assert max(sizes[40:]) <= max(sizes[20:40]) + 10, "the number of variables does not grow"
    assert full._graph.solver.values().size() > sizes[-1] + 60, "poses and landmarks have left"
    ours, theirs = (errors(b.trajectory().poses, data.poses)[0] for b in (lagged, full))
    assert len(ours) == 80
    rms = [float(np.sqrt(np.mean(e**2))) for e in (ours, theirs)]
    assert rms[0] < 1.5 * rms[1] + 0.005, f"{rms[0]} m with a lag, {rms[1]} m without"
    P, Q = (b.estimate(landmarks=False).covariance for b in (lagged, full))
    # What was marginalised keeps its information: the end is known about as well.
    assert 0.7 < np.trace(P[3:, 3:]) / np.trace(Q[3:, 3:]) < 1.5


def test_landmarks_in_the_map_outlast_the_lag():
    poses, points = loop(1.15, 90)
    models, known = EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=1.0), set()
    backend, rng = SmootherBackend(RIG, models, lag=20), np.random.default_rng(1)
    for k, T in enumerate(poses):
        step(backend, DT * k, observe(T, points, 1.0, rng, limit=12), known)
        if k == 60:
            marks = backend.measurement_log.landmarks
            first = [
                i for i in known if marks.last[marks.slots([i])[0]] < 15 and marks.variable[marks.slots([i])[0]] >= 0
            ]
    assert first, "landmarks that were last seen long before the lag are still variables"
    # As with all poses: see the test on landmarks that are seen again.
    assert errors(backend.estimate().T_world_left, poses[-1])[0] < 0.1
    backend.remove(first)
    known.difference_update(first)
    for k in range(10):
        step(backend, DT * (len(poses) + k), observe(poses[-1], points, 1.0, rng, limit=12), known)
    keys = set(backend._graph.solver.values().keys())
    assert all(key in keys for key in backend.measurement_log.landmarks.variable.tolist() if key >= 0)


def test_a_landmark_that_left_the_lag_may_be_seen_again():
    poses = path(12, DT, np.array([0.0, 0.0, 0.3]), np.zeros(3))
    there_and_back = np.concatenate([poses, np.repeat(poses[-1:], 30, axis=0), poses[::-1]])
    data = scene(there_and_back, points=80, limit=60)
    backend = SmootherBackend(RIG, MODELS, lag=14, track=4)
    known: set[int] = set()
    for k, (stamp, _, seen) in enumerate(data):
        if 12 <= k < 42:
            seen = seen.select(np.arange(len(seen)) % 2 == 0)
        assert step(backend, stamp, seen, known).status in (UpdateStatus.OK, UpdateStatus.EMPTY)
    moved, turned = errors(backend.trajectory().poses, data.poses)
    assert moved.max() < 0.05 and turned.max() < 0.01
    keys = backend.measurement_log.history.explicit
    assert len({key for key in backend.measurement_log.landmarks.variable.tolist() if key >= 0} - set(keys)) == 0


def test_the_lag_is_not_shorter_than_the_window():
    with pytest.raises(ConfigurationError, match="lag"):
        SmootherBackend(RIG, MODELS, lag=5, window=10)


def off_by(seen: Observations, offset: float) -> Observations:
    """Observations with right pixels moved along the row."""
    return Observations(seen.ids, seen.uv_left, seen.uv_right + np.array([offset, 0.0]))


@pytest.mark.parametrize("options", [{}, {"explicit": 0}, {"lag": 15}], ids=str)
def test_right_pixels_are_mended_afterwards(options):
    data = drive(24, points=200)
    right, mended, spoilt = (SmootherBackend(RIG, MODELS, **options) for _ in range(3))
    known: list[set[int]] = [set(), set(), set()]
    for k, (stamp, _, seen) in enumerate(data):
        if k == 14:
            mended.revise(lambda z: z + np.array([0.0, 0.0, 0.8]))
        early = off_by(seen, -0.8) if k < 14 else seen
        for backend, ids, given in zip((right, mended, spoilt), known, (seen, early, early)):
            step(backend, stamp, given, ids)
    truth = right.trajectory().poses
    distances = [errors(b.trajectory().poses, truth)[0].max() for b in (mended, spoilt)]
    # The same measurements; where the lag has left a pose behind, it is linearised where it stood then, and the gate
    # had let other measurements pass.
    assert distances[0] < (0.003 if options else 1e-4) < distances[1], distances
    ours, theirs = mended.estimate(), right.estimate()
    np.testing.assert_array_equal(ours.ids, theirs.ids)
    off = np.linalg.norm(ours.positions - theirs.positions, axis=1)
    deviations = np.sqrt(np.trace(theirs.covariances, axis1=1, axis2=2))
    assert np.median(off / deviations) < 0.05


def test_a_small_change_of_all_measurements_takes_one_step(monkeypatch):
    def no_small_step(_):
        raise SolverError("none")

    data, solved, poses = drive(20, points=150), [], []
    monkeypatch.setattr(factor_graph, "optimise", lambda change: solved.append(1) or rebuild.optimise(change))
    for whole in (False, True):
        if whole:
            monkeypatch.setattr(factor_graph, "stepped", no_small_step)
        backend = SmootherBackend(RIG, MODELS)
        run(backend, data)
        before = backend.trajectory().poses
        backend.revise(lambda z: z + np.array([0.0, 0.0, 0.2]))
        assert len(solved) == whole
        poses.append(backend.measurement_log.path.poses.copy())
    moved, apart = errors(poses[0], before)[0].max(), errors(*poses)[0].max()
    assert moved > 0.01 and apart < 0.01 * moved


def test_mending_needs_nothing_to_mend():
    backend = SmootherBackend(RIG, MODELS)
    backend.revise(lambda z: z)
    backend.predict(0.0)
    backend.revise(lambda z: z)
    backend.add(next(iter(drive(2)))[2])
    with pytest.raises(MeasurementError, match="finite"):
        backend.revise(lambda z: z + np.nan)


def test_no_two_landmarks_share_a_variable(monkeypatch):
    # A measurement that is taken back may take the landmark's variable with it; its name is not given out again.
    data, given = drive(30), []
    original = factor_builder.landmark_key
    monkeypatch.setattr(factor_builder, "landmark_key", lambda *a: given.append(original(*a)) or given[-1])
    backend = SmootherBackend(RIG, MODELS, track=3, explicit=20)
    known: set[int] = set()
    for k, (stamp, _, seen) in enumerate(data):
        step(backend, stamp, seen, known)
        if k % 5 == 4:
            slots = np.flatnonzero(backend.measurement_log.landmarks.variable >= 0)[:3]
            for slot, key in zip(slots, backend.measurement_log.landmarks.variable[slots].tolist()):
                rows = np.array(backend.measurement_log.history.explicit[key])
                for row in rows[::-1]:
                    backend.measurement_log.take_back(np.array([slot]), np.array([row]))
            backend._graph.recover()
    numbers = [gtsam.symbolIndex(key) for key in given]
    assert len(numbers) > 20 and len(set(numbers)) == len(numbers)


def test_the_path_that_is_asked_for_is_solved_to_the_last():
    data = drive(40, points=300)
    loose, tight = (SmootherBackend(RIG, MODELS, relinearise=px) for px in (0.3, 0.001))
    run(loose, data)
    run(tight, data)
    before = errors(loose.measurement_log.path.poses, tight.measurement_log.path.poses)[0].max()
    after = errors(loose.trajectory().poses, tight.trajectory().poses)[0].max()
    assert after < 0.1 * before and after < 2e-4, (before, after)
    assert loose.estimate().covariance.shape == (6, 6)
    np.testing.assert_array_equal(loose.trajectory().poses, loose.trajectory().poses)


def test_time_in_the_solver_is_told():
    backend = SmootherBackend(RIG, MODELS)
    before = backend.solver_seconds
    run(backend, drive(5))
    assert backend.solver_seconds > before >= 0
