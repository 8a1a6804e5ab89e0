"""Who belongs to a body: on tables of tracks whose points and motions are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.bodies import membership
from slam.bodies.bodies import PROOF, Body, continued, new_body, with_evidence, with_extent
from slam.bodies.config import CLEAR, ObjectsConfig
from slam.bodies.fits import fit_positions
from slam.bodies.membership import merge
from slam.geometry.se3 import Array, exp, transform
from slam.tracks.table import Tracks
from tests.slam.scene import features_at

WINDOW = 12
SLOT = WINDOW - 1
SIGMA = 0.002  # [m]
FRAME: Any = SimpleNamespace(setup=SimpleNamespace(config=ObjectsConfig()), slot=SLOT, eye=np.zeros(3))
TIMES = (np.arange(WINDOW) - SLOT) / 30.0


def table(seen: Array) -> Tracks:
    """Tracks that measured the points (N, W, 3) in world coordinates, one slot a frame."""
    n = len(seen)
    features = features_at(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 16), np.float32))
    tracks, rows = Tracks.empty(16, WINDOW), np.arange(n)
    tracks.row[rows] = rows
    tracks.begin(rows, rows, features, seen[:, 0])
    for slot in range(WINDOW):
        enter(tracks, rows, slot, seen[:, slot])
    fit_positions(tracks, rows)
    return tracks


def enter(tracks: Tracks, rows: Array, slot: int, points: Array) -> None:
    """Tracks measured points in a slot."""
    tracks.p[rows, slot] = points - tracks.anchor[rows]
    tracks.A[rows, slot], tracks.dof[rows, slot] = np.eye(3) / SIGMA**2, 3


def path(velocity: Array) -> Array:
    """Poses (W, 4, 4) of a body with an even twist [ω, v] (6,), the last one 1 m before the camera."""
    poses = exp(TIMES[:, None] * velocity)
    poses[:, 2, 3] += 1.0
    return poses


def seen_from(poses: Array, local: Array, seed: int) -> Array:
    """Measured points (N, W, 3) of points (N, 3) that go with poses (W, 4, 4)."""
    points = np.stack([transform(T, local) for T in poses], axis=1)
    return points + SIGMA * np.random.default_rng(seed).standard_normal(points.shape)


def body_along(poses: Array, members: Array, tracks: Tracks, id: int = 1) -> Body:
    """A settled body with these poses whose members are these rows."""
    body = new_body(id, poses[SLOT, :3, 3], np.zeros(6), TIMES, 0.0, 0.0)
    body = replace(body, T=poses[SLOT], history=poses, seen=50, certain=PROOF)
    membership.add_members(body, tracks, members, sure=True)
    return with_extent(body, tracks.local[members])


def corners(n: int, seed: int, lid: int = 0) -> Array:
    """Points (n, 3) of a body; the last `lid` of them lie well off its x axis."""
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (n, 3))
    points[n - lid :, 1] = 0.15
    return points


STILL = np.tile(np.eye(4), (WINDOW, 1, 1))
AHEAD = np.array([0.0, 0.0, 1.0])


MOVING = np.array([0.0, 0.4, 0.0, 0.3, 0.0, 0.0])
LID = np.array([1.2, 0.4, 0.0, 0.3, 0.0, 0.0])  # turns about the body's x axis besides


def test_a_part_that_turns_otherwise_leaves_and_comes_back_only_on_proof() -> None:
    local = corners(16, 1, lid=4)
    poses = path(MOVING)
    seen = np.concatenate([seen_from(poses, local[:12], 2), seen_from(path(LID), local[12:], 3)])
    tracks = table(seen)
    body = body_along(poses, np.arange(16), tracks)
    gains, against = membership.update_members({1: body}, FRAME, tracks)[1]
    lid = np.arange(12, 16)
    assert (tracks.body[:12] == 1).all()
    assert (tracks.body[lid] == -1).all() and tracks.expelled[lid].all()
    assert len(gains) == 12 and against == 0
    enter(tracks, lid, SLOT, seen[lid, SLOT])
    membership.update_members({1: body}, FRAME, tracks)
    assert (tracks.body[lid] == -1).all()


@pytest.mark.parametrize(
    ("still", "behind", "certain", "solid"),
    [(0, 0, 0, True), (6, 0, 0, True), (12, 0, 0, False), (12, 1, 0, False), (12, 1, PROOF, True)],
)
def test_what_encloses_points_that_stand_still_is_no_body(still: int, behind: int, certain: int, solid: bool) -> None:
    """The shadow of somebody who walks: the ground shows within it; a body not proven yet shows nothing behind it."""
    poses = path(MOVING)
    ground = 0.6 * corners(12, 4) + poses[SLOT, :3, 3] + behind * AHEAD
    ground[still:, 0] += 0.5  # the others lie beside the body
    tracks = table(np.concatenate([seen_from(poses, corners(16, 1), 2), seen_from(STILL, ground, 3)]))
    body = replace(body_along(poses, np.arange(16), tracks), certain=certain)
    gains, against = membership.update_members({1: body}, FRAME, tracks)[1]
    assert against == (0 if behind and certain else still)
    after = with_evidence(replace(body, certain=PROOF), 0.0, int((gains > CLEAR).sum()), against)
    assert after.proven == solid


@pytest.mark.parametrize(
    ("velocity", "off", "one"),
    [(MOVING, 0.0, True), (MOVING, 0.01, True), (1.15 * MOVING, 0.0, False), (LID, 0.0, False)],
)
@pytest.mark.parametrize("seen", [20, 5])
def test_bodies_are_one_only_where_they_move_as_one(velocity: Array, off: float, one: bool, seen: int) -> None:
    """Though the poses of one are `off` [m]; a fresh one is no more than a part of what it lies in."""
    local, poses = corners(16, 4, lid=6), path(MOVING)
    tracks = table(np.concatenate([seen_from(poses, local[:10], 5), seen_from(path(velocity), local[10:], 6)]))
    poses[:, :3, 3] += off * np.random.default_rng(10).standard_normal((WINDOW, 3))
    bodies = {1: body_along(poses, np.arange(10), tracks)}
    bodies[2] = replace(body_along(path(velocity), np.arange(10, 16), tracks, id=2), seen=seen)
    merge(bodies, tracks)
    assert list(bodies) == ([1] if one or seen == 5 else [1, 2])


def test_a_body_seen_again_is_known_by_its_place_and_velocity() -> None:
    tracks = table(seen_from(path(MOVING), corners(8, 12), 13))
    body = body_along(path(MOVING), np.arange(8), tracks)
    body = replace(
        body, measured=False, velocity=MOVING, covariance=0.01 * np.eye(6), velocity_covariance=0.01 * np.eye(6)
    )
    vague = replace(body, covariance=10.0 * np.eye(6))
    far = new_body(2, body.middle + np.array([1.0, 0, 0]), MOVING, TIMES, 0.1, 0.1)
    assert membership.reappeared({1: vague}, far, 1.5) is None, "not faster than bodies are"
    assert membership.reappeared({1: vague}, replace(far, seen_at=1.0), 1.5) is vague
    for shift, velocity, same in ((0.1, 0.3, True), (1.0, 0.3, False), (0.1, 1.5, False)):
        new = new_body(
            2, body.middle + shift * np.array([1.0, 0, 0]), np.array([0, 0, 0, velocity, 0, 0]), TIMES, 0.0, 0.1
        )
        assert (membership.reappeared({1: body}, new, 1.5) is body) == same
        gone = replace(body, missed=2, apart_from=7)
        assert membership.reappeared({1: gone}, new, 1.5) is None, "it may be anywhere"
        assert (membership.reappeared({1: gone}, new, 1.5, whole=7) is gone) == same
        assert membership.reappeared({1: gone}, new, 1.5, whole=8) is None
        assert membership.reappeared({1: replace(body, measured=True)}, new, 1.5) is None
    again = continued(new_body(2, body.middle, MOVING, TIMES, 0.0, 0.1), body)
    assert again.id == 1
    assert np.allclose(again.T, body.T), "the frame goes on"


def test_only_tracks_that_surely_went_with_the_body_tell_its_extent() -> None:
    """Still features behind a body that rests may count as its own; they must not make it larger."""
    local = np.concatenate([corners(8, 9), [[0.12, 0.0, 0.0]]])
    still = np.tile(path(MOVING)[SLOT], (WINDOW, 1, 1))
    tracks = table(seen_from(still, local, 10))
    body = body_along(still, np.arange(8), tracks)
    membership.update_members({1: body}, FRAME, tracks)
    assert tracks.sure[:8].all() and not tracks.sure[8]


@pytest.mark.parametrize(("sure", "moving", "kept"), [(True, False, True), (False, False, False), (True, True, False)])
def test_a_body_at_rest_before_a_standing_camera_keeps_what_has_moved_with_it(
    sure: bool, moving: bool, kept: bool
) -> None:
    """What stays at its pixels belongs to a body that rests, if its motion with it was certain before."""
    still = np.tile(path(MOVING)[SLOT], (WINDOW, 1, 1))
    tracks = table(seen_from(still, corners(8, 9), 10))
    body = replace(body_along(still, np.arange(8), tracks), moving=moving)
    tracks.still[:8], tracks.sure[:8] = True, sure
    membership.update_members({1: body}, FRAME, tracks)
    assert (tracks.body[:8] == (1 if kept else -1)).all()


@pytest.mark.parametrize(("velocity", "same"), [(MOVING, True), (LID, False)])
def test_a_part_that_has_moved_apart_is_never_merged_again(velocity: Array, same: bool) -> None:
    """A lid rests on its box for as long as it likes; a piece that never moved otherwise is the body's."""
    local = corners(16, 4, lid=6)
    poses, rows = path(MOVING), np.arange(10, 16)
    tracks = table(np.concatenate([seen_from(poses, local[:10], 5), seen_from(path(velocity), local[10:], 6)]))
    bodies = {1: body_along(poses, np.arange(10), tracks), 2: body_along(path(velocity), rows, tracks, id=2)}
    bodies[2] = replace(bodies[2], apart_from=1)
    merge(bodies, tracks)
    assert bodies[2].distinct == (frozenset() if same else {1})
    at_rest = table(seen_from(poses, local, 7))
    bodies[2] = replace(bodies[2], alike=100, history=poses)
    at_rest.body[:16] = np.where(np.arange(16) < 10, 1, 2)
    at_rest.local[:16], at_rest.local_information[:16] = tracks.local[:16], tracks.local_information[:16]
    merge(bodies, at_rest)
    assert list(bodies) == ([1] if same else [1, 2])
