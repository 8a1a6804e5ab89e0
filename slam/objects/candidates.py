"""Regions that may be a moving body: neighbouring tracks with agreeing velocities, followed over time.

A body of which few tracks are seen at a time, and each for a few frames only (a cyclist, a car far off), never brings
together as many long tracks as `slam.objects.regions` asks for. Here the region is followed instead of its tracks:
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
from slam.geometry.gauss_kernels import squared_distances
from slam.geometry.se3 import Array
from slam.objects.tracks import MOVES, ConstantVelocity

_NEAR = 7.8  # χ²(3) at 95 %: tracks inside the region
_AGREES = 11.3  # χ²(3) at 99 %: velocities that agree
_BEGIN = 2  # tracks that begin a region
_SUPPORT = 3  # tracks of a frame that are a region's support
_FRAMES = 4  # with support
_TRACKS = 4  # different ones that have supported it
_EXPLAINED = 0.2  # share of the χ² of "still" that the region's motion may leave, as of members of a body
_SHARE = 0.6  # of the tracks inside that must agree with it
_PATIENCE = 3  # frames for which a region is followed without a track
_OVERLAP = 3.0  # velocities of successive frames come from the same window: their covariance is larger by so much
_RADIUS = 0.05  # of a region where bodies have no least size, as a share of the depth


def region_radius(depth: Any, size: float) -> Any:
    """Radius of the region [m] that a body may fill: half its least size, or a share of its depth."""
    return np.maximum(0.5 * size, _RADIUS * depth)


@dataclass(frozen=True)
class MovingTracks:
    """Tracks of a frame with their even motions, a row each.

    Attributes:
        rows: in the table of tracks (N,).
        ids: of the tracks (N,).
        motion: their even motions.
        radius: of the region about each (N,) [m].
        moves: whether a fixed point does not explain it (N,).
    """

    rows: NDArray[np.intp]
    ids: IdArray
    motion: ConstantVelocity
    radius: Array
    moves: BoolArray

    @classmethod
    def of(
        cls, rows: NDArray[np.intp], ids: IdArray, motion: ConstantVelocity, depth: Array, noise: Array, size: float,
        min_speed: float,
    ) -> MovingTracks:  # fmt: skip
        """Those of the tracks whose depth is known better than to within a region.

        Args:
            rows: of the tracks in their table (N,).
            ids: of the tracks (N,).
            motion: their even motions.
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


@dataclass(frozen=True)
class Candidate:
    """A region that may move.

    Attributes:
        state: place and velocity (6,) in world axes [m], [m/s].
        covariance: of the state (6, 6).
        start: place where it began (3,), and
        start_covariance: its covariance (3, 3).
        supporters: ids of the tracks that supported it.
        frames: number of frames with support.
        agreeing, contradicting: number of tracks inside it so far that moved with it, and that did not.
        unseen: number of frames without a track.
        members: rows of the tracks that support it in this frame.
        radius: of the region [m].
    """

    state: Array
    covariance: Array
    start: Array
    start_covariance: Array
    supporters: frozenset[int]
    frames: int = 1
    agreeing: int = 0
    contradicting: int = 0
    unseen: int = 0
    members: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    radius: float = 0.0

    def twist(self, turn: float) -> tuple[Array, Array]:
        """Its twist [ω, v] (6,), and the covariance (6, 6) of it; `turn` [rad/s] is the deviation of ω."""
        P = turn**2 * np.eye(6)
        P[3:, 3:] = self.covariance[3:, 3:]
        return np.concatenate([np.zeros(3), self.state[3:]]), P

    def is_body(self, min_speed: float, camera: Array) -> bool:
        """Whether the region has moved for certain, and is seen well enough in this frame to found a body.

        Args:
            min_speed: of bodies [m/s].
            camera: covariance (3, 3) of where the region is, given that of the camera's pose: all that is seen shares
                its error, so it does not fall with the number of tracks.
        """
        moved = self.state[:3] - self.start
        length = float(np.linalg.norm(moved))
        if length <= max(2.0 * self.radius, 1e-9) or np.linalg.norm(self.state[3:]) <= min_speed:
            return False
        covariance = self.covariance[:3, :3] + self.start_covariance + 2.0 * camera
        deviation = np.sqrt(moved @ covariance @ moved) / length
        enough = len(self.members) >= _SUPPORT and self.frames >= _FRAMES and len(self.supporters) >= _TRACKS
        agree = self.agreeing > _SHARE * (self.agreeing + self.contradicting)
        return bool(enough and agree and length > 3.0 * deviation)


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
    free = tracks.moves.copy()
    followed = []
    for candidate in sorted(candidates, key=lambda c: -c.frames):
        candidate = _advanced(candidate, dt, acceleration)
        mine = free & _near(candidate, tracks, tracks.places) & _agrees(candidate, tracks)
        free &= ~mine
        if mine.any():
            followed.append(_supported(candidate, tracks, mine))
        elif candidate.unseen < _PATIENCE:
            followed.append(replace(candidate, unseen=candidate.unseen + 1, members=np.zeros(0, np.intp)))
    return followed + _new_candidates(tracks, free)


def _advanced(candidate: Candidate, dt: float, acceleration: float) -> Candidate:
    state, P = candidate.state.copy(), candidate.covariance.copy()
    state[:3] += dt * state[3:]
    P[:3] += dt * P[3:]
    P[:, :3] += dt * P[:, 3:]
    P.reshape(-1)[21::7] += acceleration**2 * dt
    return replace(candidate, state=state, covariance=P)


def _near(candidate: Candidate, tracks: MovingTracks, places: Array) -> BoolArray:
    """Which tracks lie in the region (N,), given the covariances (N, 3, 3) of its middle as each sees it."""
    gap = tracks.motion.position - candidate.state[:3]
    return _squares(gap, places + candidate.covariance[:3, :3]) < _NEAR


def _agrees(candidate: Candidate, tracks: MovingTracks) -> BoolArray:
    """Which tracks move as the region does (N,)."""
    return np.asarray(_unexplained(candidate, tracks) <= _AGREES)


def _unexplained(candidate: Candidate, tracks: MovingTracks) -> Array:
    """χ²(3) of the tracks' velocities, less the region's (N,)."""
    gap = tracks.motion.velocity - candidate.state[3:]
    return _squares(gap, tracks.motion.velocity_covariance + candidate.covariance[3:, 3:])


def _supported(candidate: Candidate, tracks: MovingTracks, mine: BoolArray) -> Candidate:
    """The region after the tracks `mine` (N,) have corrected it, with what those inside it say counted."""
    m, rows = tracks.motion, np.flatnonzero(mine)
    places, velocities = np.linalg.inv(tracks.places[rows]), _velocity_information(m.velocity_covariance[rows])
    information = np.linalg.inv(candidate.covariance)
    vector = information @ candidate.state
    information[:3, :3] += places.sum(axis=0)
    information[3:, 3:] += velocities.sum(axis=0)
    vector[:3] += (places @ m.position[rows][:, :, None]).sum(axis=0)[:, 0]
    vector[3:] += (velocities @ m.velocity[rows][:, :, None]).sum(axis=0)[:, 0]
    P = np.linalg.inv(information)
    after = replace(candidate, state=P @ vector, covariance=P)
    inside, left = _near(after, tracks, tracks.spread), _unexplained(after, tracks)
    rows = rows[inside[rows]]  # where the region's place was hardly known, they may come from everywhere
    agrees = left <= _AGREES
    contradicts = ~agrees & (left > _EXPLAINED * m.test)
    return replace(
        after,
        supporters=candidate.supporters | frozenset(tracks.ids[rows].tolist()),
        frames=candidate.frames + (len(rows) >= _SUPPORT),
        agreeing=candidate.agreeing + int((inside & agrees & tracks.moves).sum()),
        contradicting=candidate.contradicting + int((inside & contradicts).sum()),
        unseen=0,
        members=tracks.rows[rows],
        radius=float(tracks.radius[mine].mean()),
    )


def _new_candidates(tracks: MovingTracks, free: BoolArray) -> list[Candidate]:
    """Regions of free tracks that lie together and move alike, the largest first."""
    rows, m = np.flatnonzero(free), tracks.motion
    if len(rows) < _BEGIN:
        return []
    places = tracks.places[rows]
    gaps = m.position[rows][:, None] - m.position[rows]
    near = _squares(gaps, places[:, None] + places) < _NEAR
    changes = m.velocity[rows][:, None] - m.velocity[rows]
    velocities = m.velocity_covariance[rows]
    near &= _squares(changes, velocities[:, None] + velocities) <= _AGREES
    left, found = np.ones(len(rows), bool), []
    for i in np.argsort(-near.sum(axis=1), kind="stable"):
        group = near[i] & left
        if left[i] and group.sum() >= _BEGIN:
            left &= ~group
            found.append(_begun(tracks, rows[group]))
    return found


def _begun(tracks: MovingTracks, rows: NDArray[np.intp]) -> Candidate:
    m, P = tracks.motion, np.zeros((6, 6))
    places, velocities = np.linalg.inv(tracks.places[rows]), _velocity_information(m.velocity_covariance[rows])
    P[:3, :3], P[3:, 3:] = np.linalg.inv(places.sum(axis=0)), np.linalg.inv(velocities.sum(axis=0))
    place = P[:3, :3] @ (places @ m.position[rows][:, :, None]).sum(axis=0)[:, 0]
    velocity = P[3:, 3:] @ (velocities @ m.velocity[rows][:, :, None]).sum(axis=0)[:, 0]
    return Candidate(
        np.concatenate([place, velocity]), P, place, P[:3, :3].copy(), frozenset(tracks.ids[rows].tolist()),
        frames=int(len(rows) >= _SUPPORT), members=tracks.rows[rows], radius=float(tracks.radius[rows].mean()),
    )  # fmt: skip


def _velocity_information(covariances: Array) -> Array:
    """Information (N, 3, 3) that velocities bring: they share a window with the last frame's, and a camera's error."""
    return np.asarray(np.linalg.inv(covariances) / (_OVERLAP * np.sqrt(len(covariances))))


def _squares(gaps: Array, covariances: Array) -> Array:
    """χ² (...) of gaps (..., 3) with covariances (..., 3, 3)."""
    flat = squared_distances(gaps.reshape(-1, 3), covariances.reshape(-1, 3, 3))
    return np.asarray(flat.reshape(gaps.shape[:-1]))
