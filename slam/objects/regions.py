"""Regions that may be a moving body: neighbouring tracks with agreeing velocities, followed over time.

A body that shows few tracks at a time, and each for a few frames only (a cyclist, a distant car), never has as many
long tracks as `slam.objects.scene` needs. Here the region is followed instead of its tracks: tracks come and go, the
region's place and velocity stay in a Kalman filter with constant velocity. A region that is followed over more than its
own size, supported all the way by tracks that move as it does, and contradicted by few inside it, cannot be still:
where velocities are wrong (false matches, depth noise) the region walks away from the tracks that made it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.data import BoolArray, IdArray, IndexArray
from slam.geometry.arrays import among
from slam.geometry.kernels import near_pairs, squared_distances
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.objects.frame import Frame
from slam.objects.tracks import AGREES, EXPLAINED, MOVES, Tracks, constant_velocity

_NEAR = 7.8  # derived: χ²(3) at 95 %, of tracks inside the region
_BEGIN = 2  # fixed: tracks that begin a region
_FRAMES = 4  # in which a region has had the tracks that fix a motion
_SHARE = 0.6  # of the tracks inside that must agree with it
_PATIENCE = 3  # frames for which a region is followed without a track
_OVERLAP = 3.0  # velocities of successive frames come from the same window: their covariance is larger by so much


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions that may move, a row each, the longest known first."""

    state: Array  # place and velocity (C, 6) in world axes [m], [m/s]
    covariance: Array  # of the state (C, 6, 6)
    start: Array  # place where each began (C, 3)
    start_covariance: Array  # its covariance (C, 3, 3)
    way: Array  # how far its velocity has taken it since it began (C, 3) [m]
    radius: Array  # of the region (C,) [m]
    frames: IdArray  # number of frames with support (C,)
    agreeing: IdArray  # number of tracks inside it so far that moved with it (C,)
    contradicting: IdArray  # and that did not (C,)
    unseen: IdArray  # number of frames without a track (C,)

    @classmethod
    def none(cls) -> Regions:
        """No region."""
        v, n = np.zeros((0, 3)), np.zeros(0, np.int64)
        return cls(np.zeros((0, 6)), np.zeros((0, 6, 6)), v, np.zeros((0, 3, 3)), v, np.zeros(0), n, n, n, n)

    def __len__(self) -> int:
        return len(self.state)

    def select(self, rows: IndexArray | BoolArray) -> Regions:
        """Some of them."""
        return Regions(*(column[rows] for column in vars(self).values()))

    def joined(self, other: Regions) -> Regions:
        """These and others."""
        pairs = zip(vars(self).values(), vars(other).values())
        return Regions(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class _Moving:
    """Tracks of a frame with their constant velocities, a row each."""

    rows: IndexArray  # in the table of tracks (N,)
    position: Array  # (N, 3) [m]
    velocity: Array  # (N, 3) [m/s]
    places: Array  # covariances (N, 3, 3) of a region's middle as each sees it
    spread: Array  # covariances (N, 3, 3) of the points in a region about each: as of a ball's
    velocities: Array  # covariances (N, 3, 3) of the velocities
    test: Array  # χ²(3) of the velocities (N,)
    radius: Array  # of the region about each (N,) [m]
    moves: BoolArray  # whether a fixed point does not explain it (N,)


def _moving_tracks(frame: Frame, tracks: Tracks) -> _Moving:
    """Free tracks whose depth is known better than to within a region."""
    s, c = frame.setup, frame.setup.config
    rows = np.flatnonzero(tracks.seen & (tracks.body < 0) & ~tracks.still)
    rows = rows[tracks.count(rows) >= c.min_frames - 1]
    m = constant_velocity(tracks, rows, frame.times, c.max_speed)
    depth = (m.position - frame.eye) @ frame.T_world_left[:3, 2]
    radius = s.radius(depth)
    k = np.flatnonzero((depth > 0) & (s.depth_noise(depth) < radius))
    spread = np.eye(3) * (radius[k] ** 2 / 3.0)[:, None, None]
    moves = (m.test[k] > MOVES) & (np.linalg.norm(m.velocity[k], axis=1) > c.min_speed)
    return _Moving(
        rows[k], m.position[k], m.velocity[k], m.covariance[k] + spread, spread, m.velocity_covariance[k], m.test[k],
        radius[k], moves,
    )  # fmt: skip


def follow_regions(r: Regions, frame: Frame, tracks: Tracks) -> tuple[Regions, list[tuple[int, IndexArray]]]:
    """Regions in this frame: known ones with the tracks that support them, and new ones of those left.

    Returns:
        the regions, and of those with tracks in this frame the index and the tracks' rows.
    """
    t = _moving_tracks(frame, tracks)
    free = t.moves.copy()
    members: list[tuple[int, IndexArray]] = []
    if len(r):
        r = _advanced(r.select(np.argsort(-r.frames, kind="stable")), frame)
        claims = _claims(r, t)
        free &= ~claims.any(axis=0)
        r, members = _supported(r, t, claims)
    new, theirs = _new_regions(t, free)
    members += [(len(r) + i, rows) for i, rows in theirs]
    return r.joined(new), members


def proven_region(r: Regions, i: int, count: int, frame: Frame) -> bool:
    """Whether a region with so many tracks in this frame has moved far enough, and for certain.

    Its velocity must have taken it that far: a region can also get there by taking up other still tracks. All that is
    seen shares the error of the camera's pose, so that does not fall with the number of tracks.
    """
    share = r.agreeing[i] > _SHARE * (r.agreeing[i] + r.contradicting[i])
    if count < MINIMAL_POINTS or r.frames[i] < _FRAMES or not share:
        return False
    moved = r.state[i, :3] - r.start[i]
    length = float(np.linalg.norm(moved))
    if min(length, float(np.linalg.norm(r.way[i]))) <= 2.0 * r.radius[i]:
        return False
    if np.linalg.norm(r.state[i, 3:]) <= frame.setup.config.min_speed:
        return False
    J = frame.T_world_left[:3, :3] @ points_by_pose(transform(inverse(frame.T_world_left), r.state[i : i + 1, :3]))[0]
    camera = J @ frame.cameras.covariance[-6:, -6:] @ J.T
    covariance = r.covariance[i, :3, :3] + r.start_covariance[i] + 2.0 * camera
    return bool(length**2 > 3.0 * np.sqrt(moved @ covariance @ moved))


def _advanced(r: Regions, frame: Frame) -> Regions:
    state, P, dt = r.state.copy(), r.covariance.copy(), frame.dt
    state[:, :3] += dt * state[:, 3:]
    P[:, :3] += dt * P[:, 3:]
    P[:, :, :3] += dt * P[:, :, 3:]
    P.reshape(-1, 36)[:, 21::7] += frame.setup.models.acceleration**2 * dt
    return replace(r, state=state, covariance=P, way=r.way + dt * state[:, 3:])


def _near(r: Regions, t: _Moving, places: Array) -> BoolArray:
    """Which tracks lie in each region (C, N), given covariances (N, 3, 3) of its middle as each sees it."""
    middles, P = np.ascontiguousarray(r.state[:, :3]), np.ascontiguousarray(r.covariance[:, :3, :3])
    return np.asarray(near_pairs(_NEAR, middles, P, t.position, places))


def _unexplained(r: Regions, t: _Moving, regions: IndexArray, rows: IndexArray) -> Array:
    """χ²(3) of the velocities of tracks (K,), each less that of one of the regions (K,)."""
    gaps = t.velocity[rows] - r.state[regions, 3:]
    return np.asarray(squared_distances(gaps, t.velocities[rows] + r.covariance[regions, 3:, 3:]))


def _claims(r: Regions, t: _Moving) -> BoolArray:
    """Which moving tracks lie in each region and move as it does (C, N): the first region has it."""
    fits: BoolArray = np.logical_and(_near(r, t, t.places), t.moves)
    which, track = np.nonzero(fits)
    fits[which, track] = _unexplained(r, t, which, track) <= AGREES
    return np.asarray(fits & (fits.cumsum(axis=0) == 1))


def _supported(r: Regions, t: _Moving, claims: BoolArray) -> tuple[Regions, list[tuple[int, IndexArray]]]:
    """Regions corrected by the tracks that support them; those without for long are forgotten."""
    own: BoolArray = np.asarray(claims.any(axis=1))
    r = _corrected(r, t, claims)
    inside = _near(r, t, t.spread)
    which, within = np.nonzero(inside)
    left = _unexplained(r, t, which, within)
    agrees = (left <= AGREES) & t.moves[within]
    contradicts = (left > AGREES) & (left > EXPLAINED * t.test[within])
    n = len(r)
    members = [t.rows[claims[i] & inside[i]] for i in range(n)]  # where its place was hardly known, from everywhere
    enough = np.array([len(rows) >= MINIMAL_POINTS for rows in members])
    mean = (claims @ t.radius) / np.maximum(claims.sum(axis=1), 1)
    r = replace(
        r, frames=r.frames + (own & enough), unseen=np.where(own, 0, r.unseen + 1),
        agreeing=r.agreeing + own * np.bincount(which[agrees], minlength=n),
        contradicting=r.contradicting + own * np.bincount(which[contradicts], minlength=n),
        radius=np.where(own, mean, r.radius),
    )  # fmt: skip
    keep: IndexArray = np.flatnonzero(r.unseen <= _PATIENCE)
    return r.select(keep), [(new, members[i]) for new, i in enumerate(keep.tolist()) if own[i]]


def _corrected(r: Regions, t: _Moving, claims: BoolArray) -> Regions:
    """Regions with what the tracks say that support them."""
    rows = np.flatnonzero(claims.any(axis=0))
    weight = claims[:, rows].astype(float)
    share = 1.0 / (_OVERLAP * np.sqrt(np.maximum(weight.sum(axis=1), 1.0)))  # they share errors, also with the past
    places, velocities = np.linalg.inv(t.places[rows]), np.linalg.inv(t.velocities[rows])
    information = np.linalg.inv(r.covariance)
    vector = (information @ r.state[:, :, None])[:, :, 0]
    information[:, :3, :3] += np.einsum("ck,kij->cij", weight, places)
    information[:, 3:, 3:] += share[:, None, None] * np.einsum("ck,kij->cij", weight, velocities)
    vector[:, :3] += weight @ (places @ t.position[rows, :, None])[:, :, 0]
    vector[:, 3:] += share[:, None] * (weight @ (velocities @ t.velocity[rows, :, None])[:, :, 0])
    P = np.linalg.inv(information)
    return replace(r, state=(P @ vector[:, :, None])[:, :, 0], covariance=P)


def _new_regions(t: _Moving, free: BoolArray) -> tuple[Regions, list[tuple[int, IndexArray]]]:
    """Regions of free tracks that lie together and move alike, the largest first."""
    rows = np.flatnonzero(free)
    if len(rows) < _BEGIN:
        return Regions.none(), []
    at, places, speed, speeds = t.position[rows], t.places[rows], t.velocity[rows], t.velocities[rows]
    near = np.asarray(near_pairs(_NEAR, at, places, at, places)) & np.asarray(
        near_pairs(AGREES, speed, speeds, speed, speeds)
    )
    left, groups = np.ones(len(rows), bool), []
    for i in np.argsort(-near.sum(axis=1), kind="stable"):
        group = near[i] & left
        if left[i] and group.sum() >= _BEGIN:
            left &= ~group
            groups.append(rows[group])
    n = len(groups)
    if not n:
        return Regions.none(), []
    unknown = np.tile(1e12 * np.eye(6), (n, 1, 1))  # before anything is known
    none, zero = np.zeros((n, 3)), np.zeros(n, np.int64)
    frames = np.array([int(len(group) >= MINIMAL_POINTS) for group in groups])
    radius = np.array([t.radius[group].mean() for group in groups])
    r = Regions(np.zeros((n, 6)), unknown, none, unknown[:, :3, :3], none, radius, frames, zero, zero, zero)
    r = _corrected(r, t, np.array([among(len(free), group) for group in groups]))
    r = replace(r, start=r.state[:, :3].copy(), start_covariance=r.covariance[:, :3, :3].copy())
    return r, [(i, t.rows[group]) for i, group in enumerate(groups)]
