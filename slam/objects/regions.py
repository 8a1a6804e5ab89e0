"""Which tracks moved together, relative to the rest of the scene: a test that a wrong camera pose does not affect.

Each track brings a displacement ``d_i`` (3,): where its last few frames see it, less where the frames before did. A
camera pose that is off moves all still points by one small rigid motion ``d_i = ρ + θ × (p_i − c)``; so does a body's
own motion, but for its points alone. Therefore no displacement is tested by itself: the tracks inside a window of
directions and depths, for windows of every size, are tested against the rest of them. The common motion that the window
says and the one that the rest says are compared with the covariance of both,

    (ξ_w − ξ_r)ᵀ (Λ_w⁻¹ + Λ_r⁻¹)⁻¹ (ξ_w − ξ_r)  ~  χ²(6),

Λ being sums of ``Jᵀ W J`` over the tracks. It matters if a body fills most of the near view: then the camera's
estimated pose follows the body, and the still world seems to move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import chi_square_limit
from slam.data import BoolArray
from slam.geometry.arrays import median
from slam.geometry.se3 import Array, hat
from slam.objects import scene_kernels as kernels
from slam.objects.displacements import Displacements
from slam.objects.tracks import times_vectors

_PULL = 16.0  # no track brings more χ² than this: single false ones find no company
_ROUNDS = (3, 2)  # numerics: of reweighting: Huber's first, which has one minimum, then a sharper one
_LARGEST = 0.4  # share of all tracks that a body may have: the still world has most
_PRIOR = np.array([1e-4] * 3 + [1e-6] * 3)  # keeps Λ of nearly collinear tracks invertible [1/rad², 1/m²]
_FITS = 14.2  # derived: χ²(3) at 99.7 % of a member and its group's motion
_BETTER = 4.0  # by how much χ² a member must fit its group's motion better than the rest's, and
_BETTER_AROUND = 6.0  # where it lies outside the window
_EXPLAINED = 0.25  # share of χ² that the common motion may leave: an uneven motion is seen by tracks unevenly
_TAIL = 3.0  # tracks; see `limit`
_MEDIAN = chi_square_limit(3, 0.5)  # of χ²(3), and
_UPPER_QUARTILE = chi_square_limit(3, 0.75)  # its upper quartile
_SIZES = np.array([[0.1, 0.1, 0.2], [0.2, 0.2, 0.4], [0.4, 0.4, 0.8]])  # of windows: x/z, y/z, logarithm of the depth
_AROUND = 1.0  # how far beyond its window a group's tracks are looked for, in widths of the window
_MOST = 20  # cost: windows looked into for the next group


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that moved alike, and otherwise than the rest.

    Attributes:
        members: their rows (K,).
        test: χ²(6) of their motion against the rest's.
        away: how far they went against the rest, in the mean [m].
    """

    members: NDArray[np.intp]
    test: float
    away: float

    def moves(self, test: float, away: float) -> bool:
        """Whether it went farther than `away` [m] and moved for certain: by a χ²(6) above `limit` of `test`."""
        return bool(self.away > away and self.test > limit(test, len(self.members)))


@dataclass(frozen=True, eq=False)
class Scene:
    """What the displacements say.

    Attributes:
        groups: those that moved on their own, the clearest first.
        alone: χ²(3) of every track's displacement against the rest's common motion (N,).
        common: the motion ξ (6,) of the rest in a frame, by the error of the camera's motion, and
        covariance: its covariance (6, 6).
    """

    groups: list[Group]
    alone: Array
    common: Array
    covariance: Array


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
        return Scene([], np.zeros(n), np.zeros(6), np.diag(1.0 / _PRIOR))
    problem = _Problem.of(moved)
    windows = _Windows.over(place, support)
    rest: BoolArray = np.ones(n, bool)
    groups: list[Group] = []
    while True:
        alone = problem.squares(problem.common_motion(rest))
        scale = max(least_scale, median(alone[rest]) / _MEDIAN)
        alone = alone / scale
        group = _next_group(problem, windows, place, alone, scale, rest, test, support)
        if group is not None:
            groups.append(group)
            rest[group.members] = False
        if group is None or rest.sum() < n / 3:
            break
    heavier = tail(alone[rest])  # of what is in no group: before, other groups would be part of it
    groups = [replace(group, test=group.test / heavier) for group in groups]
    groups = [group for group in groups if group.test > limit(test, len(group.members))]
    return Scene(groups, alone, problem.common_motion(rest), scale * heavier * problem.covariance(rest))


def tail(alone: Array) -> float:
    """How much heavier the tail of tracks' χ²(3) is than it should be, 1 at least.

    The errors of a track last for some frames where a camera goes around what it sees, and those of false tracks are
    of any size. Where that is so in the whole scene, small groups of such tracks agree by chance.
    """
    return max(1.0, float(np.quantile(alone, 0.75)) / _UPPER_QUARTILE) if len(alone) else 1.0


def _next_group(
    problem: _Problem, windows: _Windows, place: Array, alone: Array, scale: float, rest: BoolArray, test: float,
    support: int,
) -> Group | None:  # fmt: skip
    """The group in the clearest window whose tracks hold together; None where there is none."""
    doubted = ~rest
    for window, value in _clearest(windows, problem, alone, scale, rest, test, support):
        seeds = windows.inside(window, len(rest)) & ~doubted
        if seeds.sum() < support:
            continue
        common = problem.common_motion(rest & ~seeds)
        near = rest & windows.around(window, place)
        members = _members(problem, seeds, near, problem.squares(common) / scale, scale, support)
        if len(members) >= support:
            return Group(members, value, problem.mean_gap(members, common))
        doubted |= seeds
    return None


@dataclass(frozen=True, eq=False)
class _Problem:
    """Displacements as a linear problem in a common motion ξ = [θ, ρ] (6,): each track's normal equations.

    The χ² of a track is ``dᵀ W d − 2 ηᵀ ξ + ξᵀ Λ ξ``, with ``Λ = Jᵀ W J`` (N, 21: the lower triangle), ``η = Jᵀ W d``
    (N, 6). The motion is by frame, so that J grows with the lag.
    """

    moved: Displacements
    L: Array
    eta: Array
    dWd: Array

    @classmethod
    def of(cls, moved: Displacements) -> _Problem:
        """Of displacements."""
        return cls(moved, *kernels.normal_equations(moved.points, moved.d, moved.W, moved.lag))

    def common_motion(self, rows: BoolArray) -> Array:
        """The motion (6,) on which tracks agree, by robust least squares."""
        return np.asarray(kernels.common_motion(self.L, self.eta, self.dWd, rows, _PRIOR, _PULL, *_ROUNDS))

    def covariance(self, rows: BoolArray) -> Array:
        """Covariance (6, 6) of the common motion of some tracks."""
        information = np.zeros((6, 6))
        information[np.tril_indices(6)] = self.L[rows].sum(axis=0)
        information += np.tril(information, -1).T + np.diag(_PRIOR)
        return np.linalg.inv(information)

    def squares(self, common: Array) -> Array:
        """χ²(3) of every displacement (N,) against a common motion."""
        return np.asarray(kernels.squares_against(self.L, self.eta, self.dWd, common))

    def mean_gap(self, rows: NDArray[np.intp], common: Array) -> float:
        """How far tracks went against a common motion, in the weighted mean [m]."""
        moved, W = self.moved, self.moved.W[rows]
        shift = moved.points[rows] @ hat(common[:3]).T + common[3:]
        gap = moved.d[rows] - moved.lag[rows, None] * shift
        mean = np.linalg.solve(W.sum(axis=0), times_vectors(W, gap).sum(axis=0))
        return float(np.linalg.norm(mean))


@dataclass(frozen=True, eq=False)
class _Windows:
    """Windows of directions and depths with enough tracks.

    Attributes:
        starts: where the tracks of each window begin in `tracks` (M + 1,).
        tracks: those of the first window, of the second, and so on.
        centres, widths: of the windows (M, 3).
    """

    starts: NDArray[np.int64]
    tracks: NDArray[np.int64]
    centres: Array
    widths: Array

    @classmethod
    def over(cls, place: Array, support: int) -> _Windows:
        """Windows of every size, each half a width from the next, along every axis."""
        return cls(*kernels.full_windows(place, _SIZES, support))

    def inside(self, window: int, count: int) -> BoolArray:
        """Which of `count` tracks are inside a window."""
        inside = np.zeros(count, bool)
        inside[self.tracks[self.starts[window] : self.starts[window + 1]]] = True
        return inside

    def around(self, window: int, place: Array) -> BoolArray:
        """Which tracks are inside a window or near it (N,)."""
        near = np.abs(place - self.centres[window]) < (0.5 + _AROUND) * self.widths[window]
        return np.asarray(near[:, 0] & near[:, 1] & near[:, 2])


def _clearest(
    windows: _Windows, problem: _Problem, alone: Array, scale: float, rest: BoolArray, test: float, support: int
) -> list[tuple[int, float]]:
    """Windows that differ enough from the rest of the scene, and their χ²(6), the clearest first."""
    weight = np.minimum(1.0, _PULL / np.maximum(alone, 1e-9))
    asked = limit(test, np.arange(len(rest) + 1, dtype=np.intp))
    values, clear = kernels.window_tests(
        windows.starts, windows.tracks, problem.L, problem.eta, weight / scale, weight * alone, rest, asked, support,
        _LARGEST * rest.sum(), _PRIOR,
    )  # fmt: skip
    order = np.argsort(-clear, kind="stable")[:_MOST]
    return [(int(i), float(values[i])) for i in order if clear[i] > 0]


def _members(
    problem: _Problem, seeds: BoolArray, near: BoolArray, alone: Array, scale: float, support: int
) -> NDArray[np.intp]:
    """Tracks that fit the motion of a window's tracks (`seeds`), and better than the rest's, in it or `near` it."""
    members: BoolArray = seeds
    asked = np.where(seeds, _BETTER, _BETTER_AROUND)
    for _ in range(2):
        if members.sum() < support:
            break
        fits = problem.squares(problem.common_motion(members)) / scale
        fit = (fits < np.maximum(_FITS, _EXPLAINED * alone)) & (alone - fits > asked)
        members = np.logical_and(near, fit)
    return np.flatnonzero(members)
