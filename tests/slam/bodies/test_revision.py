"""A change of the rig's correction is no motion of what is seen."""

from __future__ import annotations

import numpy as np

from slam.bodies.config import ObjectsConfig
from slam.bodies.detector import MovingObjectDetector
from slam.bodies.fits import constant_velocity, revise_tracks
from slam.data import Estimate
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import inverse, transform
from slam.models import models_for
from slam.tracks.table import Tracks
from tests.slam.scene import features_at

RIG = StereoRig.rectified_pair(700.0, 620, 188, 0.54, 1241, 376)
CHANGE = 0.4  # of all disparities [px]
FRAMES, AT = 8, 5  # the correction changes before this frame
DT = 0.1
NO_LANDMARKS = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))


def mend(z):
    """Right pixels that are farther to the left."""
    return z - np.array([0.0, 0.0, CHANGE])


def seen(T, points, k):
    """What a rig sees whose disparities are too small before the change, and right after it."""
    uv, uv_right = RIG.project(transform(inverse(T), points))
    if k < AT:
        uv_right = uv_right + np.array([CHANGE, 0.0])
    return features_at(uv, uv_right, np.eye(len(points), 64, dtype=np.float32), DT * k)


def velocities(revised):
    """Velocities along the line of sight [m/s] that the tracks of still points some 40 m ahead seem to have."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-8, -2, 40], [8, 2, 50], (40, 3))
    detector = MovingObjectDetector(RIG, ObjectsConfig(max_speed=25.0, size=2.0), models_for("driving"))
    tracks = Tracks.empty(64)
    for k in range(FRAMES):
        T = np.eye(4)
        T[2, 3] = 0.8 * k
        if k == AT and revised:
            detector.revise(tracks, mend)
        features = seen(T, points, k)
        estimate = Estimate(features.stamp, T, 1e-6 * np.eye(6), *NO_LANDMARKS)
        tracks = tracks.begun(len(points), detector.window)
        detector.step(None, tracks, features, estimate)
    rows = np.flatnonzero(tracks.found)
    times = np.nan_to_num(detector._stamps - features.stamp)
    return constant_velocity(tracks, rows, times, 25.0).velocity[:, 2]


def test_tracks_stand_still_when_the_correction_changes():
    assert np.median(np.abs(velocities(revised=False))) > 1.0
    assert np.median(np.abs(velocities(revised=True))) < 0.2  # what is of second order in the change is left


def test_a_point_whose_disparity_is_rounded_off_stays_where_it_is():
    """It ended a run: nothing says how far it moves as its disparity is corrected."""
    points, first = np.array([[0.0, 0.0, 40.0], [1.0, 0.0, 1e20]]), np.arange(2)
    tracks = Tracks.empty(64, 12)
    tracks.begin(first, first, seen(np.eye(4), points, AT), points)
    revise_tracks(tracks, {}, np.tile(np.eye(4), (12, 1, 1)), 0, RIG, mend)
    assert abs(tracks.position[0, 2] - 40.0) > 1.0
    assert np.array_equal(tracks.position[1], points[1])
