"""Regions that are followed until they have moved by their own size: tracks come and go, the region stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.objects.candidates import Candidate, MovingTracks, follow_candidates, region_radius
from slam.objects.tracks import ConstantVelocity

DT, SIZE, SPEED = 0.1, 2.0, 1.0
EXACT = np.zeros((3, 3))  # covariance by the camera's pose
VELOCITY = np.array([0.5, 0.0, 5.0])


def tracks_of(points, velocities, ids, rng, still=()):
    """Tracks whose places are known to 0.1 m and velocities to 0.5 m/s; those at `still` are fixed points."""
    n = len(points)
    velocities = velocities + 0.2 * rng.standard_normal((n, 3))
    test = np.full(n, 50.0)
    test[list(still)] = 1.0
    motion = ConstantVelocity(
        points, np.tile(0.01 * np.eye(3), (n, 1, 1)), velocities, np.tile(0.25 * np.eye(3), (n, 1, 1)), test
    )
    depth, noise = np.full(n, 20.0), np.full(n, 0.5)
    return MovingTracks.of(np.arange(n), np.asarray(ids), motion, depth, noise, SIZE, SPEED)


def run(frames, place, velocity, rng, around=0):
    """Three tracks at a time, each for two frames, at a region's place by frame; `around` still points inside it."""
    candidates: list[Candidate] = []
    for k in range(frames):
        ids = [*(100 * (k // 2) + np.arange(3)), *range(10_000, 10_000 + around)]
        points = place(k) + rng.uniform(-0.5, 0.5, (3 + around, 3))
        velocities = np.concatenate([np.tile(velocity, (3, 1)), np.zeros((around, 3))])
        tracks = tracks_of(points, velocities, ids, rng, still=range(3, 3 + around))
        candidates = follow_candidates(candidates, tracks, DT, 2.0)
        yield candidates


def test_short_tracks_on_a_moving_region_make_a_body_once_it_has_moved_by_its_size():
    rng, start = np.random.default_rng(0), np.array([5.0, 0, 20])
    steps = list(run(10, lambda k: start + k * DT * VELOCITY, VELOCITY, rng))
    assert all(len(candidates) == 1 for candidates in steps)
    bodies = [candidates[0].is_body(SPEED, EXACT) for candidates in steps]
    moved = DT * np.linalg.norm(VELOCITY) * np.arange(10)
    assert not any(bodies[k] for k in range(10) if moved[k] < 1.5)
    assert bodies[-1]
    assert steps[-1][0].state[3:] == pytest.approx(VELOCITY, abs=0.5)
    assert len(steps[-1][0].supporters) == 15


def test_what_moves_in_any_case_does_not_contradict_a_region():
    """Depths of a track may jump; it says little against the region's motion that explains far more than stillness."""
    rng, place = np.random.default_rng(3), np.array([5.0, 0, 20])
    candidates = list(run(1, lambda k: place, VELOCITY, rng))[-1]
    for test, contradicts in ((1000.0, 0), (20.0, 1)):
        points = place + DT * VELOCITY + np.zeros((4, 3))
        motion = tracks_of(points, np.array([*[VELOCITY] * 3, 2 * VELOCITY]), [0, 1, 2, 9], rng)
        motion.motion.test[3] = test
        (after, *_) = follow_candidates(candidates, motion, DT, 2.0)
        assert after.contradicting == contradicts


def test_false_velocities_of_what_stands_still_make_none():
    rng, start = np.random.default_rng(1), np.array([5.0, 0, 20])
    for candidates in run(30, lambda k: start, VELOCITY, rng):
        assert not any(candidate.is_body(SPEED, EXACT) for candidate in candidates)


def test_a_region_with_as_many_still_points_inside_makes_none():
    rng, start = np.random.default_rng(2), np.array([5.0, 0, 20])
    for candidates in run(12, lambda k: start + k * DT * VELOCITY, VELOCITY, rng, around=4):
        assert not any(candidate.is_body(SPEED, EXACT) for candidate in candidates)


def test_where_depth_is_noisier_than_the_region_nothing_is_followed():
    rng = np.random.default_rng(3)
    tracks = tracks_of(rng.uniform(0, 1, (5, 3)), np.tile(VELOCITY, (5, 1)), range(5), rng)
    far = MovingTracks.of(tracks.rows, tracks.ids, tracks.motion, np.full(5, 60.0), np.full(5, 6.5), SIZE, SPEED)
    assert len(tracks.rows) == 5 and not len(far.rows)
    assert region_radius(60.0, SIZE) == pytest.approx(3.0) and region_radius(5.0, SIZE) == 1.0


def test_the_error_of_the_camera_is_no_motion():
    rng, start = np.random.default_rng(0), np.array([5.0, 0, 20])
    (region,) = list(run(10, lambda k: start + k * DT * VELOCITY, VELOCITY, rng))[-1]
    assert region.is_body(SPEED, EXACT) and not region.is_body(SPEED, 4.0 * np.eye(3))


def test_tracks_from_everywhere_are_no_region():
    """After a long gap the region may be anywhere; what then agrees with its motion does not lie in it."""
    rng, place = np.random.default_rng(4), np.array([5.0, 0, 20])
    candidates = list(run(2, lambda k: place + k * DT * VELOCITY, VELOCITY, rng))[-1]
    gap = 20.0  # [s]
    points = place + gap * VELOCITY + rng.uniform(-1, 1, (60, 3)) * np.array([8.0, 3.0, 8.0])
    tracks = tracks_of(points, np.tile(VELOCITY, (60, 1)), np.arange(900, 960), rng)
    (after, *_) = follow_candidates(candidates, tracks, gap, 2.0)
    away = np.linalg.norm(points - after.state[:3], axis=1)
    assert len(after.members) < 6 and (away[after.members] < 2 * SIZE).all()


def test_a_region_that_takes_up_other_still_tracks_has_not_gone_there_by_its_velocity():
    """It is found 0.3 m farther in every frame, where other tracks are; its velocity takes it half as far."""
    rng = np.random.default_rng(5)
    steps = list(run(12, lambda k: np.array([5.0 + 0.3 * k, 0, 20]), np.array([1.5, 0.0, 0.0]), rng))
    (candidate,) = [c for c in steps[-1] if c.frames == 12]
    assert np.linalg.norm(candidate.state[:3] - candidate.start) > 2 * candidate.radius
    assert not candidate.may_be_body(SPEED)
    assert replace(candidate, way=candidate.state[:3] - candidate.start).may_be_body(SPEED)
