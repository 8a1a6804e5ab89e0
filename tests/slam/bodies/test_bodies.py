"""How the detector predicts a body: by the bodies' own motion model, not by the camera's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.bodies.belief import EVEN, when_measured, when_missed
from slam.bodies.bodies import PROOF, hidden, new_body, reported
from slam.bodies.config import ObjectsConfig
from slam.bodies.detector import MovingObjectDetector
from slam.data import Estimate, StereoFeatures
from slam.models import EstimatorModels, MotionModel, ObjectModels
from slam.tracks.table import Tracks
from tests.slam.bodies.test_recovery import scene
from tests.slam.scene import RIG

HERE = Estimate(0.0, np.eye(4), np.eye(6), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


def test_a_body_is_predicted_by_its_own_motion_model() -> None:
    models = EstimatorModels(
        motion=MotionModel(acceleration=50.0, angular_acceleration=70.0),
        objects=ObjectModels(acceleration=2.0, angular_acceleration=0.5),
    )
    detector, dt = MovingObjectDetector(RIG, ObjectsConfig(), models), 0.1
    tracks = Tracks.empty(64, detector.window)
    detector.step(None, tracks, StereoFeatures.empty(0.0), HERE)
    times = np.zeros(detector.window)
    body = new_body(1, np.array([0, 0, 3.0]), np.array([0, 0.2, 0, 1.0, 0, 0]), times, 0.0, 0.1)
    detector.bodies[1] = body
    detector.step(None, tracks, StereoFeatures.empty(dt), replace(HERE, stamp=dt))
    grown = np.diag(detector.bodies[1].covariance - body.covariance)
    np.testing.assert_allclose(grown, dt**3 * np.array([0.5] * 3 + [2.0] * 3) ** 2, rtol=1e-9)
    np.testing.assert_allclose(detector.bodies[1].T[:3, 3], [dt, 0, 3.0])


def test_points_behind_a_body_are_hidden_and_no_others():
    body = new_body(1, np.array([0.0, 0.0, 2.0]), np.zeros(6), np.zeros(3), 0.0, 0.0)
    body = replace(body, lower=np.full(3, -0.1), upper=np.full(3, 0.1))
    behind, inside, before, beside = [0.05, 0, 3.0], [0, 0, 2.05], [0, 0, 1.0], [0.5, 0, 3.0]
    points = np.array([behind, inside, before, beside])
    assert hidden([body], np.zeros(3), points).tolist() == [True, False, False, False]
    assert not hidden([], np.zeros(3), points).any()


def test_existence_follows_bayes_rule():
    """Of 100 bodies 90 exist; where there is one it is seen in 8 of 10 frames: 18 of 28 unseen ones exist."""
    assert when_missed(0.9, seen=7, age=8) == pytest.approx(18 / 28)
    assert when_measured(EVEN, gain=8.0) > 0.95 and when_measured(EVEN, gain=0.0) < 0.7  # at rest it shows little
    assert when_measured(0.999999, gain=1e6) < 1.0  # and never so certain that it could not be forgotten


@pytest.mark.parametrize(
    ("measured", "missed", "since", "existence", "told"),
    [
        (True, 0, 0.0, 0.3, True),
        (False, 5, 0.9, 0.6, True),
        (False, 6, 0.9, 0.6, False),  # for more than a twentieth of the frames in which it was measured
        (False, 5, 1.1, 0.6, False),  # for more than a second
        (False, 5, 0.9, 0.4, False),
    ],
)
def test_a_body_out_of_view_is_reported_for_a_short_while_only(measured, missed, since, existence, told) -> None:
    body, tracks, _, _ = scene(4, np.zeros(6), np.random.default_rng(0))
    belief = replace(body.belief, estimate=replace(body.belief.estimate, measured=measured, stamp=10.0))
    body = replace(
        body, belief=belief, certain=PROOF, seen=100, missed=missed, seen_at=10.0 - since, existence=existence
    )
    assert [(thing.measured_at, thing.existence) for thing in reported({1: body}, tracks, 1)] == (
        [(10.0 - since, existence)] if told else []
    )
