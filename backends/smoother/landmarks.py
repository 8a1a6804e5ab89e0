"""The smoother's landmarks: what was measured of each lately, and where that puts it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from backends.smoother import kernels
from slam.data import BoolArray, IdArray, IndexArray
from slam.geometry.arrays import LandmarkRows
from slam.geometry.se3 import Array, points_by_pose
from slam.window.stereo import RectifiedStereo

RECENT = 12  # cost: so many of its last measurements give a landmark's position and covariance


@dataclass(frozen=True, eq=False)
class SmootherLandmarks(LandmarkRows):
    """The map, a row for each landmark."""

    serial: IdArray  # number of each in the order of their coming (S,); an id may come back, a serial number not
    position: Array  # in world coordinates (S, 3) [m]
    own: Array  # its covariance where all poses are known (S, 3, 3) [m²], in world axes
    away: Array  # what the camera's drift adds to that since it was last measured (S, 3, 3) [m²]
    mean: Array  # what was known of it besides its measurements, in world coordinates: position (S, 3) [m]
    information: Array  # and information (S, 3, 3) [1/m²], zero for nothing
    world: BoolArray  # whether that does not depend on any pose (S,)
    z: Array  # its last measurements (S, RECENT, 3)
    pose: IndexArray  # and the numbers of their poses (S, RECENT), −1 for none
    since: IndexArray  # tick (`SmootherState.ticks`) from which the span of its smart factor counts (S,)
    variable: BoolArray  # whether it stays a variable of the graph instead (S,); known ones begin as variables anyway
    linearised: Array  # where the graph has it linearised, if it is a variable (S, 3) [m]
    by_rig: Array  # derivatives of the positions by errors of the rig (S, 3, m)

    @classmethod
    def of(
        cls, ids: IdArray, serial: int, position: Array, own: Array, information: Array, world: bool, by_rig: Array
    ) -> Self:
        """Landmarks that are known, but not measured yet; `serial` is the first one's number."""
        n = len(ids)
        return cls(
            ids, serial + np.arange(n), position, own, np.zeros((n, 3, 3)), position, information, np.full(n, world),
            np.full((n, RECENT, 3), np.nan), np.full((n, RECENT), -1), np.zeros(n, np.intp), np.zeros(n, bool),
            position, by_rig,
        )  # fmt: skip

    @classmethod
    def none(cls, m: int = 0) -> Self:
        """No landmark."""
        nine = np.zeros((0, 3, 3))
        return cls.of(np.zeros(0, np.int64), 0, np.zeros((0, 3)), nine, nine, False, np.zeros((0, 3, m)))

    @property
    def from_newest(self) -> Array:
        """Covariances (S, 3, 3) of the positions where the newest pose is known, in world axes."""
        return self.own + self.away

    @cached_property
    def variables(self) -> dict[int, Array]:
        """Positions (3,) of those that are variables, by serial number."""
        return dict(zip(self.serial[self.variable].tolist(), self.position[self.variable]))

    def spans(self, rows: IndexArray, last: IndexArray, tick: int, track: int, solved: int) -> IndexArray:
        """`since` (M,) of landmarks that a pose at a `tick` measures; `last` (M,) is of those that did before, or −1.

        A smart factor spans at most `track` poses. Then, or if a landmark was not measured for half as many, it goes on
        in a new one. If landmarks that were found together all began anew at once, the motion model alone would tie
        that pose to the one before. So the first factor spans fewer, down to half of them, differently for each
        landmark. Where poses that measured no known landmark came since the one at tick `solved`, every other factor
        takes this measurement as well, unless its first pose has left the graph.
        """
        since, half = self.since[rows], max(track // 2, 1)
        every_other = self.serial[rows] // 2 % 2 == 0  # of all spans, even and odd ones
        longer = (last >= 0) & (0 <= solved < tick - 1) & (since > solved - track) & every_other
        anew = np.where(since <= tick - track, tick, since)
        anew = np.where((last < 0) | (last < tick - half), tick - self.serial[rows] % half, anew)
        return np.where(longer, since, anew)

    def measured(self, rows: IndexArray, z: Array, pose: int, since: IndexArray, oldest: int) -> Self:
        """With one more measurement (M, 3) of some landmarks, from the pose of a number, in factors `since` (M,).

        What was measured last before pose `oldest` is left out from now on: the camera has drifted. It counts as what
        was known beforehand.
        """
        every, old = self.since.copy(), np.zeros(len(self), bool)
        every[rows] = since
        old[rows] = (self.pose[rows].max(axis=1) < oldest) & self.away[rows].any(axis=(1, 2))
        if old.any():
            self = self.without_measurements(old)
        away = self.away.copy()
        away[rows] = 0.0
        zs, poses = self.z.copy(), self.pose.copy()
        slot = poses[rows].argmin(axis=1)
        zs[rows, slot], poses[rows, slot] = z, pose
        return replace(self, z=zs, pose=poses, away=away, since=every)

    def with_variables(
        self, rows: IndexArray, last: IndexArray, z: Array, tick: int, track: int, most: int, T: Array, ratio: float
    ) -> Self:
        """With more landmarks as variables, of those that a pose T (4, 4) is about to measure (M, 3); at most so many.

        The pose is at a `tick`, and those that measured the landmarks last are at ticks `last` (S,), −1 for none.

        Where it measures more, none becomes one: many landmarks that come and go hold the path well enough, at half the
        cost, and forget where features were that slide (`slam.models.SlideModel`). A landmark becomes a variable when
        its smart factor is full: then it keeps what that says of it, as the measurements go over. Variables that were
        not measured for longer than a factor spans make room, the oldest first.

        gtsam linearises a variable no more once a pose that measured it has left the lag. At an offset δ from there and
        a distance d a pixel is wrong by f (δ/d)²: less than its noise σ where d > δ `ratio`, with ``ratio² = f/σ``.
        So a landmark becomes a variable where that holds for its deviation, and goes on in a smart factor where it
        holds no more for its offset. Else landmarks that are known from afar carry the path away as it passes them.
        """
        if len(rows) > most:
            return self
        variable, since = self.variable.copy(), self.since.copy()
        deviation = np.sqrt(np.trace(self.own[rows], axis1=1, axis2=2))
        offset = np.linalg.norm(self.position[rows] - self.linearised[rows], axis=1)
        apart = ratio * np.where(variable[rows], offset, deviation)
        nonlinear = apart >= np.linalg.norm(self.position[rows] - T[:3, 3], axis=1)
        full = ~variable[rows] & (since[rows] <= tick - track) & (last[rows] >= tick - max(track // 2, 1))
        new = rows[full & ~nonlinear & np.isfinite(z[:, 2])]
        leaving = np.flatnonzero(variable & (last < tick - track))
        leaving = leaving[np.argsort(last[leaving], kind="stable")][: max(int(variable.sum()) + len(new) - most, 0)]
        new = np.sort(new)[: most - int(variable.sum()) + len(leaving)]
        leaving = np.append(leaving, rows[variable[rows] & nonlinear])
        variable[leaving], since[leaving], variable[new] = False, tick - track, True  # full
        linearised = self.linearised.copy()
        linearised[new] = self.position[new]
        return replace(self, since=since, variable=variable, linearised=linearised)

    def solved(self, serials: IdArray, points: Array, linearised: Array) -> Self:
        """With variables (V,), by serial number, at points (V, 3), and where the graph has them linearised (V, 3)."""
        rows, position, at = np.searchsorted(self.serial, serials), self.position.copy(), self.linearised.copy()
        position[rows], at[rows] = points, linearised
        return replace(self, position=position, linearised=at)

    def without_variables(self) -> Self:
        """With smart factors in place of all variables."""
        return replace(self, variable=np.zeros(len(self), bool))

    def left_behind(self, rows: IndexArray, T: Array, drift: Array) -> Self:
        """After a pose T (4, 4) that measured only the landmarks `rows`, and is off by a drift (6, 6) from the last."""
        unseen = ~self.world
        unseen[rows] = False
        J, away = by_pose(T, self.position[unseen]), self.away.copy()
        away[unseen] += J @ drift @ np.swapaxes(J, 1, 2)
        return replace(self, away=away)

    def without_measurements(self, chosen: BoolArray) -> Self:
        """As they stand, with what is known of some (S,) now in place of their measurements."""
        some = self._known_by(chosen & ~self.world, self.from_newest)
        z = np.where(chosen[:, None, None], np.nan, self.z)
        return replace(some, z=z, pose=np.where(chosen[:, None], -1, self.pose))

    def folded(self, first: int, oldest: int) -> Self:
        """With what they are known by in place of all measurements, where one was made before pose number `first`.

        Poses before it are kept no more. The numbers of the poses stay: they say when a landmark was measured last.
        Landmarks that pose `oldest` or a later one measured go on with the measurements that are left.
        """
        gone, lately = (self.pose >= 0) & (self.pose < first), self.pose.max(axis=1) >= oldest
        old = gone.any(axis=1) & ~lately & ~self.world
        z = np.where((old[:, None] | gone)[:, :, None], np.nan, self.z)
        return replace(self._known_by(old, self.own), z=z, pose=np.where(gone & lately[:, None], -1, self.pose))

    def _known_by(self, chosen: BoolArray, covariances: Array) -> Self:
        """Where some (S,) stand is what is known of them, with covariances (S, 3, 3)."""
        information = np.where(chosen[:, None, None], inverses(covariances), self.information)
        return replace(self, mean=np.where(chosen[:, None], self.position, self.mean), information=information)

    def refined(self, stereo: RectifiedStereo, sigma: float, first: int, poses: Array) -> Self:
        """Where their measurements put them, given the poses (K, 4, 4) from number `first` on."""
        position, own = self.position.copy(), self.own.copy()
        kernels.refine(
            stereo.intrinsics, poses, self.pose - first, self.z, sigma, self.mean, self.information, position, own
        )
        return replace(self, position=position, own=own)

    def covariances(self, chosen: IndexArray, newest: int, poses: Array, P: Array) -> Array:
        """Covariances (M, 3, 3) in the world of some landmarks: ``C + J P Jᵀ``.

        C is known where all poses are. The landmark moves with the pose that measured it last, of which P was known
        when it was the newest, by ``J = (1 − C Λ) G``: G as a point that is fixed to the pose, less what is known of it
        in the world beforehand, Λ. One that was never measured moves with the newest pose, and by the drift since it is
        known. The last of the `poses` (K, 4, 4), with covariances P (K, 6, 6), is of number `newest`.
        """
        marks, last = self.select(chosen), self.pose[chosen].max(axis=1, initial=-1)
        row = (np.where(last < 0, newest, last) - newest - 1).clip(-len(poses))
        J = by_pose(poses[row], marks.position)
        J[marks.world] -= (marks.own @ marks.information @ J)[marks.world]
        C = marks.own + J @ P[row] @ np.swapaxes(J, 1, 2)
        C[last < 0] += marks.away[last < 0]
        return np.asarray(0.5 * (C + np.swapaxes(C, 1, 2)))


def by_pose(T: Array, points: Array) -> Array:
    """Derivatives (M, 3, 6) of points (M, 3) in the world that are fixed to one pose T (4, 4), or to M of them."""
    R = T[..., :3, :3]
    local = (np.swapaxes(R, -1, -2) @ (points - T[..., :3, 3])[:, :, None])[:, :, 0]
    return np.asarray(R @ points_by_pose(local))


def inverses(H: Array) -> Array:
    """Inverses (M, 3, 3) of information matrices or covariances, symmetric to the last digit.

    A little is added to keep them finite: far points leave depth free.
    """
    H = H + (1e-12 + 1e-12 * np.trace(H, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    P = np.linalg.inv(H)
    return np.asarray(0.5 * (P + np.swapaxes(P, 1, 2)))
