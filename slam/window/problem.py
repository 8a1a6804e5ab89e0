"""What a window is: poses, points, what was measured, and what is known besides. Frozen dataclasses of arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from slam.geometry.arrays import Array, IndexArray, Table
from slam.window import chart_kernels, kernels, terms
from slam.window.stereo import RectifiedStereo

KNOWN, ELIMINATED = terms.KNOWN, terms.ELIMINATED


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
        return cls(np.full(n, pose), point, z, np.tile(np.eye(3) / sigma, (n, 1, 1)))

    @classmethod
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
    def none(cls) -> RelativePrior:
        """Nothing is known."""
        none = np.zeros(0, np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.eye(4), np.zeros((0, 4, 4))
        return cls(*none, np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)))


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
    """

    stereo: RectifiedStereo
    poses: Array
    points: Array
    rows: Rows
    free: np.ndarray | None = None
    known: np.ndarray | None = None
    mean: Array | None = None
    information: Array | None = None
    places: Places = field(default_factory=Places.none)
    motion: Motion = field(default_factory=Motion.none)
    prior: RelativePrior = field(default_factory=RelativePrior.none)
    joining: IndexArray = field(default_factory=lambda: np.zeros(0, np.intp))

    @cached_property
    def members(self) -> IndexArray:
        """Points that are unknowns: those of the prior, then those that join (D + J,)."""
        return np.concatenate([self.prior.points, self.joining])

    @cached_property
    def basis(self) -> Array:
        """Charts of `members` in the first pose's axes (D + J, 3, 3)."""
        if not len(self.joining):
            return self.prior.basis
        return np.concatenate(
            [self.prior.basis, chart_kernels.relative_charts(self.poses[0], self.points[self.joining])[0]]
        )

    @cached_property
    def place(self) -> IndexArray:
        """What each point is to the solver (N,), see `slam.window.kernels`."""
        place = np.full(len(self.points), ELIMINATED)
        if self.known is not None:
            place[self.known] = KNOWN
        place[self.members] = np.arange(len(self.members))
        return place

    @cached_property
    def column(self) -> IndexArray:
        """First unknown of each pose (K,), −1 for a fixed one."""
        first = 3 * len(self.members)
        if self.free is None:
            return first + 6 * np.arange(len(self.poses))
        column = np.full(len(self.poses), -1)
        column[self.free] = first + 6 * np.arange(int(self.free.sum()))
        return column

    @cached_property
    def unknowns(self) -> int:
        """Number of unknowns, without the points that are eliminated."""
        return 3 * len(self.members) + 6 * int((self.column >= 0).sum())

    @cached_property
    def by_point(self) -> tuple[IndexArray, IndexArray]:
        """Rows, then places, by point: see `slam.window.kernels.by_point`."""
        first, order = kernels.by_point(np.concatenate([self.rows.point, self.places.point]), len(self.points))
        return first, order

    @cached_property
    def pose_of(self) -> IndexArray:
        """Pose of each row, then of each place."""
        return np.concatenate([self.rows.pose, self.places.pose])

    def at(self, poses: Array, points: Array, rows: Rows | None = None) -> Window:
        """With other values of the poses and points, and other measurements from the same poses of the same points."""
        moved = object.__new__(Window)  # what was derived does not depend on these
        moved.__dict__.update(self.__dict__, poses=poses, points=points, rows=self.rows if rows is None else rows)
        return moved
