"""The smoother's own records: poses, measurements and landmarks, as arrays. gtsam keeps none that can be read back."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.data import IdArray
from slam.errors import MeasurementError
from slam.geometry.se3 import Array

if TYPE_CHECKING:
    from backends.smoother.marginal import Held, MarginalPrior

IndexArray = NDArray[np.intp]

#: So many of its last measurements give a landmark's position and covariance.
RECENT = 12


def grown(array: np.ndarray, rows: int) -> np.ndarray:
    """`array` with room for at least `rows` rows: itself, or a copy of twice the size."""
    if rows <= len(array):
        return array
    larger = np.zeros((max(rows, 2 * len(array)), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


class Path:
    """Stamps and poses ``T_world_left`` of all frames.

    Attributes:
        count: number of frames.
        measured: those in which landmarks were measured, ascending.
        jumps: those whose poses do not follow from the ones before; the camera goes on from there at an unknown speed.
    """

    def __init__(self) -> None:
        self.count = 0
        self.measured: list[int] = []
        self.jumps: list[int] = []
        self._stamps = np.zeros(64)
        self._poses = np.zeros((64, 4, 4))

    @property
    def stamps(self) -> Array:
        """Times (F,) [s]; a view."""
        return self._stamps[: self.count]

    @property
    def poses(self) -> Array:
        """Poses (F, 4, 4); a view that may be written to."""
        return self._poses[: self.count]

    def newest(self, most: int, first: int = 0) -> IndexArray:
        """The two newest frames and before them those with measurements, from `first` on, at most so many together.

        Landmarks hang on poses that measured them; over those in between they do not move.
        """
        older = [i for i in self.measured[-most:] if first <= i < self.count - 2]
        recent = range(max(first, self.count - 2), self.count)
        return np.array([*older[max(0, len(older) + len(recent) - most) :], *recent], np.intp)

    def note_measured(self) -> None:
        """Note that landmarks were measured in the newest frame."""
        if not self.measured or self.measured[-1] < self.count - 1:
            self.measured.append(self.count - 1)

    def jumped(self, frame: int) -> bool:
        """Whether the pose of a frame does not follow from those before it."""
        return frame in self.jumps

    def upto(self, count: int) -> Path:
        """The first `count` frames; they share their memory with this."""
        out = copy(self)
        out.count = count
        return out

    def append(self, stamp: float, T_world_left: Array) -> None:
        """Add a frame."""
        self._stamps = grown(self._stamps, self.count + 1)
        self._poses = grown(self._poses, self.count + 1)
        self._stamps[self.count], self._poses[self.count] = stamp, T_world_left
        self.count += 1


class Measurements:
    """All accepted measurements, a row each, in the order in which they came."""

    def __init__(self) -> None:
        self.count = 0
        self._z = np.zeros((1024, 3))
        self._frame = np.zeros(1024, np.int32)
        self._landmark = np.zeros(1024, np.int32)

    @property
    def z(self) -> Array:
        """(uL, vL, uR) of the rectified rig (n, 3)."""
        return self._z[: self.count]

    @property
    def frame(self) -> NDArray[np.int32]:
        """Frame in which each was made (n,)."""
        return self._frame[: self.count]

    @property
    def landmark(self) -> NDArray[np.int32]:
        """Serial number of the landmark measured (n,)."""
        return self._landmark[: self.count]

    def append(self, z: Array, frame: int, landmarks: NDArray) -> IndexArray:
        """Add the measurements (M, 3) of one frame, of landmarks by serial number (M,); returns their rows (M,)."""
        rows = np.arange(self.count, self.count + len(z))
        self.count += len(z)
        for name in ("_z", "_frame", "_landmark"):
            setattr(self, name, grown(getattr(self, name), self.count))
        self._z[rows], self._frame[rows], self._landmark[rows] = z, frame, landmarks
        return rows

    def shift_right(self, shift: float) -> None:
        """Move all right pixels by `shift`."""
        self._z = self._z + np.array([0.0, 0.0, shift])

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Forget all but some of the rows (n,); the others move up."""
        count = int(rows.sum())
        for name in ("_z", "_frame", "_landmark"):
            setattr(self, name, grown(getattr(self, name)[: self.count][rows], max(1024, count)))
        self.count = count


@dataclass
class Track:
    """A landmark's measurements since its last factor was finished, and the factor that holds them.

    Attributes:
        limit: so many measurements finish it.
        rows: rows of `Measurements`.
        points: the same as gtsam objects.
        keys: pose variables of the measurements.
        stereo: number of measurements with a right pixel.
        factor: slot of the smart factor in the solver, −1 while there is none.
    """

    limit: int
    rows: list[int] = field(default_factory=list)
    points: list[Any] = field(default_factory=list)
    keys: list[int] = field(default_factory=list)
    stereo: int = 0
    factor: int = -1

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def informative(self) -> bool:
        """Whether a smart factor can be made: gtsam's throws where it is given left pixels only."""
        return len(self.rows) >= 2 and self.stereo > 0

    def append(self, row: int, point: Any, key: int, stereo: bool) -> None:
        """Add a measurement."""
        self.rows.append(row)
        self.points.append(point)
        self.keys.append(key)
        self.stereo += stereo

    def drop_last(self, stereo: bool) -> None:
        """Take back the newest measurement."""
        self.rows.pop(), self.points.pop(), self.keys.pop()
        self.stereo -= stereo

    def restart(self) -> None:
        """Forget the measurements: their factor is finished and stays as it is."""
        self.rows, self.points, self.keys, self.stereo, self.factor = [], [], [], 0, -1


@dataclass(frozen=True)
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

    def hangs_before(self, first: int) -> bool:
        """Whether it hangs on a camera before frame `first`."""
        return self.frame is not None and self.frame < first


class History:
    """What the solver was told besides what the tracks hold; with them, all that it takes to tell another one.

    Attributes:
        finished: rows of `Measurements` of each finished smart factor.
        explicit: rows of each landmark that is a variable, by the variable.
        owner: serial number of the landmark of each variable.
        first: frame of the oldest pose that is a variable.
        prior: what those before it have left behind; None while there are none.
        held: the oldest pose, where there is a prior.
        places: where each of those was believed to be at first.
        variables: number of landmark variables that were ever made, for their names.
        known: what was known of landmarks beforehand, by serial number.
        restarted: the poses of so many frames from the first on hang on each other as they are, without measurements.
    """

    def __init__(self) -> None:
        self.finished: list[NDArray[np.int64]] = []
        self.explicit: dict[int, list[int]] = {}
        self.owner: dict[int, int] = {}
        self.first = 0
        self.prior: MarginalPrior | None = None
        self.held: Held | None = None
        self.places: dict[int, Array] = {}
        self.known: dict[int, Known] = {}
        self.restarted = 0
        self.variables = 0


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
        self._slot: dict[int, int] = {}
        self._added = 0
        self._free: list[int] = list(range(255, -1, -1))

    def __len__(self) -> int:
        return len(self._slot)

    def __contains__(self, landmark: int) -> bool:
        return landmark in self._slot

    def slots(self, ids: Iterable[int] | IdArray) -> IndexArray:
        """Slots (M,) of landmarks; raises MeasurementError where one is not in the map."""
        try:
            return np.array([self._slot[i] for i in np.asarray(ids, np.int64).tolist()], np.intp)
        except KeyError as error:
            raise MeasurementError(f"smoother: landmark {error.args[0]} is not in the map") from None

    def all_slots(self) -> IndexArray:
        """Slots of all landmarks, by ascending id."""
        return np.array([self._slot[i] for i in sorted(self._slot)], np.intp)

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
        for i, slot, limit in zip(ids.tolist(), slots.tolist(), limits):
            self._slot[i] = slot
            self.tracks[slot] = Track(limit)
        return slots

    def measured(self, slots: IndexArray, rows: IndexArray, frame: int) -> None:
        """Note one more measurement of each landmark."""
        place = self.seen[slots] % RECENT
        self.older[slots] += self.information[slots, place]
        self.information[slots, place] = 0
        self.recent[slots, place] = rows
        self.seen[slots] += 1
        self.last[slots] = frame

    def remove(self, slots: IndexArray) -> None:
        """Take landmarks out of the map."""
        for slot in slots.tolist():
            del self._slot[int(self.ids[slot])], self.tracks[slot]
            self._free.append(slot)
        self.ids[slots] = self.variable[slots] = -1

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


class MeasurementLog:
    """Everything that is on record.

    Attributes:
        path: stamps and poses of all frames.
        measurements: all accepted measurements.
        landmarks: the map.
        history: what else the solver was told.
    """

    def __init__(self) -> None:
        self.path = Path()
        self.measurements = Measurements()
        self.landmarks = Landmarks()
        self.history = History()

    def finish(self, track: Track) -> None:
        """End a track; what it holds stays in its factor."""
        if track.informative:
            self.history.finished.append(np.array(track.rows))
        track.restart()

    def take_back(self, slots: IndexArray, rows: IndexArray) -> None:
        """Take the newest measurements `rows` of landmarks `slots` out again."""
        self.measurements.landmark[rows] = -1
        for slot, row in zip(slots.tolist(), rows.tolist()):
            track, variable = self.landmarks.tracks[slot], int(self.landmarks.variable[slot])
            if variable >= 0:
                self._take_back_explicit(slot, variable, row)
            elif track.rows and track.rows[-1] == row:
                track.drop_last(bool(np.isfinite(self.measurements.z[row, 2])))

    def _take_back_explicit(self, slot: int, variable: int, row: int) -> None:
        """Take back a measurement of a landmark's own variable; without depth from the others the variable goes too.

        One that was known beforehand has its depth from there.
        """
        rows = self.history.explicit[variable]
        rows.remove(row)
        known = rows and int(self.landmarks.serial[slot]) in self.history.known
        if not known and not np.isfinite(self.measurements.z[rows, 2]).any():
            del self.history.explicit[variable], self.history.places[variable], self.history.owner[variable]
            self.landmarks.variable[slot] = -1

    def revise(self, mend: Callable[[Array], Array], point: Callable[[list[float]], Any]) -> None:
        """Mend all measurements; `point` makes the solver's measurements of rows (uL, vL, uR).

        Raises:
            MeasurementError: a mended measurement is not finite.
        """
        z = mend(self.measurements.z.copy())
        if not (np.isfinite(z) | np.isnan(self.measurements.z)).all():
            raise MeasurementError("smoother: a mended measurement is not finite")
        self.measurements.z[:] = z
        for track in self.landmarks.tracks.values():
            track.points = [point(z) for z in self.measurements.z[track.rows].tolist()] if track.rows else []
        for slot in np.flatnonzero(self.landmarks.variable >= 0).tolist():
            self.history.places[int(self.landmarks.variable[slot])] = self.landmarks.position[slot].copy()

    def start_anew(self, prior: MarginalPrior, covariances: Array) -> None:
        """Begin with the newest pose, of which `prior` is known, and with the landmarks as they stand before it.

        `covariances` (M, 3, 3) of all landmarks, by slot, as seen from there, in world axes.
        """
        path, history, marks, frame = self.path, self.history, self.landmarks, self.path.count - 1
        path.jumps.append(frame)
        history.prior = None
        self.forget_measurements()
        history.first, history.prior, history.held, history.restarted = frame, prior, None, 0
        history.known = {serial: known for serial, known in history.known.items() if known.frame is None}
        slots, T = marks.used(), path.poses[-1]
        marks.recent[slots], marks.seen[slots], marks.information[slots], marks.older[slots] = -1, 0, 0, 0
        marks.last[slots] = frame
        fixed = marks.prior[slots].any(axis=(1, 2))  # they are known in the world
        marks.covariance[slots[~fixed]] = covariances[~fixed]
        hanging = slots[~fixed]
        local = (marks.position[hanging] - T[:3, 3]) @ T[:3, :3]
        covariances = T[:3, :3].T @ marks.covariance[hanging] @ T[:3, :3]
        marks.older[hanging] = np.linalg.inv(marks.covariance[hanging])
        # What is not known by as much as its distance is measured anew, as if it were new.
        known = np.trace(covariances, axis1=1, axis2=2) < (local**2).sum(axis=1)
        hanging, local, covariances = hanging[known], local[known], covariances[known]
        for serial, position, covariance in zip(marks.serial[hanging].tolist(), local, covariances):
            history.known[serial] = Known(position, covariance, frame, seen=False)
        self._forget_unused_measurements()

    def advance(self, first: int, gone: Collection[int], prior: MarginalPrior, held: Held | None) -> None:
        """Let go of the poses before frame `first` and of the landmark variables `gone`: `prior` holds what they said.

        Measurements that no factor and no landmark refers to any more are forgotten.
        """
        history, frame = self.history, self.measurements.frame
        history.first, history.prior, history.held = first, prior, held
        history.finished = [rows for rows in history.finished if frame[rows].min() >= first]
        for name in ("explicit", "places", "owner"):
            kept = {key: value for key, value in getattr(history, name).items() if key not in gone}
            setattr(history, name, kept)
        history.explicit = {key: [row for row in rows if frame[row] >= first] for key, rows in history.explicit.items()}
        self._forget_unused_known()
        self._forget_unused_measurements()

    def _forget_unused_known(self) -> None:
        """Forget what was known beforehand of landmarks that are neither in the map nor variables."""
        marks, history = self.landmarks, self.history
        kept = {*marks.serial[marks.used()].tolist(), *history.owner.values()}
        history.known = {serial: known for serial, known in history.known.items() if serial in kept}

    def _forget_unused_measurements(self) -> None:
        """Number the measurements anew that a factor, a track or a landmark still refers to."""
        marks, history = self.landmarks, self.history
        used = np.zeros(self.measurements.count + 1, bool)
        recent = marks.recent[marks.used()]
        used[recent[recent >= 0]] = True
        lists = [*history.explicit.values(), *(track.rows for track in marks.tracks.values())]
        for referred in (*history.finished, *lists):
            used[np.asarray(referred, np.intp)] = True
        used[-1] = False
        number = np.where(used, np.cumsum(used) - 1, -1)  # −1 stays −1
        marks.recent[:] = number[np.where(marks.ids[:, None] >= 0, marks.recent, -1)]
        history.finished = [number[rows] for rows in history.finished]
        history.explicit = {key: number[rows].tolist() if rows else [] for key, rows in history.explicit.items()}
        for track in marks.tracks.values():
            track.rows = number[track.rows].tolist() if track.rows else []
        self.measurements.keep(used[:-1])

    def forget_measurements(self) -> None:
        """Let all poses hang on each other as they are; landmarks stay where they are and are measured anew."""
        history = self.history
        history.finished, history.explicit, history.places, history.owner = [], {}, {}, {}
        history.restarted = self.path.count
        if history.prior is not None:
            history.prior = history.prior.of_reference()
        for track in self.landmarks.tracks.values():
            track.restart()
        self.landmarks.variable[:] = -1
