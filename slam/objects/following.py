"""Following tracks into the next frame: where each is expected, how far off it may be, and which feature it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import BoolArray, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.objects.bodies import Body
from slam.objects.candidates import Candidate, region_radius
from slam.objects.config import ObjectsConfig
from slam.objects.matching import match_far
from slam.objects.pixel_kernels import continue_tracks
from slam.objects.track_kernels import members_ahead
from slam.objects.tracks import LEAST_INFORMATION, Tracks

_UNEVEN = 0.3  # share of `max_speed` by which a speed may change from frame to frame
_NONE = np.zeros((3, 3))


def follow(
    tracks: Tracks,
    bodies: Mapping[int, Body],
    candidates: Sequence[Candidate],
    T_world_left: Array,
    features: StereoFeatures,
    measured: Array,
    dt: float,
    rig: StereoRig,
    sigma: float,
    config: ObjectsConfig,
) -> None:
    """Find each track's feature in this frame; sets rows, descriptors and misses, in place.

    Members of bodies take over their feature's descriptor even if `slam.objects.recovery.located` does not confirm the
    match afterwards, because the body's pose is wrong more often than the match. Members of a body that was not
    measured in the last frame keep theirs: otherwise they would take over descriptors of what occludes the body.

    Tracks are looked for where their fit (or their body's motion) says, in windows as wide as that is uncertain. What
    is left, and was not known for long enough to have a velocity, is looked for where the body or the candidate takes
    it on which it lies, and then as far as `max_speed` allows.
    Features matched with members of a body that was not measured in the last frame stay available to free tracks until
    the body is located. Otherwise nothing that newly comes into view of such a body would be detected.
    `measured` are the features' points in camera coordinates (N, 3), NaN where there is no depth.
    """
    tracks.row[:] = -1
    alive = np.flatnonzero(tracks.ids >= 0)
    _advance(tracks, bodies, alive, dt)
    lost = np.zeros(len(alive), bool)
    for body in bodies.values():
        if body.missed > 1:
            lost |= tracks.body[alive] == body.id
    if len(alive) and len(features):
        search = _Search.of(tracks, T_world_left, features, dt, config, rig, sigma)
        taken = np.zeros(len(features), bool)
        search.expected(alive[~lost], taken)
        held = tracks.row[tracks.seen & (tracks.body >= 0)]
        _carried_along(search, bodies, candidates, taken)
        _far(tracks, T_world_left, features, measured, taken, dt, config, rig, sigma)
        if lost.any():
            unclaimed = alive[lost]
            search.expected(unclaimed, np.zeros(len(features), bool))
            tracks.row[unclaimed[np.isin(tracks.row[unclaimed], held)]] = -1
    seen = tracks.seen
    tracks.missed[:] = np.where(seen, 0, tracks.missed + 1)
    seen[alive[lost]] = False
    tracks.descriptors[seen] = features.descriptors[tracks.row[seen]]


def _advance(tracks: Tracks, bodies: Mapping[int, Body], alive: NDArray[np.intp], dt: float) -> None:
    """Where tracks are expected in this frame: positions and covariances move on, in place."""
    moves = alive[(tracks.body[alive] < 0) & tracks.velocity[alive].any(axis=1)]
    tracks.position[moves] += dt * tracks.velocity[moves]
    tracks.covariance[moves] += dt**2 * tracks.velocity_covariance[moves]
    for body in bodies.values():
        mine = np.flatnonzero(tracks.body == body.id)
        tracks.position[mine], tracks.covariance[mine] = members_ahead(
            tracks.local, tracks.local_information, mine, body.T, body.covariance, LEAST_INFORMATION
        )


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for tracks in a frame, in windows about expected places."""

    tracks: Tracks  # all tracks
    T_world_left: Array  # the camera's pose (4, 4)
    order: NDArray[np.intp]  # rows of the frame's features (F,) by ascending line of the left image
    # their left and right pixels (F, 2), descriptors (F, D), and signs of the Laplacian (F,)
    features: tuple[NDArray, ...]
    dt: float  # time since the previous frame [s]
    config: ObjectsConfig  # settings
    rig: StereoRig  # the cameras
    sigma: float  # pixel noise [px]

    @classmethod
    def of(
        cls, tracks: Tracks, T_world_left: Array, f: StereoFeatures, dt: float, config: ObjectsConfig, rig: StereoRig,
        sigma: float,
    ) -> _Search:  # fmt: skip
        """Among the features f of a frame."""
        arrays = tuple(map(np.ascontiguousarray, (f.uv_left, f.uv_right, f.descriptors, f.laplacian)))
        return cls(tracks, T_world_left, np.argsort(arrays[0][:, 1], kind="stable"), arrays, dt, config, rig, sigma)

    def expected(self, rows: NDArray[np.intp], taken: BoolArray) -> None:
        """Look for tracks where their fit or their body's motion says; see `_look`."""
        c, tracks = self.config, self.tracks
        least = np.where(tracks.doubtful[rows], 0.5 * c.search_limit, c.search_radius)
        self._look(rows, tracks.position[rows], _NONE, least, taken)

    def about(self, rows: NDArray[np.intp], ahead: Array, covariance: Array, taken: BoolArray) -> None:
        """Look for unseen tracks (M,) about places (M, 3) that have a covariance (3, 3); see `_look`."""
        unseen = self.tracks.row[rows] < 0
        if unseen.any():
            least = np.full(len(rows), self.config.search_radius)
            self._look(rows[unseen], ahead[unseen], covariance, least, taken)

    def _look(self, rows: NDArray[np.intp], places: Array, covariance: Array, least: Array, taken: BoolArray) -> None:
        """Look for tracks (M,) about places (M, 3), in windows of some least size (M,) [px].

        Features that are `taken` (F,) are not found; those that are found are entered there.
        """
        c, tracks, rig = self.config, self.tracks, self.rig
        local = (places - self.T_world_left[:3, 3]) @ self.T_world_left[:3, :3]
        z, J = rig.project_stereo(local)
        allowance = _UNEVEN * c.max_speed * self.dt * rig.left.fu / np.maximum(local[:, 2], 1e-3)
        allowance *= np.where(tracks.count(rows) < c.min_frames, 1.0 / _UNEVEN, 1.0)
        tracks.row[rows] = continue_tracks(
            z, J, self.T_world_left, tracks.covariance, covariance, rows, self.sigma, SIGMAS, least, c.search_limit,
            tracks.descriptors, tracks.laplacian, allowance, self.order, *self.features, c.d_match, c.ratio, taken,
        )  # fmt: skip


def _carried_along(
    search: _Search, bodies: Mapping[int, Body], candidates: Sequence[Candidate], taken: BoolArray
) -> None:  # fmt: skip
    """Look for young tracks on what moves where it takes them."""
    c, tracks, dt = search.config, search.tracks, search.dt
    young = _young(tracks, c.min_frames - 1)
    if not len(young):
        return
    places = tracks.position[young]
    for body in bodies.values():
        size = c.margin * body.across
        local = transform(inverse(body.T_before), places)
        on = ((local > body.lower - size) & (local < body.upper + size)).all(axis=1)
        R = body.T[:3, :3]
        search.about(young[on], transform(body.T, local[on]), R @ body.covariance[3:, 3:] @ R.T, taken)
    if not candidates:
        return
    middles = np.array([candidate.state[:3] for candidate in candidates])
    radius = region_radius(np.linalg.norm(middles - search.T_world_left[:3, 3], axis=1), c.size)
    inside = np.linalg.norm(places - middles[:, None], axis=2) < radius[:, None]
    for i in np.flatnonzero(inside.any(axis=1)).tolist():
        on, state, P = inside[i], candidates[i].state, candidates[i].covariance
        search.about(young[on], places[on] + dt * state[3:], dt**2 * P[3:, 3:], taken)


def _young(tracks: Tracks, most: int) -> NDArray[np.intp]:
    """Free tracks that were seen in the last frame, not in this, with no more measurements than `most`."""
    lost = np.flatnonzero((tracks.ids >= 0) & (tracks.row < 0) & (tracks.body < 0) & (tracks.missed == 0))
    return np.asarray(lost[tracks.count(lost) <= most])


def _far(
    tracks: Tracks, T_world_left: Array, features: StereoFeatures, measured: Array, taken: BoolArray, dt: float,
    config: ObjectsConfig, rig: StereoRig, sigma: float,
) -> None:  # fmt: skip
    """Look for tracks without a velocity yet anywhere that `max_speed` allows, in features that are not taken (F,)."""
    left = _young(tracks, config.min_frames)
    free = np.flatnonzero(~taken & np.isfinite(measured[:, 0]))
    if not len(left) or not len(free):
        return
    local = measured[free]
    found = transform(T_world_left, local)
    deviation = local[:, 2] ** 2 * np.sqrt(2.0) * sigma / (rig.left.fu * rig.baseline)
    own = np.trace(tracks.covariance[left], axis1=1, axis2=2)
    start = tracks.position[left]
    squares = (start**2).sum(axis=1)[:, None] + (found**2).sum(axis=1) - 2 * start @ found.T
    allowed = squares < (config.max_speed * dt + SIGMAS * np.sqrt(own[:, None] + deviation**2)) ** 2
    rows, columns = match_far(
        tracks.descriptors[left], tracks.laplacian[left], features, free, allowed, config.wide_d_match,
        config.wide_ratio,
    )  # fmt: skip
    tracks.row[left[rows]] = columns
