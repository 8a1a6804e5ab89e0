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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import chi_square_limit
from slam.geometry.se3 import Array, hat
from slam.objects import scene_kernels as kernels
from slam.objects.displacements import Displacements
from slam.objects.tracks import times_vectors

_TAIL = 3.0  # tracks; see `limit`
_UPPER_QUARTILE = chi_square_limit(3, 0.75)  # of χ²(3)
_SIZES = np.array([[0.1, 0.1, 0.2], [0.2, 0.2, 0.4], [0.4, 0.4, 0.8]])  # of windows: x/z, y/z, logarithm of the depth


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that moved alike, and otherwise than the rest."""

    members: NDArray[np.intp]  # their rows (K,)
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


def limit(test: float, size: NDArray[np.intp] | int) -> Array:
    """χ²(6) from which a group of so many tracks moved: small groups have the heavier tails of single tracks."""
    return test * (1.0 + _TAIL / np.maximum(size, 1.0))


def classify_scene(moved: Displacements, place: Array, test: float, support: int, least_scale: float = 1.0) -> Scene:
    """Groups that moved on their own, and every track's displacement against the rest.

    Args:
        moved: displacements of the tracks.
        place: where tracks are seen (N, 3): x/z, y/z, and log z.
        test: χ²(6) from which a large group moved; see `limit`.
        support: least number of tracks in a group.
        least_scale: every χ² is divided by the ratio of the rest's median to what it should be, and by this at least;
            below 1 the noise may turn out smaller than modelled.
    """
    n = len(moved.d)
    if n < 3 * support:
        return Scene([], np.zeros(n), np.zeros(6), np.diag(1.0 / kernels.PRIOR))
    L, eta, dWd = kernels.normal_equations(moved.points, moved.d, moved.W, moved.lag)
    windows = kernels.full_windows(place, _SIZES, support)
    asked = limit(test, np.arange(n + 1, dtype=np.intp))
    group, values, alone, common, scale = kernels.groups_apart(
        L, eta, dWd, place, *windows, asked, support, least_scale
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


def _mean_gap(moved: Displacements, rows: NDArray[np.intp], common: Array) -> float:
    """How far tracks went against a common motion, in the weighted mean [m]."""
    W = moved.W[rows]
    gap = moved.d[rows] - moved.lag[rows, None] * (moved.points[rows] @ hat(common[:3]).T + common[3:])
    return float(np.linalg.norm(np.linalg.solve(W.sum(axis=0), times_vectors(W, gap).sum(axis=0))))


def tail(alone: Array) -> float:
    """How much heavier the tail of tracks' χ²(3) is than it should be, 1 at least.

    The errors of a track last for some frames where a camera goes around what it sees, and those of false tracks are
    of any size. Where that is so in the whole scene, small groups of such tracks agree by chance.
    """
    return max(1.0, float(np.quantile(alone, 0.75)) / _UPPER_QUARTILE) if len(alone) else 1.0
