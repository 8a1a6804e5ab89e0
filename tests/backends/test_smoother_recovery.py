"""The smoother goes on: after failures of gtsam, interrupted calls, and where the camera has lost its way."""

from functools import cache
from itertools import count

import gtsam
import numpy as np
import pytest

from backends.smoother import SmootherBackend
from backends.smoother.graph import SolverError
from slam.data import UpdateStatus
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from slam.window import pose_only
from tests.backends.scenes import RIG, observe, path, run, scene, step

MODELS = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=0.5)
DT = 0.1


def drive(frames: int = 22):
    return scene(path(frames, DT, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.03, 0.0])), points=150)


@cache
def untouched() -> SmootherBackend:
    """After the drive, in which nothing fails."""
    backend = SmootherBackend(RIG, MODELS)
    run(backend, drive())
    return backend


#: What gtsam throws.
ERRORS = [
    RuntimeError("\nIndeterminant linear system detected while working near variable\n86469 (Symbol: x5).\n"),
    KeyError("x7"),
    ValueError("removeFactorIndices: no such factor"),
]


@pytest.fixture
def break_solver(monkeypatch):
    """Makes some of the calls of a method of gtsam's smoother fail, counted over all instances."""
    real = gtsam.IncrementalFixedLagSmoother

    def set_up(method: str, calls, error: Exception) -> None:
        number = count()

        class Broken:
            def __init__(self, *arguments) -> None:
                self._solver = real(*arguments)

            def __getattr__(self, name: str):
                if name != method:
                    return getattr(self._solver, name)

                def broken(*arguments):
                    if next(number) in calls:
                        raise error
                    return getattr(self._solver, name)(*arguments)

                return broken

        monkeypatch.setattr(gtsam, "IncrementalFixedLagSmoother", Broken)

    return set_up


@pytest.mark.parametrize("method", ["update", "calculateEstimate", "getISAM2"])
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_one_failure_costs_nothing(break_solver, method, error):
    data, plain = drive(), untouched()
    break_solver(method, [11], error)
    backend = SmootherBackend(RIG, MODELS)
    reports = run(backend, data)
    assert all(r.status is UpdateStatus.OK for r in reports[1:]), "the measurements were used after the rebuild"
    said = [r.reason for r in reports[1:] if r.reason]
    assert len(said) == 1 and said[0].startswith("smoother: built anew after gtsam: ") and "\n" not in said[0]
    off = se3.log(se3.inverse(plain.trajectory().poses) @ backend.trajectory().poses)
    deviations = np.sqrt(np.diag(plain.estimate(landmarks=False).covariance))
    assert np.abs(off / deviations).max() < 0.5  # all is linearised anew, where poses are known better
    assert np.abs(off).max() < 2e-3  # [rad, m]; measured: 1.06e-3 in the worst case
    off = se3.log(se3.inverse(data.poses) @ backend.trajectory().poses)
    assert np.abs(off[:, 3:]).max() < 0.05 and np.abs(off[:, :3]).max() < 0.01
    assert np.linalg.eigvalsh(backend.estimate().covariance).min() > 0


def test_errors_of_our_own_are_not_taken_for_gtsams(monkeypatch):
    def keep(*_):
        raise KeyError("ours")

    monkeypatch.setattr("backends.smoother.tracks.Tracks.keep", keep)
    with pytest.raises(KeyError, match="ours"):
        run(SmootherBackend(RIG, MODELS), drive(5))


def test_a_near_landmark_behind_a_camera_has_the_graph_built_anew(monkeypatch):
    """gtsam takes it for no information; of a near one it says that poses are wrong."""
    data, backend, known = list(drive(12)), SmootherBackend(RIG, MODELS), set()
    run(backend, data[:-1], known)
    solve, ahead = pose_only.solve, se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0]))
    monkeypatch.setattr(pose_only, "solve", lambda *arguments: (solve(*arguments)[0] @ ahead, solve(*arguments)[1]))
    reason = step(backend, *data[-1][::2], known).reason
    assert reason == "smoother: built anew after a near landmark lies behind a camera that measured it"


# --- a camera that has lost its way is seated again among the landmarks, without a guess ---


def moved_in_the_dark(frames: int):
    """A path (F, 4, 4) that looks round once and is turned by 150 degrees in frame 70, and points all around."""
    rng = np.random.default_rng(1)
    poses = path(frames, DT, np.array([0.1, 0.0, 0.1]), np.array([0.0, 1.0, 0.0]))
    directions = rng.standard_normal((400, 3)) * (1.0, 0.3, 1.0)
    points = directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(3.0, 8.0, (400, 1))
    poses[70:] = poses[70:] @ se3.exp(np.array([0.1, 2.6, -0.2, 0.5, 0.1, 0.0]))
    return poses, points


@pytest.mark.parametrize("lag", [None, 14])
def test_a_camera_that_was_moved_while_it_saw_nothing(lag):
    """It sees nothing for three frames, and is elsewhere then."""
    poses, points = moved_in_the_dark(90)
    backend, rng, known, off, rejected = SmootherBackend(RIG, MODELS, lag=lag), np.random.default_rng(0), set(), [], []
    for k, T in enumerate(poses):
        seen = observe(T, points, 0.5, rng)
        report = step(backend, k * DT, seen.select(np.full(len(seen), not 67 <= k < 70)), known)
        off.append(se3.log(se3.inverse(T) @ backend.estimate(landmarks=False).T_world_left))
        rejected.append(len(report.rejected))
    assert sum(rejected[70:73]) > 30 and sum(rejected[74:]) < 10
    assert np.abs(off[74:]).max() < 0.05
    assert np.sqrt(np.diag(backend.estimate(landmarks=False).covariance)).max() < 0.3


def test_a_graph_that_cannot_be_built_with_landmarks_as_variables_is_built_without(monkeypatch):
    """Where that failed in a revision it failed in every later frame."""
    data, known = scene(path(60, DT, np.array([0.05, 0.0, 0.0]), np.zeros(3)), points=8, limit=8), set()
    backend = SmootherBackend(RIG, MODELS)
    run(backend, list(data)[:50], known)
    assert backend.state.landmarks.variable.any()

    def fail(*_):
        raise SolverError("gtsam: Indeterminant linear system")

    with monkeypatch.context() as patched:
        patched.setattr("backends.smoother.tracks.Tracks._make_variable", fail)
        backend.revise(lambda z: z)
        reports = [step(backend, stamp, seen, known) for stamp, _, seen in list(data)[50:]]
    assert all(report.status is UpdateStatus.OK for report in reports), reports[0].reason
    assert "built anew after gtsam: Indeterminant" in reports[0].reason
