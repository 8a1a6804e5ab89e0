"""Where a body is, by the few points that are seen of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.bodies import membership
from slam.bodies.bodies import new_body, with_extent
from slam.bodies.config import ObjectsConfig
from slam.bodies.estimator import BodyEstimator
from slam.bodies.following import found_again, located
from slam.bodies.frame import Frame, Setup
from slam.data import RecentPoses
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp, transform
from slam.models import models_for
from slam.object_data import ObjectObservations
from slam.tracks.table import Tracks
from tests.slam.scene import features_at

RIG = StereoRig.rectified_pair(700.0, 620, 188, 0.54, 1241, 376)
WINDOW = 12
MODELS = models_for("driving")
ESTIMATOR = BodyEstimator(RIG, MODELS)
CAMERAS = RecentPoses(np.array([-0.1, 0.0]), np.tile(np.eye(4), (2, 1, 1)), 1e-10 * np.eye(12))
POINTS = np.array(
    [[0.3, 0.0, 0.0], [-0.3, 0.4, 0.1], [0.0, -0.6, 0.2], [0.2, 0.5, -0.1], [0.5, -0.3, 0.4], [-0.5, -0.2, -0.3]]
)


def scene(seen, off, rng, deviation=0.5):
    """A body at 15 m, predicted wrongly by `off` (6,), of which so many points are seen; and where they are.

    It was seen a tenth of a second ago; since then it has moved by a `deviation` [m].
    """
    T = np.eye(4)
    T[:3, 3] = 4.0, 0.0, 15.0
    truth = T @ exp(off)
    uv, uv_right = RIG.project(transform(truth, POINTS[:seen]))
    noise = 0.3 * rng.standard_normal((seen, 3))
    features = features_at(uv + noise[:, :2], uv_right + noise[:, [2, 1]], np.eye(seen, 64, dtype=np.float32))
    tracks = Tracks.empty(64, WINDOW)
    rows = begin(tracks, features, np.arange(seen), transform(T, POINTS[:seen]))
    body = new_body(1, T[:3, 3], np.zeros(6), np.zeros(WINDOW), 0.0, 2.0)
    body = with_extent(replace(body, covariance=np.diag([0.05**2] * 3 + [deviation**2] * 3)), POINTS)
    membership.add_members(body, tracks, rows)
    tracks.local[rows], tracks.local_information[rows] = POINTS[:seen], 1e4 * np.eye(3)
    before = ObjectObservations(
        1, np.arange(6), *RIG.project(transform(T, POINTS)), T, np.zeros(6), np.repeat([0.5, 10 * deviation], 3)
    )
    first = RecentPoses(np.array([-0.1]), np.eye(4)[None], 1e-10 * np.eye(6))
    body = replace(body, belief=ESTIMATOR.updated(None, 1, before, first))
    return body, tracks, features, truth


def begin(tracks, features, rows, points):
    """Tracks of features (K,) at points (K, 3); their rows in the table."""
    at = np.flatnonzero(~tracks.used)[: len(rows)]
    tracks.row[at] = rows
    tracks.begin(at, at, features, points)
    return at


def frame_of(features, max_speed=40.0):
    """The frame of some features, with the camera at the world's origin."""
    setup = Setup(RIG, ObjectsConfig(max_speed=max_speed), MODELS.objects, MODELS.pixel_sigma)
    stamps = np.concatenate([[-0.1, 0.0], np.full(WINDOW - 2, np.nan)])
    local = RIG.triangulate(features.uv_left, features.uv_right)
    return Frame(setup, 1, features, local, stamps, np.tile(np.eye(4), (WINDOW, 1, 1)), CAMERAS)


def place(body, tracks, features):
    """Its pose after the frame, None where it was not measured."""
    belief = located(body, tracks, frame_of(features), ESTIMATOR)
    return belief.estimate.T_world_object if belief.estimate.measured else None


@pytest.mark.parametrize("seen", [2, 3])
def test_few_points_move_a_body_but_do_not_turn_it_wildly(seen):
    off = np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.4])
    body, tracks, features, truth = scene(seen, off, np.random.default_rng(seen))
    T = place(body, tracks, features)
    assert T is not None
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 0.25
    assert np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) < 3.0


@pytest.mark.parametrize(
    ("seen", "deviation", "turn", "measured"),
    [(2, 0.5, 0.05, True), (2, 0.5, 1.0, False), (3, 0.5, 1.0, True), (3, 2.0, 0.05, False), (4, 2.0, 0.05, True)],
)
def test_the_less_is_known_of_a_body_the_more_points_must_agree(seen, deviation, turn, measured):
    """It may be where it is expected, turned by a radian, or anywhere."""
    body, tracks, features, _ = scene(seen, np.zeros(6), np.random.default_rng(6), deviation)
    body = replace(body, covariance=np.diag([turn**2] * 3 + [deviation**2] * 3))
    assert (place(body, tracks, features) is not None) == measured


@pytest.mark.parametrize("wrong", [0, 1, 3])
def test_a_body_that_may_be_anywhere_is_recognised_if_most_of_its_points_agree(wrong):
    """It has gone and turned where nobody looked; some descriptors are those of other points."""
    off = np.array([0.1, 0.5, -0.2, -3.0, 0.5, 4.0])
    body, tracks, features, truth = scene(6, off, np.random.default_rng(7))
    body = replace(body, seen_at=-0.2)
    features.descriptors[:wrong] = np.roll(features.descriptors[:wrong], 1, axis=0)
    if wrong == 1:
        features.descriptors[0] = np.ones(64) / 8.0
    tracks.row[:] = -1
    T = found_again(body, tracks, frame_of(features))
    if wrong == 3:  # of six
        assert T is None and (tracks.row < 0).all()
        return
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 0.1
    assert np.degrees(np.arccos((np.trace(T[:3, :3].T @ truth[:3, :3]) - 1) / 2)) < 2.0
    assert tracks.row[wrong:6].tolist() == list(range(wrong, 6))


def test_what_looks_like_a_body_farther_off_than_it_can_have_gone_is_another():
    body, tracks, features, _ = scene(6, np.array([0.0, 0.0, 0.0, -3.0, 0.5, 4.0]), np.random.default_rng(7))
    body = replace(body, seen_at=-0.1)
    tracks.row[:] = -1
    assert found_again(body, tracks, frame_of(features, max_speed=20.0)) is None
    assert found_again(body, tracks, frame_of(features, max_speed=60.0)) is not None


def test_a_point_that_disagrees_is_followed_on_and_counted():
    body, tracks, features, _ = scene(4, np.zeros(6), np.random.default_rng(5))
    features.uv_left[3] += 9.0
    features.uv_right[3] += 9.0
    tracks.row[:4] = np.arange(4)
    assert place(body, tracks, features) is not None
    assert tracks.row[:4].tolist() == [0, 1, 2, 3]
    assert tracks.misfit[:4].tolist() == [0, 0, 0, 1]
