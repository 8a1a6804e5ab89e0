"""Which tracks moved together, relative to the rest of the scene: a test that a wrong camera pose does not affect.

Each track brings a displacement ``d_i`` (3,): where its last few frames see it, less where the frames before did. A
camera pose that is off moves all still points by one small rigid motion ``d_i = ρ + θ × (p_i − c)``; so does a body's
own motion, but for its points alone. Therefore no displacement is tested by itself: the tracks inside a window of
directions and depths, for windows of every size, are tested against the rest of them. The common motion that the window
says and the one that the rest says are compared with the covariance of both,

    (ξ_w − ξ_r)ᵀ (Λ_w⁻¹ + Λ_r⁻¹)⁻¹ (ξ_w − ξ_r)  ~  χ²(6),

Λ being sums of ``Jᵀ W J`` over the tracks. The χ² of a track is ``dᵀ W d − 2 ηᵀ ξ + ξᵀ Λ ξ`` with ``η = Jᵀ W d``; J
grows with the lag, so that ξ is a motion by frame. It matters if a body fills most of the near view: then the camera's
estimated pose follows the body, and the still world seems to move.

The test is made of all free tracks in the world, and of the tracks on a body in that body's axes, where what moves
otherwise is a part of it: a lid on its hinge, for instance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from slam.bodies import scene_kernels as kernels
from slam.bodies.fits import times_vectors
from slam.bodies.track_kernels import displaced
from slam.chi_square import chi_square_limit
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array, hat
from slam.tracks.table import Tracks

LAG = 4  #: frames between the older and the recent measurements, about
_RECENT = 5  # frames that are recent, at most; of short tracks the later half
FARTHEST = 4.0  #: a track's depth must be so many times its deviation
_TAIL = 3.0  # tracks; see `limit`
_UPPER_QUARTILE = chi_square_limit(3, 0.75)  # of χ²(3)
_SIZES = np.array([[0.1, 0.1, 0.2], [0.2, 0.2, 0.4], [0.4, 0.4, 0.8]])  # of windows: x/z, y/z, logarithm of the depth
_HALVES = 0.5 * np.array(list(product((0, 1), repeat=3)))  # of a width, by which windows of a size are apart
_CELLS = 2**12  # numerics: more than there are windows along an axis


@dataclass(frozen=True, eq=False)
class Displacements:
    """How tracks moved from the older to the recent frames, a row each."""

    points: Array  # where they are (N, 3), relative to the camera, in world axes [m]
    d: Array  # displacements (N, 3) [m]
    W: Array  # their information (N, 3, 3)
    lag: Array  # frames between the older and the recent measurements, in the mean (N,)


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that moved alike, and otherwise than the rest."""

    members: IndexArray  # their rows (K,)
    test: float  # χ²(6) of their motion against the rest's
    away: float  # how far they went against the rest, in the mean [m]

    def moves(self, test: float, away: float) -> bool:
        """Whether it went farther than `away` [m] and moved for certain: by a χ²(6) above `limit` of `test`."""
        return bool(self.away > away and self.test > limit(test, len(self.members)))


@dataclass(frozen=True, eq=False)
class Scene:
    """What the displacements say."""

    groups: list[Group]  # those that moved on their own, the clearest first
    alone: Array  # χ²(3) of every track's displacement against the rest's common motion (N,)
    common: Array  # the motion ξ (6,) of the rest in a frame, by the error of the camera's motion
    covariance: Array  # its covariance (6, 6)

    @property
    def rest(self) -> BoolArray:
        """Which tracks are in no group (N,)."""
        rest = np.ones(len(self.alone), bool)
        for group in self.groups:
            rest[group.members] = False
        return rest


def displacements(
    tracks: Tracks, rows: IndexArray, ages: IndexArray, centres: Array, slide: float,
    body: tuple[Array, Array, BoolArray] | None = None,
) -> Displacements:  # fmt: skip
    """How far tracks (N,) went in the world, or in the axes of a body, given what they measured in these.

    The window's slots have `ages` (W,) in frames, and the camera was at `centres` (W, 3); `slide` is the variance of a
    feature's direction with the angle from which it is seen [rad].
    """
    t = tracks
    rays = t.position[rows] - centres[int(np.argmin(ages))]
    if body is None:
        older = t.older_A, t.older_b, t.older_age
        return Displacements(rays, *displaced(t.A, t.p, t.dof, *older, rows, ages, _RECENT, rays, centres, slide))
    points, A, known = body
    n = len(rows)
    none = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n)
    dof = np.where(known, t.dof[rows], 0).astype(np.int8)
    points = np.where(known[..., None], points, 0.0)
    return Displacements(rays, *displaced(A, points, dof, *none, np.arange(n), ages, _RECENT, rays, centres, 0.0))


def known_well(tracks: Tracks, rows: IndexArray, T_world_left: Array, min_frames: int) -> tuple[IndexArray, Array]:
    """Those of the tracks (K,) seen in enough frames whose depth is known, and where: x/z, y/z, log z (K, 3)."""
    rows = rows[tracks.count(rows) >= min_frames]
    local = (tracks.position[rows] - T_world_left[:3, 3]) @ T_world_left[:3, :3]
    variance = np.einsum("nii->n", tracks.covariance[rows])
    known = local[:, 2] > FARTHEST * np.sqrt(np.where(variance < 0, np.inf, variance))  # below 0 by rounding alone
    return rows[known], places_in_view(local[known])


def places_in_view(local: Array) -> Array:
    """Where points (N, 3) in camera coordinates are seen: x/z, y/z, log z (N, 3)."""
    return np.column_stack([local[:, :2] / local[:, 2:], np.log(local[:, 2])])


def limit(test: float, size: IndexArray | int) -> Array:
    """χ²(6) from which a group of so many tracks moved: small groups have the heavier tails of single tracks."""
    return test * (1.0 + _TAIL / np.maximum(size, 1.0))


def classify_scene(moved: Displacements, place: Array, test: float, support: int, least_scale: float = 1.0) -> Scene:
    """Groups of `support` tracks at least that moved on their own, and every track's displacement against the rest.

    Tracks are seen at `place` (N, 3): x/z, y/z, log z; `test` is the χ²(6) from which a large group moved. Every χ² is
    divided by the ratio of the rest's median to what it should be, and by `least_scale` at least.
    """
    n = len(moved.d)
    if n < 3 * support:
        return Scene([], np.zeros(n), np.zeros(6), np.diag(1.0 / kernels.PRIOR))
    L, eta, dWd = kernels.normal_equations(moved.points, moved.d, moved.W, moved.lag)
    asked = limit(test, np.arange(n + 1, dtype=np.intp))
    group, values, alone, common, scale = kernels.groups_apart(
        L, eta, dWd, place, *_full_windows(place, support), asked, support, least_scale
    )  # fmt: skip
    rest = group < 0
    heavier = tail(alone[rest])  # of what is in no group: before, other groups would be part of it
    found = [(np.flatnonzero(group == k), value / heavier) for k, value in enumerate(values.tolist())]
    groups = [
        Group(members, value, _mean_gap(moved, members, common))
        for members, value in found
        if value > limit(test, len(members))
    ]
    information = np.zeros((6, 6))
    information[np.tril_indices(6)] = L[rest].sum(axis=0)
    information += np.tril(information, -1).T + np.diag(kernels.PRIOR)
    return Scene(groups, alone, common, scale * heavier * np.linalg.inv(information))


def _full_windows(place: Array, support: int) -> tuple[IndexArray, IndexArray, Array, Array]:
    """Windows with enough tracks, of every size, each half a width from the next along every axis.

    As starts (M + 1,) of the windows in the list of their tracks, that list, and centres and widths (M, 3).
    """
    at = place.T[:, None, None] / _SIZES.T[:, :, None, None] + [[0.0], [0.5]]
    x, y, z = np.clip(np.floor(at).astype(np.int64) + _CELLS // 2, 0, _CELLS - 1)  # (S, 2, N) each, the 2 of offsets
    kind = np.arange(len(_SIZES) * len(_HALVES)).reshape(-1, 2, 2, 2, 1)
    code = ((kind * _CELLS + x[:, :, None, None]) * _CELLS + y[:, None, :, None]) * _CELLS + z[:, None, None]
    bits = len(place).bit_length()
    ordered = np.sort(((code << bits) + np.arange(len(place))).reshape(-1))  # quicker than to sort by code and stably
    code, tracks = ordered >> bits, ordered & ((1 << bits) - 1)
    first = np.flatnonzero(np.append(True, code[1:] != code[:-1]))
    count = np.diff(np.append(first, len(code)))
    full = count >= support
    code = code[first[full], None]
    kind = code[:, 0] // _CELLS**3
    size, half = _SIZES[kind // len(_HALVES)], _HALVES[kind % len(_HALVES)]
    centres = (code // _CELLS ** np.array([2, 1, 0]) % _CELLS - _CELLS // 2 + 0.5 - half) * size
    return np.append(0, np.cumsum(count[full])).astype(np.intp), tracks[np.repeat(full, count)], centres, size


def _mean_gap(moved: Displacements, rows: IndexArray, common: Array) -> float:
    """How far tracks went against a common motion, in the weighted mean [m]."""
    W = moved.W[rows]
    gap = moved.d[rows] - moved.lag[rows, None] * (moved.points[rows] @ hat(common[:3]).T + common[3:])
    return float(np.linalg.norm(np.linalg.solve(W.sum(axis=0), times_vectors(W, gap).sum(axis=0))))


def tail(alone: Array) -> float:
    """How much heavier the tail of tracks' χ²(3) is, 1 at least: small groups agree by chance then."""
    return max(1.0, float(np.quantile(alone, 0.75)) / _UPPER_QUARTILE) if len(alone) else 1.0
