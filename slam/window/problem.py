"""What a window is: poses, points, what was measured, and what is known besides. Frozen dataclasses of arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from slam.geometry.arrays import Array, BoolArray, IndexArray, Table
from slam.window import chart_kernels, terms
from slam.window.stereo import RectifiedStereo

KNOWN, ELIMINATED = terms.KNOWN, terms.ELIMINATED
_ANY = np.zeros(0, bool)  # fixed: a mask that is not given


@dataclass(frozen=True, eq=False)
class Rows(Table):
    """Measurements of points from poses, a row each."""

    pose: IndexArray  # indices of the pose (M,)
    point: IndexArray  # and of the point (M,)
    z: Array  # as `RectifiedStereo.measure` gives them (M, 3) = (uL, vL, uR) [px]; uR NaN: there is no right pixel
    root: Array  # inverse Cholesky factors of the noise's covariances (M, 3, 3) [1/px]; 0 for a row that does not count

    @classmethod
    def of(cls, pose: IndexArray | int, point: IndexArray, z: Array, sigma: float) -> Rows:
        """Measurements with independent noise of each pixel, `sigma` [px], from one pose or from poses (M,)."""
        n = len(point)
        root = np.zeros((n, 3, 3))
        root[:] = np.eye(3) / sigma
        return cls(np.full(n, pose), point, z, root)

    @classmethod
    @cache
    def none(cls) -> Rows:
        """No measurement."""
        return cls(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True, eq=False)
class Places(Table):
    """Points that are known relative to a pose, a row each; the error of their inverse distance is Gaussian."""

    pose: IndexArray  # indices of the pose (Q,)
    point: IndexArray  # and of the point (Q,)
    basis: Array  # the chart in the pose's axes (Q, 3, 3)
    origin: Array  # the point's coordinates in it (Q, 3)
    root: Array  # square root of its information there (Q, 3, 3)

    @classmethod
    @cache
    def none(cls) -> Places:
        """No such point."""
        none = np.zeros(0, np.intp)
        return cls(none, none, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True, eq=False)
class Motion:
    """Constant velocity, disturbed by noise: a row for each two successive intervals (paper B, section 2).

    Of the poses or, with `cameras`, of a body past which a known camera moves: see `slam.window.terms.add_motion`.
    """

    poses: IndexArray  # three successive poses (V, 3); −1 first where there is none
    interval: Array  # times between them (V, 2) [s]
    mean: Array  # of the velocity's change [ω, v] (V, 6), or of the velocity where the first pose is −1
    variance: Array  # likewise
    # T_world_left (K, 4, 4) of the window's poses, which are T_body_left; none: the motion is that of the poses
    cameras: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of the cameras together (6 K, 6 K)

    @property
    def arrays(self) -> tuple[Any, ...]:
        """All of them, as compiled code takes them."""
        return tuple(vars(self).values())

    @classmethod
    @cache
    def none(cls) -> Motion:
        """No motion model."""
        return cls(np.zeros((0, 3), np.intp), np.zeros((0, 2)), np.zeros((0, 6)), np.zeros((0, 6)))

    def select(self, keep: Any) -> Motion:
        """Some of the rows (a mask or indices)."""
        return Motion(*(column[keep] for column in self.arrays[:4]), *self.arrays[4:])

    def joined(self, other: Motion) -> Motion:
        """These rows, then others."""
        return Motion(*(np.concatenate(pair) for pair in zip(self.arrays[:4], other.arrays[:4])), *self.arrays[4:])


@dataclass(frozen=True, eq=False)
class RelativePrior:
    """A Gaussian on the first poses and some points relative to the first pose, and on that pose in the world.

    A run goes on for longer than its place in the world is known well, so what stays may move by metres as one. A prior
    on each in the world would then be off by the square of the turn times the distance, and bend a stiff block of poses
    and points. This one does not change where all of them move together; what is known of the place in the world is
    held by the first pose alone.

    With δ = [coordinates of each point in its chart, Log(T⁻¹ T₀), Log(M_i⁻¹ T₀⁻¹ T_i)] of the points and poses as they
    are, it costs ``δᵀ Λ δ − 2 ηᵀ δ``.
    """

    points: IndexArray  # indices of its points (D,)
    basis: Array  # their charts in the first pose's axes (D, 3, 3)
    origin: Array  # their coordinates there (D, 3)
    T: Array  # where the first pose stood (4, 4)
    relative: Array  # where each pose stood before the first (P, 4, 4); the first is the identity
    information: Array  # Λ (m, m), m = 3 D + 6 P
    vector: Array  # η (m,)
    by_rig: Array  # derivatives of η by errors of the rig, a column each

    @classmethod
    def of_pose(cls, T: Array, covariance: Array, by_rig: Array | None = None) -> RelativePrior:
        """The first pose is T (4, 4) with a covariance (6, 6), and derivative (6, m) by m errors of the rig."""
        none, information = np.zeros(0, np.intp), np.linalg.inv(covariance)
        information = 0.5 * (information + information.T)
        by_rig = np.zeros((6, 0)) if by_rig is None else information @ by_rig
        one = np.eye(4)[None]
        return cls(none, np.zeros((0, 3, 3)), np.zeros((0, 3)), T, one, information, np.zeros(6), by_rig)

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All but the last."""
        return tuple(vars(self).values())[:-1]

    @classmethod
    @cache
    def none(cls) -> RelativePrior:
        """Nothing is known."""
        none = np.zeros(0, np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.eye(4), np.zeros((0, 4, 4))
        return cls(*none, np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)))


class Layout(NamedTuple):
    """Where a window's unknowns stand: points of the prior and those that join, then free poses; and its rows by point.

    Rows are those of measurements, then those of `Places`; of point p they are ``order[first[p]:first[p + 1]]``.
    """

    column: IndexArray  # first unknown of each pose (K,), −1 for a fixed one
    place: IndexArray  # what each point is to the solver (N,): `KNOWN`, `ELIMINATED`, or its place among the unknowns
    basis: Array  # charts of points that are unknowns, in the first pose's axes (D + J, 3, 3)
    prior: IndexArray  # unknown of each of the prior's numbers (m,)
    pose_of: IndexArray  # pose of each row (M + Q,)
    first: IndexArray  # (N + 1,)
    order: IndexArray  # (M + Q,)
    poses: int  # where the poses' unknowns begin
    asked: int  # where those of points begin whose covariances are asked for
    free: int  # how many poses are unknown

    @property
    def unknowns(self) -> int:
        """How many there are, without the points that are eliminated."""
        return self.poses + 6 * self.free


@dataclass(frozen=True, eq=False)
class Window:
    """A few poses, many points, and what is known of them.

    Attributes:
        stereo: the rectified rig that measures.
        poses: T_world_left (K, 4, 4).
        points: in world coordinates (N, 3) [m]; those that nothing measures take no part.
        rows: measurements.
        free: which poses are unknown (K,); None for all. Those of the prior must be.
        known: which points are exact (N,); None for none.
        mean, information: independent priors of points in world coordinates (N, 3), (N, 3, 3) [1/m²], zero for none;
            None for no point.
        places: points that are known relative to a pose.
        motion: constant velocity between successive poses, or of what the points belong to.
        prior: what is known of the first poses and of some points together.
        joining: points that are unknowns beside those of the prior (J,), instead of being eliminated.
        asked: of which points covariances will be asked for (N,); None for all. Each costs time.
    """

    stereo: RectifiedStereo
    poses: Array
    points: Array
    rows: Rows
    free: BoolArray | None = None
    known: BoolArray | None = None
    mean: Array | None = None
    information: Array | None = None
    places: Places = field(default_factory=Places.none)
    motion: Motion = field(default_factory=Motion.none)
    prior: RelativePrior = field(default_factory=RelativePrior.none)
    joining: IndexArray = field(default_factory=lambda: np.zeros(0, np.intp))
    asked: BoolArray | None = None

    @cached_property
    def layout(self) -> Layout:
        """Where unknowns stand, and which rows are of which point."""
        prior, joining = self.prior, self.joining
        members, basis = prior.points, prior.basis
        if len(joining):
            own, _ = chart_kernels.relative_charts(self.poses[0], self.points[joining])
            members, basis = np.concatenate([members, joining]), np.concatenate([basis, own])
        skipped = 0
        if self.asked is not None:
            asked = self.asked[members]
            order, skipped = np.argsort(asked, kind="stable"), len(asked) - int(np.count_nonzero(asked))
            members, basis = members[order], basis[order]
        known, free = (_ANY if mask is None else mask for mask in (self.known, self.free))
        column, place, to, pose_of, first, order, n = terms.arranged(
            len(self.poses), free, len(self.points), known, members, prior.points, len(prior.relative),
            self.rows.arrays[:2], self.places.arrays[:2],
        )  # fmt: skip
        at = 3 * len(members)
        return Layout(column, place, basis, to, pose_of, first, order, at, 3 * skipped, (n - at) // 6)

    @property
    def knowledge(self) -> tuple[Any, ...]:
        """What compiled code adds up: rows, places, priors of points in the world, motion, prior."""
        mean = np.zeros((0, 3)) if self.mean is None else self.mean
        information = np.zeros((0, 3, 3)) if self.information is None else self.information
        return self.rows.arrays, self.places.arrays, (mean, information), self.motion.arrays, self.prior.arrays

    def at(self, poses: Array, points: Array, rows: Rows | None = None) -> Window:
        """With other values of the poses and points, and other measurements from the same poses of the same points."""
        moved = object.__new__(Window)  # the layout does not depend on these
        moved.__dict__.update(self.__dict__, poses=poses, points=points, rows=self.rows if rows is None else rows)
        return moved
