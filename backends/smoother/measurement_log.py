"""What the smoother was given, as arrays: enough to set up the whole problem again, which gtsam does not hand out."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backends.smoother.landmarks import Known, Landmarks, Track
from backends.smoother.marginal import MarginalPrior
from backends.smoother.path import Path, grown
from backends.smoother.reference_pose import ReferencePose
from slam.data import IndexArray
from slam.errors import MeasurementError
from slam.geometry.se3 import Array

_SINGULAR = 1e-12  # numerics: smallest eigenvalue of a covariance, as a share of its trace


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

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Forget all but some of the rows (n,); the others move up."""
        count = int(rows.sum())
        for name in ("_z", "_frame", "_landmark"):
            setattr(self, name, grown(getattr(self, name)[: self.count][rows], max(1024, count)))
        self.count = count


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
        restarted: so many of the first frames keep their relative poses as they are: their measurements are forgotten.
    """

    def __init__(self) -> None:
        self.finished: list[NDArray[np.int64]] = []
        self.explicit: dict[int, list[int]] = {}
        self.owner: dict[int, int] = {}
        self.first = 0
        self.prior: MarginalPrior | None = None
        self.reference: ReferencePose | None = None
        self.places: dict[int, Array] = {}
        self.known: dict[int, Known] = {}
        self.restarted = 0
        self.variables = 0


class MeasurementLog:
    """All that the smoother has been given, and the latest values of poses and positions.

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

    def copied(self) -> MeasurementLog:
        """A copy; what is only ever replaced in the parts, such as tracks, belongs to both."""
        other = MeasurementLog()
        for name, part in vars(self).items():
            mutable = {k: v.copy() for k, v in vars(part).items() if isinstance(v, (np.ndarray, list, dict, set))}
            vars(getattr(other, name)).update({**vars(part), **mutable})
        return other

    def window(self, most: int) -> IndexArray:
        """Frames of the poses whose joint covariance is worked out, at most so many: see `Path.newest`."""
        return self.path.newest(most, self.history.first)

    def finish(self, slot: int) -> Track:
        """End a landmark's track, and begin the next one; what it holds stays in its factor."""
        track = self.landmarks.tracks[slot]
        if track.informative:
            self.history.finished.append(np.array(track.rows))
        self.landmarks.tracks[slot] = track = track.restarted()
        return track

    def take_back(self, slots: IndexArray, rows: IndexArray) -> None:
        """Take the newest measurements `rows` of landmarks `slots` out again."""
        self.measurements.landmark[rows] = -1
        for slot, row in zip(slots.tolist(), rows.tolist()):
            track, variable = self.landmarks.tracks[slot], int(self.landmarks.variable[slot])
            if variable >= 0:
                self._take_back_explicit(slot, variable, row)
            elif track.rows and track.rows[-1] == row:
                stereo = bool(np.isfinite(self.measurements.z[row, 2]))
                self.landmarks.tracks[slot] = track.without_last(stereo)

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

    def revise(self, correct: Callable[[Array], Array], point: Callable[[list[float]], Any]) -> None:
        """Mend all measurements; `point` makes the solver's measurements of rows (uL, vL, uR).

        Raises:
            MeasurementError: a mended measurement is not finite.
        """
        z = correct(self.measurements.z.copy())
        if not (np.isfinite(z) | np.isnan(self.measurements.z)).all():
            raise MeasurementError("smoother: a mended measurement is not finite")
        self.measurements.z[:] = z
        for slot, track in self.landmarks.tracks.items():
            if track.rows:
                points = tuple(point(z) for z in self.measurements.z[list(track.rows)].tolist())
                self.landmarks.tracks[slot] = replace(track, points=points)
        for slot in np.flatnonzero(self.landmarks.variable >= 0).tolist():
            self.history.places[int(self.landmarks.variable[slot])] = self.landmarks.position[slot].copy()

    def restart(self, prior: MarginalPrior, covariances: Array) -> None:
        """Begin with the newest pose, of which `prior` is known, and with the landmarks as they stand before it.

        `covariances` (M, 3, 3) of all landmarks, by slot, as seen from there, in world axes.
        """
        path, history, marks, frame = self.path, self.history, self.landmarks, self.path.count - 1
        path.jumps.append(frame)
        history.prior = None
        self.forget_measurements()
        history.first, history.prior, history.reference, history.restarted = frame, prior, None, 0
        history.known = {serial: known for serial, known in history.known.items() if known.frame is None}
        slots, T = marks.used(), path.poses[-1]
        marks.recent[slots], marks.seen[slots], marks.information[slots], marks.older[slots] = -1, 0, 0, 0
        marks.last[slots] = frame
        fixed = marks.prior[slots].any(axis=(1, 2))  # they are known in the world
        marks.covariance[slots[~fixed]] = _invertible(covariances[~fixed])
        relative = slots[~fixed]
        local = (marks.position[relative] - T[:3, 3]) @ T[:3, :3]
        covariances = T[:3, :3].T @ marks.covariance[relative] @ T[:3, :3]
        marks.older[relative] = np.linalg.inv(marks.covariance[relative])
        # What is not known by as much as its distance is measured again, as if it were new.
        known = np.trace(covariances, axis1=1, axis2=2) < (local**2).sum(axis=1)
        relative, local, covariances = relative[known], local[known], covariances[known]
        for serial, position, covariance in zip(marks.serial[relative].tolist(), local, covariances):
            history.known[serial] = Known(position, covariance, frame, seen=False)
        self._forget_unused_measurements()

    def advance(self, first: int, gone: Collection[int], prior: MarginalPrior, held: ReferencePose | None) -> None:
        """Let go of the poses before frame `first` and of the landmark variables `gone`: `prior` holds what they said.

        Measurements that no factor and no landmark refers to any more are forgotten.
        """
        history, frame = self.history, self.measurements.frame
        history.first, history.prior, history.reference = first, prior, held
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
        """Number the measurements again that a factor, a track or a landmark still refers to."""
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
        for slot, track in marks.tracks.items():
            if track.rows:
                marks.tracks[slot] = replace(track, rows=tuple(number[list(track.rows)].tolist()))
        self.measurements.keep(used[:-1])

    def forget_measurements(self) -> None:
        """Keep all relative poses and the landmarks' positions as they are, without the measurements behind them."""
        history = self.history
        history.finished, history.explicit, history.places, history.owner = [], {}, {}, {}
        history.restarted = self.path.count
        if history.prior is not None:
            history.prior = history.prior.of_reference()
        self.landmarks.tracks = {slot: track.restarted() for slot, track in self.landmarks.tracks.items()}
        self.landmarks.variable[:] = -1


def _invertible(P: Array) -> Array:
    """Covariances (M, 3, 3); those that rounding has left without an inverse are a little larger in all directions."""
    size = np.trace(P, axis1=1, axis2=2)[:, None, None]
    singular = np.linalg.eigvalsh(P)[:, 0] <= _SINGULAR * size[:, 0, 0]
    return np.where(singular[:, None, None], P + 2 * _SINGULAR * np.abs(size) * np.eye(3), P)
