"""The papers' Procedure 1, which is an experiment of ours."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.procedure1 import ObjectDatabase, body_frame, makes_a_frame, motion_of_triples
from slam.data import StereoFeatures
from slam.geometry.se3 import pose, rotation, transform
from tests.slam.scene import RIG

POINTS = np.array([[0.0, 0.1, 1.5], [0.2, 0.12, 1.55], [0.05, 0.25, 1.45], [0.15, 0.2, 1.6]])
MOTION = pose(rotation(np.radians([-35.0, -15.1, 5.8])), np.array([0.1, -0.05, 0.2]))


def features_of(points, response=(4.0, 3.0, 2.0, 1.0)):
    n, (left, right) = len(points), RIG.project(points)
    rows = np.full(n, 9.0), np.zeros(n), np.array(response), np.ones(n, np.int8)
    return StereoFeatures(0.0, left, right, *rows, np.eye(n, 16, dtype=np.float32))


def test_body_frame_and_motion_are_as_printed():
    A, B, C = POINTS[:3]
    R, y = body_frame(A, B, C), np.cross(B - A, C - A)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R[:, :2].T, [(B - A) / np.linalg.norm(B - A), y / np.linalg.norm(y)], atol=1e-12)
    moved = transform(MOTION, POINTS)
    R, translation = motion_of_triples(moved[:3], POINTS[:3], POINTS[3])
    np.testing.assert_allclose(R, MOTION[:3, :3], atol=1e-12)
    np.testing.assert_allclose(translation, moved[3] - POINTS[3], atol=1e-12)


@pytest.mark.parametrize("last", [POINTS[2], [0.4, 0.1401, 1.6001], [np.nan] * 3])  # well; on a line; without a depth
def test_an_object_is_found_by_three_points_that_make_a_frame(last):
    points = np.array([*POINTS[:2], last, POINTS[3]])
    assert makes_a_frame(points[:3]) == np.array_equal(last, POINTS[2])
    origin = POINTS[0]
    database = ObjectDatabase.of(features_of(points), np.arange(4), RIG, np.eye(4), origin)
    T = database.find(features_of(transform(MOTION, points)), RIG, np.eye(4))
    np.testing.assert_allclose(T, MOTION @ pose(np.eye(3), origin), atol=1e-9)
    assert database.find(features_of(points[:2], (2.0, 1.0)), RIG, np.eye(4)) is None
