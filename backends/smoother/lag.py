"""A fixed lag: which variables leave the problem, so that a frame's cost does not grow with what the run has seen.

What leaves is marginalised: its factors become a linear one on what they touch. So no factor of theirs may change
afterwards, and the smart factors that hold a leaving pose are finished first.
"""

from __future__ import annotations

import numpy as np

from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.solver import Change
from backends.smoother.variables import pose_key

#: For poses to leave, all that stays is eliminated anew. So many leave together: the lag over this.
_SHARE = 4


class FixedLag:
    """Keeps track of the variables that are in the solver.

    Args:
        measurement_log: what is on record.
        lag: so many of the newest poses stay.
        landmarks: so many landmark variables stay, as long as they are in the map; those last measured go last.

    Attributes:
        first: frame of the oldest pose that is a variable.
    """

    def __init__(self, measurement_log: MeasurementLog, lag: int, landmarks: int) -> None:
        self.first = 0
        self._measurement_log = measurement_log
        self._lag = lag
        self._most = landmarks
        self._landmarks: set[int] = set()

    def restart(self) -> None:
        """Note that everything on record is in the solver again."""
        self.first = 0
        self._landmarks = set(self._measurement_log.history.explicit)

    def enter(self, landmark: int) -> None:
        """Note that a landmark has become a variable."""
        self._landmarks.add(landmark)

    def advance(self, change: Change) -> None:
        """Put what leaves with the newest pose, and what stays, into the change; that pose is on record already."""
        first = self._measurement_log.path.count - self._lag
        if first < self.first + max(1, self._lag // _SHARE):
            return
        self._finish_tracks(first)
        gone = self._landmarks_before(first)
        change.leaving = [*map(pose_key, range(self.first, first)), *gone]
        self._landmarks.difference_update(gone)
        newest = self._measurement_log.path.count - 1
        change.staying = [*map(pose_key, range(first, newest)), *sorted(self._landmarks)]
        self.first = first

    def _finish_tracks(self, first: int) -> None:
        """Finish the smart factors that hold poses before frame `first`."""
        oldest = pose_key(first)
        for track in self._measurement_log.landmarks.tracks.values():
            if track.keys and track.keys[0] < oldest:
                self._measurement_log.finish(track)

    def _landmarks_before(self, first: int) -> list[int]:
        """Variables to leave, last measured before frame `first`: of landmarks not in the map any more, and surplus."""
        frame, marks = self._measurement_log.measurements.frame, self._measurement_log.landmarks
        explicit = self._measurement_log.history.explicit
        last = {key: int(frame[explicit[key][-1]]) for key in self._landmarks.intersection(explicit)}
        mapped = set(marks.variable[marks.variable >= 0].tolist())
        old = sorted((key for key, k in last.items() if k < first), key=lambda key: (key in mapped, last[key], key))
        erased = sum(key not in mapped for key in old)
        gone = old[: max(erased, len(self._landmarks) - self._most)]
        marks.variable[np.isin(marks.variable, gone)] = -1
        return gone
