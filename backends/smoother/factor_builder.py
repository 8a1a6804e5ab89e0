"""Measurements to factors: smart factors that grow, landmarks that become variables, and the elimination order."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from backends.smoother.config import SmootherConfig
from backends.smoother.factors import FactorMaker
from backends.smoother.landmarks import Known, Track
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.solver import Change
from backends.smoother.variables import landmark_key, landmark_threshold, pose_key
from slam.data import IndexArray
from slam.geometry.se3 import Array

#: cost: A landmark unseen for so many frames is seen again: a smart factor over the gap would touch all poses between.
_GAP = 20

#: cost: Landmarks seen within so many frames are likely to be seen again.
_LATE = 60


class FactorBuilder:
    """Puts measurements into factors.

    A landmark is a smart factor that grows with each measurement. When its track is long enough the factor is
    finished: the landmark becomes a variable with a factor for each measurement, or, if there are enough variables in
    view, continues in a new smart factor. Each measurement is used once.

    Args:
        make: makes the factors.
        config: limits and thresholds.
        log: what is on record.
    """

    def __init__(self, make: FactorMaker, config: SmootherConfig, log: MeasurementLog) -> None:
        self.log = log
        self._make = make
        self._config = config

    def eliminate_late(self, change: Change, first: int = 0, gone: Collection[int] = ()) -> None:
        """Order the elimination: recently seen landmarks late, the newest poses last.

        Poses before frame `first` and the landmark variables `gone` are left out.
        """
        marks, frame = self.log.landmarks, self.log.path.count - 1
        landmarks, poses = change.late
        poses.update(pose_key(i) for i in self.log.window(self._config.window).tolist() if i >= first)
        oldest = max(first, self.log.history.first)
        if oldest:  # that one is held, and its covariance is asked for
            poses.add(pose_key(oldest))
        recent = (marks.variable >= 0) & (marks.last > frame - _LATE)
        landmarks.update(set(marks.variable[recent].tolist()).difference(gone))

    def grow(self, change: Change, slots: IndexArray, rows: IndexArray, z: Array) -> dict[int, int]:
        """Put measurements into factors; returns the places of new smart factors in the change, by landmark's slot."""
        make, marks, frame = self._make, self.log.landmarks, self.log.path.count - 1
        key, explicit = pose_key(frame), self.log.history.explicit
        self._enter_known(change, slots)
        variables, again = marks.variable[slots], (frame - marks.last[slots] > _GAP).tolist()
        room = self._config.explicit - int((variables >= 0).sum())
        grown = {}
        columns = (slots.tolist(), variables.tolist(), rows.tolist(), z.tolist(), np.isfinite(z[:, 2]).tolist(), again)
        for slot, variable, row, zi, stereo, long_unseen in zip(*columns):
            point = make.point(zi)
            if variable >= 0:
                explicit[variable].append(row)
                change.factors.add(make.explicit(point, key, variable))
                continue
            track = self.log.finish(slot) if long_unseen and room <= 0 else marks.tracks[slot]
            marks.tracks[slot] = track = track.longer(row, point, key, stereo)
            if not track.informative:
                continue
            if track.factor >= 0:
                change.removed.append(track.factor)
            change.late[1].update(track.keys)
            if (long_unseen or len(track) >= track.limit) and room > 0 and self._well_known(slot):
                room -= 1
                self._make_variable(change, slot, track)
                continue
            grown[slot] = change.factors.size()
            change.factors.add(make.smart(track.points, track.keys))
        return grown

    def _well_known(self, slot: int) -> bool:
        """Whether a landmark's position is known to a tenth of its distance; its variable is ill-conditioned if not."""
        marks = self.log.landmarks
        offset = marks.position[slot] - self.log.path.poses[-1][:3, 3]
        return bool(np.trace(marks.covariance[slot]) < 0.01 * (offset @ offset))

    def _make_variable(self, change: Change, slot: int, track: Track) -> None:
        """Turn a landmark's smart factor into a variable with a factor for each measurement."""
        key = self._new_variable(change, slot)
        self.log.history.explicit[key] = list(track.rows)
        for point, pose in zip(track.points, track.keys):
            change.factors.add(self._make.explicit(point, pose, key))
        self.log.landmarks.tracks[slot] = track.restarted()

    def _known(self, slot: int) -> Known | None:
        """A landmark's prior; None once the pose that it is relative to has left the solver."""
        known = self.log.history.known.get(int(self.log.landmarks.serial[slot]))
        return None if known is None or known.is_before(self.log.history.first) else known

    def _enter_known(self, change: Change, slots: IndexArray) -> None:
        """Create variables for landmarks with a prior that have none yet."""
        if not self.log.history.known:
            return
        marks = self.log.landmarks
        for slot in slots[marks.variable[slots] < 0].tolist():
            known = self._known(slot)
            if known is None or len(marks.tracks[slot]):
                continue
            key = self._new_variable(change, slot)
            change.factors.add(self._make.known(key, known))
            if known.frame is not None:
                change.late[1].add(pose_key(known.frame))
            self.log.history.explicit[key] = []

    def _new_variable(self, change: Change, slot: int) -> int:
        """A variable for a landmark, placed where the landmark is believed to be."""
        history, marks = self.log.history, self.log.landmarks
        place = marks.position[slot].copy()
        distance = float(np.linalg.norm(place - self.log.path.poses[-1][:3, 3]))
        threshold = landmark_threshold(self._make.stereo, distance, self._config.relinearise)
        key = landmark_key(history.variables, threshold)
        history.variables += 1
        marks.variable[slot], history.places[key], history.owner[key] = key, place, int(marks.serial[slot])
        change.values.insert(key, place)
        return key

    def finish_tracks(self, slots: IndexArray) -> None:
        """Finish the smart factors that are long enough."""
        marks = self.log.landmarks
        for slot in slots[marks.variable[slots] < 0].tolist():
            track = marks.tracks[slot]
            if len(track.rows) >= track.limit:
                self.log.finish(slot)
