"""What the window back end knows: a frozen value that a call replaces when all of it is done."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from backends.window.past import Past
from slam.data import IdArray, IndexArray
from slam.errors import MeasurementError
from slam.geometry.se3 import Array, adjoint, inverse
from slam.window.problem import Places, RelativePrior, Rows


@dataclass(frozen=True, eq=False)
class Landmarks:
    """A row for each landmark, and for each that was removed but still has measurements in the window.

    Attributes:
        ids: (S,), −1 of those that were removed.
        serial: number of each in the order of their coming (S,); an id may come back, a serial number not.
        position: in world coordinates (S, 3) [m].
        local: covariance (S, 3, 3) [m²] in the coordinates of the newest pose that was solved for.
        world: covariance (S, 3, 3) [m²] in world coordinates.
        last: number of the frame that measured it last (S,).
        mean, information: what was known of it beforehand, in world coordinates, and is not in the prior yet: position
            (S, 3) and information (S, 3, 3), zero for nothing.
    """

    ids: IdArray
    serial: IdArray
    position: Array
    local: Array
    world: Array
    last: IndexArray
    mean: Array
    information: Array

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def none(cls) -> Landmarks:
        """No landmark."""
        three, nine = np.zeros((0, 3)), np.zeros((0, 3, 3))
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), three, nine, nine, np.zeros(0, np.int64), three, nine)

    def joined(self, other: Landmarks) -> Landmarks:
        """These and others."""
        return Landmarks(*(np.concatenate([mine, its]) for mine, its in zip(self.columns, other.columns)))

    def select(self, keep: np.ndarray) -> Landmarks:
        """Some of the rows (a mask)."""
        return Landmarks(*(column[keep] for column in self.columns))

    @property
    def columns(self) -> list[np.ndarray]:
        """All arrays."""
        return [getattr(self, name) for name in self.__dataclass_fields__]

    @cached_property
    def order(self) -> IndexArray:
        """Rows of the landmarks in the map, by ascending id."""
        rows = np.argsort(self.ids, kind="stable")
        return rows[np.searchsorted(self.ids[rows], 0) :]

    def rows_of(self, ids: IdArray) -> IndexArray:
        """Rows of landmarks.

        Raises:
            MeasurementError: one is not in the map.
        """
        ids = np.asarray(ids, np.int64)
        known = self.ids[self.order]
        at = np.searchsorted(known, ids).clip(0, max(len(known) - 1, 0))
        bad = known[at] != ids if len(known) else np.ones(len(ids), bool)
        if bad.any():
            raise MeasurementError(f"window: landmark {ids[bad][0]} is not in the map")
        return self.order[at]

    def require_new(self, ids: IdArray) -> None:
        """Raise MeasurementError if one of the ids is in the map."""
        taken = np.isin(ids, self.ids)
        if taken.any():
            raise MeasurementError(f"window: landmark {ids[taken][0]} is in the map already")


@dataclass(frozen=True, eq=False)
class State:
    """The window.

    Attributes:
        frames: numbers of its frames (K,), ascending; the last one is the newest.
        stamps: their times (K,) [s].
        poses: T_world_left (K, 4, 4).
        covariance: of the poses together (6 K, 6 K).
        solved: place in the window of the newest pose that was solved for.
        begun: number of the frame in which the present problem begins: the first, or that of a restart.
        rows: measurements, by place in the window and row of the landmark.
        places: landmarks placed relative to a pose.
        prior: what left the window says of its poses but the newest, and of landmarks.
        cost: sum of squares at the estimate.
        landmarks: the map.
        past: poses that have left the window and are still revised.
        serials: number of landmarks so far.
        measured: whether the newest pose may not be updated any more.
        contradicted: updates in succession in which most observations agreed on another pose than was expected.
    """

    frames: IndexArray
    stamps: Array
    poses: Array
    covariance: Array
    solved: int
    begun: int
    rows: Rows
    places: Places
    prior: RelativePrior
    cost: float
    landmarks: Landmarks = field(default_factory=Landmarks.none)
    past: Past = field(default_factory=Past)
    serials: int = 0
    measured: bool = False
    contradicted: int = 0

    @classmethod
    def empty(cls) -> State:
        """Before the first prediction."""
        none = np.zeros(0, np.int64)
        return cls(
            none, np.zeros(0), np.zeros((0, 4, 4)), np.zeros((0, 0)), 0, 0, Rows.none(), Places.none(),
            RelativePrior.none(), 0.0,
        )  # fmt: skip

    def revised_poses(self) -> dict[int, Array]:
        """Poses (4, 4) by frame, of the window and of its past."""
        poses = dict(zip(self.frames.tolist(), self.poses))
        marks, members = self.landmarks, self.prior.points
        points = dict(zip(marks.serial[members].tolist(), marks.position[members]))
        return {**self.past.revised(poses, points), **poses}

    def settled(self, lag: int) -> tuple[State, dict[int, Array]]:
        """With a past of `lag` frames, once it is half as long again; and the poses (4, 4) that are final now."""
        surplus = len(self.past) - lag
        if surplus <= lag // 2:
            return self, {}
        poses = self.revised_poses()
        final = {one.frame: poses[one.frame] for one in self.past.left[:surplus]}
        return replace(self, past=self.past.without(surplus)), final


def settle(before: State, after: State, lag: int) -> tuple[State, dict[int, Array]]:
    """The state after a step, with a past of `lag` frames, and the poses (4, 4) by frame that are final with it."""
    if after.begun != before.begun:  # the problem was begun anew: what was before is final
        return after, before.revised_poses()
    return after.settled(lag)


def between(s: State, earlier: int, later: int | None = None) -> Array:
    """Covariance (6, 6) of a pose of the window (the newest) relative to another one, both perturbed on the right."""
    later = len(s.frames) - 1 if later is None else later
    if earlier == later:
        return np.zeros((6, 6))
    i, j = slice(6 * earlier, 6 * earlier + 6), slice(6 * later, 6 * later + 6)
    A = adjoint(inverse(s.poses[later]) @ s.poses[earlier])
    P, cross = s.covariance, A @ s.covariance[i, j]
    return P[j, j] + A @ P[i, i] @ A.T - cross - cross.T
