"""The smoother's landmarks: positions, covariances, and the measurements that are not in a finished factor yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from backends.smoother.path import grown
from slam.data import BoolArray, IdArray, IndexArray
from slam.errors import MeasurementError
from slam.geometry.arrays import isin
from slam.geometry.se3 import Array

#: So many of its last measurements give a landmark's position and covariance.
RECENT = 12


@dataclass(frozen=True)
class Track:
    """A landmark's measurements since its last factor was finished, and the factor that holds them.

    It is never changed, only replaced: tracks as they were are kept by a copy of the dictionary that holds them.

    Attributes:
        limit: so many measurements finish it.
        rows: rows of `Measurements`.
        points: the same as gtsam objects.
        keys: pose variables of the measurements.
        stereo: number of measurements with a right pixel.
        factor: slot of the smart factor in the solver, −1 while there is none.
    """

    limit: int
    rows: tuple[int, ...] = ()
    points: tuple[Any, ...] = ()
    keys: tuple[int, ...] = ()
    stereo: int = 0
    factor: int = -1

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def informative(self) -> bool:
        """Whether a smart factor can be made: gtsam's throws where it is given left pixels only."""
        return len(self.rows) >= 2 and self.stereo > 0

    def longer(self, row: int, point: Any, key: int, stereo: bool) -> Track:
        """With one more measurement."""
        rows, points, keys = (*self.rows, row), (*self.points, point), (*self.keys, key)
        return Track(self.limit, rows, points, keys, self.stereo + stereo, self.factor)

    def without_last(self, stereo: bool) -> Track:
        """Without the newest measurement."""
        rows, points, keys = self.rows[:-1], self.points[:-1], self.keys[:-1]
        return Track(self.limit, rows, points, keys, self.stereo - stereo, self.factor)

    def in_factor(self, slot: int) -> Track:
        """The same in the smart factor of a slot."""
        return Track(self.limit, self.rows, self.points, self.keys, self.stereo, slot)

    def restarted(self) -> Track:
        """Without measurements: their factor is finished and stays as it is."""
        return Track(self.limit)


@dataclass(frozen=True, eq=False)
class Known:
    """What was known of a landmark before it was measured.

    Attributes:
        position: in world coordinates, or in the camera's where `frame` is one (3,) [m].
        covariance: its covariance (3, 3) [m²].
        frame: frame of the camera in whose coordinates that is; None for the world's.
        seen: whether it was measured from there: then it is its inverse depth that is Gaussian, nearly.
    """

    position: Array
    covariance: Array
    frame: int | None = None
    seen: bool = True

    def is_before(self, first: int) -> bool:
        """Whether it is relative to the camera of a frame before `first`."""
        return self.frame is not None and self.frame < first


class Landmarks:
    """The map: a slot for each landmark; slots are reused.

    Attributes:
        ids: landmark of each slot (S,), −1 for free ones.
        serial: number of each landmark in the order of their coming (S,); an id may come back, a serial number not.
        position: in world coordinates (S, 3) [m].
        covariance: of the position where all poses are known (S, 3, 3) [m²].
        information: of each of its last measurements on the position (S, RECENT, 3, 3) [1/m²], see `uncertainty`.
        older: of all earlier ones together (S, 3, 3).
        mean, prior: position (S, 3) and information (S, 3, 3) in world coordinates known beforehand; zero for none.
        recent: rows of its last measurements (S, RECENT), −1 where there are fewer; a ring.
        seen: number of measurements (S,).
        last: frame of the last one (S,).
        variable: the landmark's own variable (S,), −1 while it has none.
        tracks: by slot.
    """

    def __init__(self) -> None:
        self.ids = np.full(256, -1, np.int64)
        self.serial = np.zeros(256, np.int64)
        self.position = np.zeros((256, 3))
        self.covariance = np.zeros((256, 3, 3))
        self.information = np.zeros((256, RECENT, 3, 3))
        self.older = np.zeros((256, 3, 3))
        self.mean = np.zeros((256, 3))
        self.prior = np.zeros((256, 3, 3))
        self.recent = np.full((256, RECENT), -1, np.int64)
        self.seen = np.zeros(256, np.int64)
        self.last = np.zeros(256, np.int64)
        self.variable = np.full(256, -1, np.int64)
        self.tracks: dict[int, Track] = {}
        self._by_id = np.zeros(0, np.intp)  # slots of all landmarks, by ascending id
        self._added = 0
        self._free: list[int] = list(range(255, -1, -1))

    def __len__(self) -> int:
        return len(self._by_id)

    def among(self, ids: IdArray) -> BoolArray:
        """Which of the ids (M,) are in the map."""
        return isin(ids, self.ids[self._by_id])

    def slots(self, ids: IdArray) -> IndexArray:
        """Slots (M,) of landmarks; raises MeasurementError where one is not in the map."""
        ids = np.asarray(ids, np.int64)
        known = self.ids[self._by_id]
        place = np.searchsorted(known, ids)
        if not ((place < len(known)).all() and (known[place] == ids).all()):
            raise MeasurementError(f"smoother: landmark {ids[~self.among(ids)][0]} is not in the map")
        return self._by_id[place]

    def all_slots(self) -> IndexArray:
        """Slots of all landmarks, by ascending id."""
        return self._by_id.copy()

    def used(self) -> IndexArray:
        """Slots of all landmarks, ascending."""
        return np.flatnonzero(self.ids >= 0)

    def add(self, ids: IdArray, position: Array, frame: int, limits: Sequence[int]) -> IndexArray:
        """Take in landmarks that have not been measured yet; returns their slots."""
        if len(self._free) < len(ids):
            self._grow(len(ids))
        slots = np.array([self._free.pop() for _ in ids], np.intp)
        self.ids[slots], self.position[slots], self.last[slots] = ids, position, frame
        self.serial[slots] = np.arange(self._added, self._added + len(slots))
        self._added += len(slots)
        self.recent[slots], self.seen[slots], self.variable[slots] = -1, 0, -1
        self.information[slots], self.older[slots], self.prior[slots] = 0, 0, 0
        for slot, limit in zip(slots.tolist(), limits):
            self.tracks[slot] = Track(limit)
        self._sort()
        return slots

    def measured(self, slots: IndexArray, rows: IndexArray, frame: int) -> None:
        """Note one more measurement of each landmark."""
        place = self.seen[slots] % RECENT
        self.older[slots] += self.information[slots, place]
        self.information[slots, place] = 0
        self.recent[slots, place] = rows
        self.seen[slots] += 1
        self.last[slots] = frame

    def put_in_factors(self, factors: Mapping[int, int]) -> None:
        """Note the smart factors that hold some landmarks' tracks, both by slot."""
        for slot, factor in factors.items():
            self.tracks[slot] = self.tracks[slot].in_factor(factor)

    def remove(self, slots: IndexArray) -> None:
        """Take landmarks out of the map."""
        for slot in slots.tolist():
            del self.tracks[slot]
            self._free.append(slot)
        self.ids[slots] = self.variable[slots] = -1
        self._sort()

    def _sort(self) -> None:
        """Order the slots by id."""
        slots = self.used()
        self._by_id = slots[np.argsort(self.ids[slots])]

    def _grow(self, needed: int) -> None:
        """Room for at least `needed` more landmarks."""
        old = len(self.ids)
        for name in (
            "ids", "serial", "position", "covariance", "information", "older", "mean", "prior",
            "recent", "seen", "last", "variable",
        ):  # fmt: skip
            setattr(self, name, grown(getattr(self, name), old + needed))
        self.ids[old:] = self.variable[old:] = -1
        self._free = list(range(len(self.ids) - 1, old - 1, -1)) + self._free
