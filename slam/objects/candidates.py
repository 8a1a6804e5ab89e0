"""Regions that may be a moving body: neighbouring tracks with agreeing velocities, followed over time.

A body that shows few tracks at a time, and each for a few frames only (a cyclist, a distant car), never has as many
long tracks as `slam.objects.regions` needs. Here the region is followed instead of its tracks:
tracks come and go, the region's place and velocity stay in a Kalman filter with constant velocity. A region that is
followed over more than its own size, supported all the way by tracks that move as it does, and contradicted by few
inside it, cannot be still: where velocities are wrong (false matches, depth noise) the region walks away from the
tracks that made it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray
from slam.geometry.kernels import near_pairs, squared_distances
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.se3 import Array
from slam.objects.points import MIN_POINTS
from slam.objects.tracks import AGREES, EXPLAINED, MOVES, ConstantVelocity

_NEAR = 7.8  # derived: χ²(3) at 95 %, of tracks inside the region
_BEGIN = 2  # fixed: tracks that begin a region
_FRAMES = 4  # in which a region has had the tracks that fix a motion
_SHARE = 0.6  # of the tracks inside that must agree with it
_PATIENCE = 3  # frames for which a region is followed without a track
_OVERLAP = 3.0  # velocities of successive frames come from the same window: their covariance is larger by so much
_ALL = slice(None)
_RADIUS = 0.05  # of a region where bodies have no least size, as a share of the depth


def region_radius(depth: Any, size: float) -> Any:
    """Radius of the region [m] that a body may fill: half its least size, or a share of its depth."""
    return np.maximum(0.5 * size, _RADIUS * depth)


@dataclass(frozen=True, eq=False)
class MovingTracks:
    """Tracks of a frame with their constant velocities, a row each."""

    rows: NDArray[np.intp]  # in the table of tracks (N,)
    ids: IdArray  # of the tracks (N,)
    motion: ConstantVelocity  # their constant velocities
    radius: Array  # of the region about each (N,) [m]
    moves: BoolArray  # whether a fixed point does not explain it (N,)

    @classmethod
    def of(
        cls, rows: NDArray[np.intp], ids: IdArray, motion: ConstantVelocity, depth: Array, noise: Array, size: float,
        min_speed: float,
    ) -> MovingTracks:  # fmt: skip
        """Those of the tracks whose depth is known better than to within a region.

        Args:
            rows: of the tracks in their table (N,).
            ids: of the tracks (N,).
            motion: their constant velocities.
            depth: of each (N,) [m].
            noise: standard deviation of one measured depth (N,) [m].
            size: what bodies measure across at least [m].
            min_speed: of bodies [m/s].
        """
        radius = region_radius(depth, size)
        kept = np.flatnonzero((depth > 0) & (noise < radius))
        m = motion
        some = ConstantVelocity(
            m.position[kept], m.covariance[kept], m.velocity[kept], m.velocity_covariance[kept], m.test[kept]
        )
        moves = (some.test > MOVES) & (np.linalg.norm(some.velocity, axis=1) > min_speed)
        return cls(rows[kept], ids[kept], some, radius[kept], moves)

    @cached_property
    def places(self) -> Array:
        """Covariances (N, 3, 3) of a region's middle as each sees it."""
        return self.motion.covariance + self.spread

    @cached_property
    def spread(self) -> Array:
        """Covariances (N, 3, 3) of the points in a region about each: as of a ball's."""
        return np.eye(3) * (self.radius**2 / 3.0)[:, None, None]

    @cached_property
    def stacked(self) -> tuple[Array, Array, Array, Array]:
        """Measurements of a region by moving tracks: information (N, 3, 3) on position and velocity, and vectors.

        The vectors (N, 3) are the information times position and velocity. All are NaN for those that do not move.
        """
        m, rows = self.motion, np.flatnonzero(self.moves)
        out = []
        for covariances, means in ((self.places, m.position), (m.velocity_covariance, m.velocity)):
            information, vectors = np.full_like(covariances, np.nan), np.full_like(means, np.nan)
            information[rows] = np.linalg.inv(covariances[rows])
            vectors[rows] = (information[rows] @ means[rows][:, :, None])[:, :, 0]
            out.append((information, vectors))
        (places, at), (velocities, towards) = out
        return places, velocities, at, towards


@dataclass(frozen=True, eq=False)
class Candidate:
    """A region that may move."""

    state: Array  # place and velocity (6,) in world axes [m], [m/s]
    covariance: Array  # of the state (6, 6)
    start: Array  # place where it began (3,)
    start_covariance: Array  # its covariance (3, 3)
    supporters: frozenset[int]  # ids of the tracks that supported it
    frames: int = 1  # number of frames with support
    agreeing: int = 0  # number of tracks inside it so far that moved with it
    contradicting: int = 0  # and that did not
    unseen: int = 0  # number of frames without a track
    # rows of the tracks that support it in this frame
    members: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    radius: float = 0.0  # of the region [m]
    way: Array = field(default_factory=lambda: np.zeros(3))  # how far its velocity has taken it since it began (3,) [m]

    def twist(self, turn: float) -> tuple[Array, Array]:
        """Its twist [ω, v] (6,), and the covariance (6, 6) of it; `turn` [rad/s] is the deviation of ω."""
        P = turn**2 * np.eye(6)
        P[3:, 3:] = self.covariance[3:, 3:]
        return np.concatenate([np.zeros(3), self.state[3:]]), P

    def may_be_body(self, min_speed: float) -> bool:
        """Whether the region has moved far enough, and is seen well enough in this frame, to found a body.

        Its velocity must have taken it that far: a region can also get there by taking up other still tracks.

        Args:
            min_speed: of bodies [m/s].
        """
        enough = len(self.members) >= MINIMAL_POINTS and self.frames >= _FRAMES and len(self.supporters) >= MIN_POINTS
        if not (enough and self.agreeing > _SHARE * (self.agreeing + self.contradicting)):
            return False
        length = min(float(np.linalg.norm(self.state[:3] - self.start)), float(np.linalg.norm(self.way)))
        return bool(length > max(2.0 * self.radius, 1e-9) and np.linalg.norm(self.state[3:]) > min_speed)

    def is_body(self, min_speed: float, camera: Array) -> bool:
        """Whether the region may be a body, and has moved for certain.

        Args:
            min_speed: of bodies [m/s].
            camera: covariance (3, 3) of where the region is, given that of the camera's pose: all that is seen shares
                its error, so it does not fall with the number of tracks.
        """
        if not self.may_be_body(min_speed):
            return False
        moved = self.state[:3] - self.start
        length = float(np.linalg.norm(moved))
        covariance = self.covariance[:3, :3] + self.start_covariance + 2.0 * camera
        return bool(length > 3.0 * np.sqrt(moved @ covariance @ moved) / length)


def follow_candidates(
    candidates: list[Candidate], tracks: MovingTracks, dt: float, acceleration: float
) -> list[Candidate]:
    """All regions a frame later, and new ones.

    Args:
        candidates: of the frame before.
        tracks: of this frame.
        dt: time since then [s].
        acceleration: density of the noise of a body's velocity [m/s / √s].
    """
    ordered = sorted(candidates, key=lambda c: -c.frames)
    moving = np.flatnonzero(tracks.moves)
    free = tracks.moves.copy()
    followed: list[Candidate | None] = [None] * len(ordered)
    if ordered:
        before = _advanced(ordered, dt, acceleration)
        mine = _claimed(before, tracks, moving)
        free[moving[mine.any(axis=0)]] = False
        some = np.flatnonzero(mine.any(axis=1))
        for i, candidate in zip(some.tolist(), _supported(before.select(some), tracks, moving, mine[some])):
            followed[i] = candidate
        for i in np.flatnonzero(~mine.any(axis=1)).tolist():
            if ordered[i].unseen < _PATIENCE:
                followed[i] = before.candidate(i, unseen=ordered[i].unseen + 1, members=np.zeros(0, np.intp))
    return [candidate for candidate in followed if candidate is not None] + _new_candidates(tracks, free)


@dataclass(frozen=True, eq=False)
class _Regions:
    """Candidates whose states (C, 6) with covariances (C, 6, 6), and ways (C, 3), are others now."""

    candidates: list[Candidate]
    state: Array
    covariance: Array
    way: Array

    def select(self, rows: NDArray[np.intp]) -> _Regions:
        """Some of them."""
        return _Regions(
            [self.candidates[i] for i in rows.tolist()], self.state[rows], self.covariance[rows], self.way[rows]
        )

    def candidate(self, i: int, **changes: Any) -> Candidate:
        """One of them, with other changes."""
        return replace(
            self.candidates[i], state=self.state[i], covariance=self.covariance[i], way=self.way[i], **changes
        )

    def near(self, tracks: MovingTracks, rows: NDArray[np.intp] | slice, places: Array) -> BoolArray:
        """Which tracks lie in each region (C, M), given the covariances (N, 3, 3) of its middle as each sees it."""
        middles, P = np.ascontiguousarray(self.state[:, :3]), np.ascontiguousarray(self.covariance[:, :3, :3])
        return np.asarray(near_pairs(_NEAR, middles, P, tracks.motion.position[rows], places[rows]))

    def unexplained(self, tracks: MovingTracks, regions: NDArray[np.intp], rows: NDArray[np.intp]) -> Array:
        """χ²(3) of the velocities of tracks (K,), each less that of one of the regions (K,)."""
        m, gaps = tracks.motion, tracks.motion.velocity[rows] - self.state[regions, 3:]
        return np.asarray(squared_distances(gaps, m.velocity_covariance[rows] + self.covariance[regions, 3:, 3:]))


def _advanced(candidates: list[Candidate], dt: float, acceleration: float) -> _Regions:
    state = np.array([candidate.state for candidate in candidates])
    P = np.array([candidate.covariance for candidate in candidates])
    way = np.array([candidate.way for candidate in candidates]) + dt * state[:, 3:]
    state[:, :3] += dt * state[:, 3:]
    P[:, :3] += dt * P[:, 3:]
    P[:, :, :3] += dt * P[:, :, 3:]
    P.reshape(-1, 36)[:, 21::7] += acceleration**2 * dt
    return _Regions(candidates, state, P, way)


def _claimed(regions: _Regions, tracks: MovingTracks, moving: NDArray[np.intp]) -> BoolArray:
    """Which of the tracks `moving` (M,) lie in each region and move as it does (C, M): the first region has it."""
    fits = regions.near(tracks, moving, tracks.places)
    which, track = np.nonzero(fits)
    fits[which, track] = regions.unexplained(tracks, which, moving[track]) <= AGREES
    return np.asarray(fits & (fits.cumsum(axis=0) == 1))


def _supported(before: _Regions, tracks: MovingTracks, moving: NDArray[np.intp], mine: BoolArray) -> list[Candidate]:
    """The regions corrected by the tracks that support them (`mine`, (C, M)), with those inside counted."""
    after = _corrected(before, tracks, moving, mine)
    inside = after.near(tracks, _ALL, tracks.spread)
    which, within = np.nonzero(inside)
    left = after.unexplained(tracks, which, within)
    agrees = left <= AGREES
    contradicts = ~agrees & (left > EXPLAINED * tracks.motion.test[within])
    agreeing = np.bincount(which[agrees & tracks.moves[within]], minlength=len(mine)).tolist()
    contradicting = np.bincount(which[contradicts], minlength=len(mine)).tolist()
    followed = []
    for i, candidate in enumerate(before.candidates):
        supporters = moving[mine[i]]
        rows = supporters[inside[i, supporters]]  # where its place was hardly known, they may come from everywhere
        followed.append(after.candidate(
            i,
            supporters=candidate.supporters | frozenset(tracks.ids[rows].tolist()),
            frames=candidate.frames + (len(rows) >= MINIMAL_POINTS),
            agreeing=candidate.agreeing + agreeing[i],
            contradicting=candidate.contradicting + contradicting[i],
            unseen=0,
            members=tracks.rows[rows],
            radius=float(tracks.radius[supporters].mean()),
        ))  # fmt: skip
    return followed


def _corrected(before: _Regions, tracks: MovingTracks, moving: NDArray[np.intp], mine: BoolArray) -> _Regions:
    """The regions after tracks have corrected them; see `_supported`."""
    weight = mine.astype(float)
    share = 1 / _share(mine.sum(axis=1))
    places, velocities, at, towards = (part[moving] for part in tracks.stacked)
    information = np.linalg.inv(before.covariance)
    vector = (information @ before.state[:, :, None])[:, :, 0]
    information[:, :3, :3] += (weight @ places.reshape(-1, 9)).reshape(-1, 3, 3)
    information[:, 3:, 3:] += share[:, None, None] * (weight @ velocities.reshape(-1, 9)).reshape(-1, 3, 3)
    vector[:, :3] += weight @ at
    vector[:, 3:] += share[:, None] * (weight @ towards)
    P = np.linalg.inv(information)
    return _Regions(before.candidates, (P @ vector[:, :, None])[:, :, 0], P, before.way)


def _new_candidates(tracks: MovingTracks, free: BoolArray) -> list[Candidate]:
    """Regions of free tracks that lie together and move alike, the largest first."""
    rows, m = np.flatnonzero(free), tracks.motion
    if len(rows) < _BEGIN:
        return []
    at, places, speed, speeds = m.position[rows], tracks.places[rows], m.velocity[rows], m.velocity_covariance[rows]
    near = near_pairs(_NEAR, at, places, at, places) & near_pairs(AGREES, speed, speeds, speed, speeds)
    left, found = np.ones(len(rows), bool), []
    for i in np.argsort(-near.sum(axis=1), kind="stable"):
        group = near[i] & left
        if left[i] and group.sum() >= _BEGIN:
            left &= ~group
            found.append(_begun(tracks, rows[group]))
    return found


def _begun(tracks: MovingTracks, rows: NDArray[np.intp]) -> Candidate:
    P = np.zeros((6, 6))
    places, velocities, at, towards = (part[rows] for part in tracks.stacked)
    share = _share(len(rows))
    P[:3, :3], P[3:, 3:] = np.linalg.inv(places.sum(axis=0)), np.linalg.inv((velocities / share).sum(axis=0))
    place = P[:3, :3] @ at.sum(axis=0)
    velocity = P[3:, 3:] @ (towards / share).sum(axis=0)
    return Candidate(
        np.concatenate([place, velocity]), P, place, P[:3, :3].copy(), frozenset(tracks.ids[rows].tolist()),
        frames=int(len(rows) >= MINIMAL_POINTS), members=tracks.rows[rows], radius=float(tracks.radius[rows].mean()),
    )  # fmt: skip


def _share(count: Any) -> Any:
    """Factor on the information of so many velocities: they share errors with the last frame's, and with each other."""
    return _OVERLAP * np.sqrt(count)
