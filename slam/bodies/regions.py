"""Regions that may be a moving body: neighbouring tracks with agreeing velocities, followed over time.

A body that shows few tracks at a time, and each for a few frames only (a cyclist, a distant car), never has as many
long tracks as `slam.bodies.finder` needs. Here the region is followed instead of its tracks: tracks come and go, the
region's place and velocity stay in a Kalman filter with constant velocity. A region that is followed over more than its
own size, supported all the way by tracks that move as it does, and contradicted by few inside it, cannot be still:
where velocities are wrong (false matches, depth noise) the region walks away from the tracks that made it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.bodies.config import MIN_FRAMES, RUN
from slam.bodies.fits import AGREES, EXPLAINED, MOVES, ConstantVelocity, constant_velocity
from slam.bodies.frame import Frame
from slam.data import BoolArray, IndexArray
from slam.geometry.kernels import squared_distances
from slam.geometry.rig import MINIMAL_POINTS
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.tracks.table import Tracks

_NEAR = 7.8  # derived: χ²(3) at 95 %, of tracks inside the region
_SHARE = 0.6  # of the tracks inside that must agree with it
_OVERLAP = 3.0  # velocities of successive frames come from the same window: their covariance is larger by so much


@dataclass(frozen=True, eq=False)
class Region:
    """A region that may move, and the tracks that support it in this frame."""

    state: Array  # place and velocity (6,) in world axes [m], [m/s]
    covariance: Array  # of the state (6, 6)
    start: Array  # place where it began (3,)
    start_covariance: Array  # its covariance (3, 3)
    way: Array  # how far its velocity has taken it since it began (3,) [m]
    radius: float  # [m]
    rows: IndexArray  # of the tracks that support it
    frames: int = 0  # number of frames with as many as fix a motion
    agreeing: int = 0  # number of tracks inside it so far that moved with it
    contradicting: int = 0  # and that did not
    unseen: int = 0  # number of frames without a track

    def advanced(self, frame: Frame) -> Region:
        """The region predicted into a frame."""
        F = np.eye(6)
        F[:3, 3:] = frame.dt * np.eye(3)
        P = F @ self.covariance @ F.T
        P[3:, 3:] += frame.setup.models.acceleration**2 * frame.dt * np.eye(3)
        return replace(self, state=F @ self.state, covariance=P, way=self.way + frame.dt * self.state[3:])

    def has_moved(self, frame: Frame) -> bool:
        """Whether it has moved far enough, and for certain.

        Its velocity must have taken it that far: a region can also get there by taking up other still tracks. All that
        is seen shares the error of the camera's pose, so that does not fall with the number of tracks.
        """
        share = self.agreeing > _SHARE * (self.agreeing + self.contradicting)
        if len(self.rows) < MINIMAL_POINTS or self.frames < MIN_FRAMES or not share:
            return False
        moved = self.state[:3] - self.start
        length = float(np.linalg.norm(moved))
        if min(length, float(np.linalg.norm(self.way))) <= 2.0 * self.radius:
            return False
        if np.linalg.norm(self.state[3:]) <= frame.setup.config.min_speed:
            return False
        local = transform(inverse(frame.T_world_left), self.state[None, :3])
        J = frame.T_world_left[:3, :3] @ points_by_pose(local)[0]
        camera = J @ frame.cameras.covariance[-6:, -6:] @ J.T
        covariance = self.covariance[:3, :3] + self.start_covariance + 2.0 * camera
        return bool(length**2 > 3.0 * np.sqrt(moved @ covariance @ moved))


@dataclass(frozen=True, eq=False)
class _Moving:
    """Tracks of a frame with their even velocities, a row each."""

    rows: IndexArray  # in the table of tracks (N,)
    motion: ConstantVelocity  # theirs
    radius: Array  # of the region about each (N,) [m]
    spread: Array  # covariances (N, 3, 3) of the points in a region about each: as of a ball's
    moves: BoolArray  # whether a fixed point does not explain it (N,)

    def near(self, place: Array, covariance: Array, places: Array | float = 0.0) -> BoolArray:
        """Which lie in a region about a place (3,) with its covariance (3, 3), with theirs (N, 3, 3) besides."""
        squares = squared_distances(self.motion.position - place, self.spread + places + covariance)
        return np.asarray(squares < _NEAR)

    def unexplained(self, velocity: Array, covariance: Array) -> Array:
        """χ²(3) of their velocities, each less one (3,) with its covariance (3, 3) (N,)."""
        m = self.motion
        return np.asarray(squared_distances(m.velocity - velocity, m.velocity_covariance + covariance))


def _moving_tracks(frame: Frame, tracks: Tracks) -> _Moving:
    """Free tracks whose depth is known better than to within a region."""
    s, c = frame.setup, frame.setup.config
    rows = np.flatnonzero(tracks.found & (tracks.body < 0) & ~tracks.still)
    rows = rows[tracks.count(rows) >= MIN_FRAMES - 1]
    m = constant_velocity(tracks, rows, frame.times, c.max_speed)
    depth = (m.position - frame.eye) @ frame.T_world_left[:3, 2]
    radius = s.radius(depth)
    k = np.flatnonzero((depth > 0) & (s.depth_noise(depth) < radius))
    m = ConstantVelocity(*(column[k] for column in vars(m).values()))
    spread = np.eye(3) * (radius[k] ** 2 / 3.0)[:, None, None]
    moves = (m.test > MOVES) & (np.linalg.norm(m.velocity, axis=1) > c.min_speed)
    return _Moving(rows[k], m, radius[k], spread, moves)


def follow_regions(regions: list[Region], frame: Frame, tracks: Tracks) -> tuple[list[Region], list[Region]]:
    """Regions in this frame, the longest known first, then those of tracks that move and support none.

    As those that go on, and those that have moved for certain.
    """
    t = _moving_tracks(frame, tracks)
    free, followed = t.moves.copy(), []
    for region in sorted(regions, key=lambda r: -r.frames):
        r = region.advanced(frame)
        mine = free & t.near(r.state[:3], r.covariance[:3, :3], t.motion.covariance)
        mine &= t.unexplained(r.state[3:], r.covariance[3:, 3:]) <= AGREES
        free &= ~mine
        r = _supported(r, t, mine)
        if r.unseen <= RUN:
            followed.append(r)
    followed += _new_regions(t, np.flatnonzero(free))
    moved = [r.has_moved(frame) for r in followed]
    return [r for r, far in zip(followed, moved) if not far], [r for r, far in zip(followed, moved) if far]


def _supported(r: Region, t: _Moving, mine: BoolArray) -> Region:
    """A region corrected by the tracks that support it (N,)."""
    if not mine.any():
        return replace(r, rows=t.rows[mine], unseen=r.unseen + 1)
    r = _corrected(r, t, np.flatnonzero(mine))
    inside = t.near(r.state[:3], r.covariance[:3, :3])
    left = t.unexplained(r.state[3:], r.covariance[3:, 3:])
    agrees = inside & (left <= AGREES) & t.moves
    contradicts = inside & (left > AGREES) & (left > EXPLAINED * t.motion.test)
    rows = t.rows[mine & inside]  # where its place was hardly known, from everywhere
    enough = len(rows) >= MINIMAL_POINTS
    return replace(
        r, rows=rows, frames=r.frames + enough, unseen=0, agreeing=r.agreeing + int(agrees.sum()),
        contradicting=r.contradicting + int(contradicts.sum()), radius=float(t.radius[mine].mean()),
    )  # fmt: skip


def _corrected(r: Region, t: _Moving, rows: IndexArray) -> Region:
    """A region with what tracks (K,) say that support it."""
    m = t.motion
    share = 1.0 / (_OVERLAP * np.sqrt(len(rows)))  # they share errors, also with the past
    places = np.linalg.inv(m.covariance[rows] + t.spread[rows])
    velocities = share * np.linalg.inv(m.velocity_covariance[rows])
    information = np.linalg.inv(r.covariance)
    vector = information @ r.state
    information[:3, :3] += places.sum(axis=0)
    information[3:, 3:] += velocities.sum(axis=0)
    vector[:3] += (places @ m.position[rows, :, None]).sum(axis=0)[:, 0]
    vector[3:] += (velocities @ m.velocity[rows, :, None]).sum(axis=0)[:, 0]
    P = np.linalg.inv(information)
    return replace(r, state=P @ vector, covariance=P)


def _new_regions(t: _Moving, free: IndexArray) -> list[Region]:
    """Regions of free tracks (K,) that lie together and move alike, the largest first: two at least."""
    m, regions = t.motion, []
    alike = [
        t.near(m.position[i], m.covariance[i] + t.spread[i], m.covariance)[free]
        & (t.unexplained(m.velocity[i], m.velocity_covariance[i])[free] < AGREES)
        for i in free
    ]
    left = np.ones(len(free), bool)
    for i in sorted(range(len(free)), key=lambda i: -int(alike[i].sum())):
        group = free[alike[i] & left]
        if not left[i] or len(group) < 2:
            continue
        left &= ~alike[i]
        none, unknown = np.zeros(6), 1e12 * np.eye(6)  # before anything is known
        r = Region(none, unknown, none[:3], unknown, none[:3], float(t.radius[group].mean()), t.rows[group])
        r = _corrected(r, t, group)
        frames = int(len(group) >= MINIMAL_POINTS)
        regions.append(replace(r, start=r.state[:3], start_covariance=r.covariance[:3, :3], frames=frames))
    return regions
