"""Regions that may be a moving body: neighbouring tracks with agreeing velocities, followed over time.

A body that shows few tracks at a time, each for a few frames (a cyclist, a distant car), never has as many long tracks
as `slam.bodies.finder` needs. Its region's place and velocity stay in a Kalman filter with constant velocity while
tracks come and go. A region that is followed over more than its own size is hardly still: where velocities are wrong
(false matches, depth noise) it walks away from the tracks that made it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.bodies.config import MIN_FRAMES, RUN
from slam.bodies.fits import AGREES, MOVES, ConstantVelocity, constant_velocity
from slam.bodies.frame import Frame
from slam.data import BoolArray, IndexArray
from slam.geometry.arrays import changed
from slam.geometry.kernels import squared_distances
from slam.geometry.rig import MINIMAL_POINTS
from slam.geometry.se3 import Array
from slam.tracks.table import Tracks

_NEAR = 7.8  # derived: χ²(3) at 95 %, of tracks inside the region
_OVERLAP = 3.0  # velocities of successive frames come from the same window: their covariance is larger by so much


@dataclass(frozen=True, eq=False)
class Region:
    """A region that may move, and the tracks that support it in this frame; a new one knows nothing yet."""

    radius: float  # [m]
    rows: IndexArray  # of the tracks that support it
    state: Array  # place and velocity (6,) in world axes [m], [m/s]
    covariance: Array  # of the state (6, 6)
    start: Array  # place where it began (3,)
    way: Array  # how far its velocity has taken it since it began (3,) [m]
    frames: int = 0  # number of frames with as many as fix a motion
    unseen: int = 0  # number of frames without a track

    def advanced(self, frame: Frame) -> Region:
        """The region predicted into a frame."""
        F = np.eye(6)
        F[:3, 3:] = frame.dt * np.eye(3)
        P = F @ self.covariance @ F.T
        P[3:, 3:] += frame.setup.models.acceleration**2 * frame.dt * np.eye(3)
        return changed(self, state=F @ self.state, covariance=P, way=self.way + frame.dt * self.state[3:])

    def has_moved(self) -> bool:
        """Whether it has gone farther than it is wide, by its velocity: taking up other still tracks takes it, too."""
        ways = self.state[:3] - self.start, self.way
        return bool(
            len(self.rows) >= MINIMAL_POINTS
            and self.frames >= MIN_FRAMES
            and min(np.linalg.norm(way) for way in ways) > 2.0 * self.radius
        )

    def corrected(self, m: ConstantVelocity, spread: Array, rows: IndexArray) -> Region:
        """The region with what tracks (K,) say; points in it lie about its place with a `spread` (N, 3, 3)."""
        share = 1.0 / (_OVERLAP * np.sqrt(len(rows)))  # they share errors, also with the past
        places = np.linalg.inv(m.covariance[rows] + spread[rows])
        velocities = share * np.linalg.inv(m.velocity_covariance[rows])
        information = np.linalg.inv(self.covariance)
        vector = information @ self.state
        information[:3, :3] += places.sum(axis=0)
        information[3:, 3:] += velocities.sum(axis=0)
        vector[:3] += (places @ m.position[rows, :, None]).sum(axis=0)[:, 0]
        vector[3:] += (velocities @ m.velocity[rows, :, None]).sum(axis=0)[:, 0]
        P = np.linalg.inv(information)
        return changed(self, state=P @ vector, covariance=P)


def follow_regions(regions: list[Region], frame: Frame, tracks: Tracks) -> tuple[list[Region], list[Region]]:
    """Regions in this frame, the longest known first, then those of tracks that move and support none.

    As those that go on, and those that have moved. Free tracks count whose depth is known better than to
    within a region.
    """
    s, c = frame.setup, frame.setup.config
    rows = np.flatnonzero(tracks.found & (tracks.body < 0) & ~tracks.still)
    rows = rows[tracks.count(rows) >= MIN_FRAMES - 1]
    m = constant_velocity(tracks, rows, frame.times, c.max_speed)
    depth = (m.position - frame.eye) @ frame.T_world_left[:3, 2]
    k = np.flatnonzero((depth > 0) & (s.depth_noise(depth) < s.radius(depth)))
    m, rows, radius = ConstantVelocity(*(column[k] for column in vars(m).values())), rows[k], s.radius(depth[k])
    spread = np.eye(3) * (radius**2 / 3.0)[:, None, None]  # as of a ball's points
    moves = (m.test > MOVES) & (np.linalg.norm(m.velocity, axis=1) > c.min_speed)

    def off(r: Region, places: Array | float = 0.0) -> tuple[Array, BoolArray]:
        """χ²(3) of the tracks' velocities against the region's, and which lie in it."""
        left = squared_distances(m.velocity - r.state[3:], m.velocity_covariance + r.covariance[3:, 3:])
        away = squared_distances(m.position - r.state[:3], spread + places + r.covariance[:3, :3])
        return left, np.asarray(away < _NEAR)

    followed, free = [], moves.copy()
    for region in sorted(regions, key=lambda region: -region.frames):
        r = region.advanced(frame)
        left, near = off(r, m.covariance)
        mine = free & near & (left <= AGREES)
        free &= ~mine
        if mine.any():
            r = r.corrected(m, spread, np.flatnonzero(mine))
            own = rows[mine & off(r)[1]]  # where its place was hardly known, from everywhere
            frames, size = r.frames + (len(own) >= MINIMAL_POINTS), float(radius[mine].mean())
            r = changed(r, rows=own, frames=frames, unseen=0, radius=size)
        else:
            r = changed(r, rows=rows[:0], unseen=r.unseen + 1)
        if r.unseen <= RUN:
            followed.append(r)
    followed += _new_regions(m, spread, radius, rows, np.flatnonzero(free))
    moved = [r.has_moved() for r in followed]
    return [r for r, far in zip(followed, moved) if not far], [r for r, far in zip(followed, moved) if far]


def _new_regions(
    m: ConstantVelocity, spread: Array, radius: Array, rows: IndexArray, free: IndexArray
) -> list[Region]:  # fmt: skip
    """Regions of free tracks (K,) that lie together and move alike, the largest first: two at least."""
    place, velocity, n = m.position[free], m.velocity[free], len(free)
    P, V, S = m.covariance[free], m.velocity_covariance[free], spread[free]
    apart = (place - place[:, None]).reshape(-1, 3), (S + P + P[:, None] + S[:, None]).reshape(-1, 3, 3)
    faster = (velocity - velocity[:, None]).reshape(-1, 3), (V + V[:, None]).reshape(-1, 3, 3)
    alike = (squared_distances(*apart) < _NEAR) & (squared_distances(*faster) < AGREES)
    alike = alike.reshape(n, n)
    size = alike.sum(axis=1)
    left, regions = np.ones(len(free), bool), []
    for i in np.argsort(-size, kind="stable"):
        group = free[alike[i] & left]
        if left[i] and len(group) >= 2:
            left &= ~alike[i]
            none, frames = np.zeros(6), int(len(group) >= MINIMAL_POINTS)
            r = Region(float(radius[group].mean()), rows[group], none, 1e12 * np.eye(6), none[:3], none[:3], frames)
            r = r.corrected(m, spread, group)
            regions.append(changed(r, start=r.state[:3]))
    return regions
