"""Following tracks into the next frame: where each is expected, how far off it may be, and which feature it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.objects.bodies import Body
from slam.objects.frame import Frame
from slam.objects.pixel_kernels import best_of_products, continue_tracks, within_reach
from slam.objects.regions import Region
from slam.objects.track_kernels import inverses
from slam.objects.tracks import Tracks

_UNKNOWN = 1e-6  # numerics: on a member's point that has no information yet [1/m²]
_UNEVEN = 0.3  # share of `max_speed` by which a speed may change from frame to frame


def follow(tracks: Tracks, bodies: Mapping[int, Body], regions: list[Region], frame: Frame) -> None:
    """Find each track's feature in this frame; sets rows, descriptors and misses, in place.

    Members of bodies take over their feature's descriptor even if `slam.objects.recovery.located` does not confirm the
    match afterwards, because the body's pose is wrong more often than the match. Members of a body that was not
    measured in the last frame keep theirs: otherwise they would take over descriptors of what occludes the body.

    Tracks are looked for where their fit (or their body's motion) says, in windows as wide as that is uncertain. What
    is left, and was not known for long enough to have a velocity, is looked for where the body or the region takes it
    on which it lies, and then as far as `max_speed` allows.
    Features matched with members of a body that was not measured in the last frame stay available to free tracks until
    the body is located. Otherwise nothing that newly comes into view of such a body would be detected.
    """
    tracks.row[:] = -1
    alive = np.flatnonzero(tracks.ids >= 0)
    _advance(tracks, bodies, alive, frame.dt)
    lost = np.isin(tracks.body[alive], [body.id for body in bodies.values() if body.missed > 1])
    features = frame.features
    if len(alive) and len(features):
        search = _Search.of(tracks, frame)
        taken = np.zeros(len(features), bool)
        search.expected(alive[~lost], taken)
        held = tracks.row[tracks.seen & (tracks.body >= 0)]
        _carried_along(search, bodies, regions, taken)
        _far(tracks, frame, taken)
        if lost.any():
            unclaimed = alive[lost]
            search.expected(unclaimed, np.zeros(len(features), bool))
            tracks.row[unclaimed[np.isin(tracks.row[unclaimed], held)]] = -1
    seen = tracks.seen
    tracks.missed[:] = np.where(seen, 0, tracks.missed + 1)
    seen[alive[lost]] = False
    tracks.descriptors[seen] = features.descriptors[tracks.row[seen]]


def match_far(
    descriptors: NDArray[np.float32], laplacian: NDArray[np.int8], features: StereoFeatures, free: IndexArray,
    allowed: BoolArray, d_match: float, ratio: float,
) -> tuple[IndexArray, IndexArray]:  # fmt: skip
    """Rows of tracks (N) and of features that are each other's best where `allowed` (N, len(free))."""
    if not len(descriptors) or not len(free):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    products = descriptors @ features.descriptors[free].T
    signs = features.laplacian[free]
    best = best_of_products(products, np.ascontiguousarray(allowed), laplacian, signs, d_match, ratio)
    rows = np.flatnonzero(best >= 0)
    return rows, free[best[rows]]


def _advance(tracks: Tracks, bodies: Mapping[int, Body], alive: IndexArray, dt: float) -> None:
    """Where tracks are expected in this frame: positions and covariances move on, in place."""
    moves = alive[(tracks.body[alive] < 0) & tracks.velocity[alive].any(axis=1)]
    tracks.position[moves] += dt * tracks.velocity[moves]
    tracks.covariance[moves] += dt**2 * tracks.velocity_covariance[moves]
    for body in bodies.values():
        mine = np.flatnonzero(tracks.body == body.id)
        R, J = body.T[:3, :3], points_by_pose(tracks.local[mine])
        own = inverses(tracks.local_information[mine], 0.0, _UNKNOWN)
        spread = own + J @ body.covariance @ np.swapaxes(J, 1, 2)
        tracks.position[mine], tracks.covariance[mine] = transform(body.T, tracks.local[mine]), R @ spread @ R.T


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for tracks in a frame, in windows about expected places."""

    tracks: Tracks  # all tracks
    frame: Frame
    order: IndexArray  # rows of the frame's features (F,) by ascending line of the left image
    # their left and right pixels (F, 2), descriptors (F, D), and signs of the Laplacian (F,)
    features: tuple[NDArray, ...]

    @classmethod
    def of(cls, tracks: Tracks, frame: Frame) -> _Search:
        """Among the features of a frame."""
        f = frame.features
        arrays = tuple(map(np.ascontiguousarray, (f.uv_left, f.uv_right, f.descriptors, f.laplacian)))
        return cls(tracks, frame, np.argsort(arrays[0][:, 1], kind="stable"), arrays)

    def expected(self, rows: IndexArray, taken: BoolArray) -> None:
        """Look for tracks where their fit or their body's motion says; see `_look`."""
        c, tracks = self.frame.setup.config, self.tracks
        least = np.where(tracks.doubtful[rows], 0.5 * c.search_limit, c.search_radius)
        self._look(rows, tracks.position[rows], np.zeros((3, 3)), least, taken)

    def about(self, rows: IndexArray, ahead: Array, covariance: Array, taken: BoolArray) -> None:
        """Look for unseen tracks (M,) about places (M, 3) that have a covariance (3, 3); see `_look`."""
        unseen = self.tracks.row[rows] < 0
        if unseen.any():
            least = np.full(len(rows), self.frame.setup.config.search_radius)
            self._look(rows[unseen], ahead[unseen], covariance, least, taken)

    def _look(self, rows: IndexArray, places: Array, covariance: Array, least: Array, taken: BoolArray) -> None:
        """Look for tracks (M,) about places (M, 3), in windows of some least size (M,) [px].

        Features that are `taken` (F,) are not found; those that are found are entered there.
        """
        s, tracks, T = self.frame.setup, self.tracks, self.frame.T_world_left
        c, local = s.config, (places - T[:3, 3]) @ T[:3, :3]
        z, J = s.rig.project_stereo(local)
        allowance = _UNEVEN * c.max_speed * self.frame.dt * s.rig.left.fu / np.maximum(local[:, 2], 1e-3)
        allowance *= np.where(tracks.count(rows) < c.min_frames, 1.0 / _UNEVEN, 1.0)
        tracks.row[rows] = continue_tracks(
            z, J, T, tracks.covariance, covariance, rows, s.sigma, SIGMAS, least, c.search_limit, tracks.descriptors,
            tracks.laplacian, allowance, self.order, *self.features, c.d_match, c.ratio, taken,
        )  # fmt: skip


def _carried_along(search: _Search, bodies: Mapping[int, Body], regions: list[Region], taken: BoolArray) -> None:
    """Look for young tracks on what moves where it takes them."""
    s, tracks, dt = search.frame.setup, search.tracks, search.frame.dt
    young = _young(tracks, s.config.min_frames - 1)
    places = tracks.position[young]
    for body in bodies.values():
        size = s.config.margin * body.across
        local = transform(inverse(body.T_before), places)
        on = ((local > body.lower - size) & (local < body.upper + size)).all(axis=1)
        R = body.T[:3, :3]
        search.about(young[on], transform(body.T, local[on]), R @ body.covariance[3:, 3:] @ R.T, taken)
    for region in regions:
        middle = region.state[:3]
        inside = np.linalg.norm(places - middle, axis=1) < s.radius(np.linalg.norm(middle - search.frame.eye))
        ahead = places[inside] + dt * region.state[3:]
        search.about(young[inside], ahead, dt**2 * region.covariance[3:, 3:], taken)


def _young(tracks: Tracks, most: int) -> IndexArray:
    """Free tracks that were seen in the last frame, not in this, with no more measurements than `most`."""
    lost = np.flatnonzero((tracks.ids >= 0) & (tracks.row < 0) & (tracks.body < 0) & (tracks.missed == 0))
    return np.asarray(lost[tracks.count(lost) <= most])


def _far(tracks: Tracks, frame: Frame, taken: BoolArray) -> None:
    """Look for tracks without a velocity yet anywhere that `max_speed` allows, in features that are not taken (F,)."""
    s, c = frame.setup, frame.setup.config
    left = _young(tracks, c.min_frames)
    free = np.flatnonzero(~taken & np.isfinite(frame.local[:, 0]))
    if not len(left) or not len(free):
        return
    local = frame.local[free]
    found = transform(frame.T_world_left, local)
    deviation = np.sqrt(2.0) * s.depth_noise(local[:, 2])
    own = np.einsum("nii->n", tracks.covariance[left])
    allowed = within_reach(tracks.position[left], found, own, deviation**2, c.max_speed * frame.dt, SIGMAS)
    rows, columns = match_far(
        tracks.descriptors[left], tracks.laplacian[left], frame.features, free, allowed, c.wide_d_match, c.wide_ratio
    )  # fmt: skip
    tracks.row[left[rows]] = columns
