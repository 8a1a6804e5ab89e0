"""Where measurements say little, back ends that assume the same still say the same, and how unsure they are."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from backends.smoother.landmarks import SmootherLandmarks
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import RIG, path, scene, step

MODELS = EstimatorModels(
    MotionModel(0.3, 0.3), pixel_sigma=0.05, initial_position_sigma=1e-6, initial_rotation_sigma=1e-7
)
OTHERS = [name for name in backends.names() if name != "ekf"]


def made(name: str, rig: StereoRig):
    return backends.create(name, rig, models=MODELS)


def deviations(backend) -> np.ndarray:
    return np.sqrt(np.diag(backend.estimate().covariance))


@pytest.mark.parametrize("name", OTHERS)
def test_frames_that_see_nothing_at_uneven_times_leave_the_same_uncertainty(name):
    """The motion model alone: its derivatives by both earlier poses count, and the lengths of the intervals."""
    data = scene(path(6, 0.1, np.array([0.05, 0.0, 0.3]), np.array([0.0, 0.05, 0.0])), 60, 0.05, limit=20)
    filtered, other = (made(each, RIG) for each in ("ekf", name))
    for backend in (filtered, other):
        known: set[int] = set()
        for stamp, _, seen in data:
            step(backend, stamp, seen, known)
        for stamp in (0.75, 0.85, 1.35):
            backend.predict(stamp)
            backend.update(data.observations[-1].select(np.zeros(0, int)))
    np.testing.assert_allclose(deviations(other), deviations(filtered), rtol=0.02)
    off = se3.log(se3.inverse(filtered.estimate().T_world_left) @ other.estimate().T_world_left)
    assert np.abs(off / deviations(filtered)).max() < 0.02


@pytest.mark.parametrize("dark", [{4}, {3}, {3, 4}], ids=str)
def test_few_landmarks_after_dark_frames_leave_the_optimums_uncertainty(dark):
    """The velocity before a gap counts once: the smoother was as sure as 0.72 of the deviations with two landmarks."""
    data, found = scene(path(7, 0.1, np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.02, 0.0])), 60, seed=3), []
    for name in ("batch", "smoother", "window"):
        backend = backends.create(name, RIG, models=EstimatorModels(MotionModel(0.1, 0.1), pixel_sigma=0.5))
        known = data.observations[0].ids
        for k, (stamp, _, seen) in enumerate(data):
            backend.predict(stamp)
            if not k:
                backend.add(seen)
                continue
            seen = seen.select(np.arange(len(seen)) < (0 if k in dark else 2 if k > 4 else len(seen)))
            backend.update(seen.select(np.isin(seen.ids, known)))
        found.append(deviations(backend))
    for others in found[1:]:
        assert (others / found[0] > 0.98).all() and (others / found[0] < 1.06).all(), others / found[0]


def test_drift_adds_up_while_a_landmark_is_not_seen():
    none, certain = np.zeros((1, 3, 3)), 1e-4 * np.eye(3)[None]
    marks = SmootherLandmarks.of(
        np.array([0]), 0, np.array([[0.0, 0.0, 5.0]]), certain, none, False, np.zeros((1, 3, 0))
    )
    unseen, drift = np.zeros(0, np.intp), np.diag([1e-6, 2e-6, 3e-6, 1e-5, 2e-5, 3e-5])
    once = marks.left_behind(unseen, np.eye(4), drift)
    twice = once.left_behind(unseen, np.eye(4), drift)
    assert np.trace(once.away[0]) > 1e-5
    np.testing.assert_allclose(twice.away, 2 * once.away)
    np.testing.assert_allclose(twice.from_newest, certain + twice.away)
