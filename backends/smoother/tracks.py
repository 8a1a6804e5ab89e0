"""Which measurement goes into which factor of the graph: smart factors that grow, and landmarks that are variables."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
from gtsam.symbol_shorthand import L, X

from backends.smoother.factors import FactorMaker, GraphUpdate, SmartFactor
from backends.smoother.state import SmootherState
from slam.geometry.se3 import Array, transform


@dataclass
class Track:
    """A landmark's smart factor."""

    since: int  # see `SmootherLandmarks.since`
    poses: list[int] = field(default_factory=list)  # numbers of the poses that measured it
    keys: list[int] = field(default_factory=list)  # their variables, and the measurements
    points: list[gtsam.StereoPoint2] = field(default_factory=list)
    # whether one of them has a right pixel: gtsam's factor throws where it is given left pixels only
    stereo: bool = False
    far: bool = False  # whether noise alone may put it behind the camera, by one of them
    factor: SmartFactor | None = None  # None while there are too few measurements
    slot: int = -1  # of the factor in the solver


class Tracks:
    """Landmarks as factors: which measurement goes into which. Each is used once.

    A landmark is a smart factor that grows until the landmark goes on in a new one (`SmootherLandmarks.measured`):
    factors end before their first pose leaves the lag. A landmark of which more is known than what was measured is a
    variable, and so are those that are in the state: these take over the measurements of their smart factor.

    A factor begins at most `track` poses before the newest one, which is no more than the lag and one (`Steps.track`):
    it takes no measurement any more when its first pose has left, and gtsam has marginalised it.
    """

    def __init__(self, make: FactorMaker) -> None:
        self._make = make
        self._smart: dict[int, Track] = {}
        # smart factors with measurements that gtsam lacks, by serial number of the landmark and first pose
        self._grown: dict[tuple[int, int], Track] = {}
        self._variables: dict[int, int] = {}  # numbers of the poses as long as which they stay
        self._told: set[int] = set()  # landmarks of which the graph was told what is known beforehand

    def add_rows(self, update: GraphUpdate, s: SmootherState, number: int, oldest: int, begin: int = 0) -> None:
        """What was measured from a pose, from some row on; `oldest` is the first pose that a factor may have."""
        sight, make, key, variables = s.sights[s.of(number)], self._make, X(number), s.landmarks.variables
        rows = (column[begin:].tolist() for column in (sight.serials, sight.since, sight.z))
        for serial, since, z in zip(*rows):
            point = make.point(z)
            new = serial in s.known and self._is_new(s, serial, oldest)
            if new:
                self._told.add(serial)
                update.add_known(s, serial)
            if new or (serial in self._variables and (serial in variables or serial in s.known)):
                self._stays(update, s, serial, number)
                update.factors.add(make.explicit(point, number, serial))
                continue
            track = self._smart.get(serial)
            if track is None or (track.poses[0] < oldest - 1 if serial in variables else track.since != since):
                self._smart[serial] = track = Track(since)
            track.poses.append(number)
            track.keys.append(key)
            track.points.append(point)
            track.stereo = track.stereo or z[2] == z[2]  # not NaN
            track.far = track.far or z[0] - z[2] < make.far
            self._grown[serial, track.poses[0]] = track
            if serial in variables and track.stereo:
                self._make_variable(update, serial, variables[serial])
                self._stays(update, s, serial, number)

    def keep(self, update: GraphUpdate, s: SmootherState) -> list[int]:
        """Variables that the state keeps do not leave; their serial numbers."""
        kept = [serial for serial in s.landmarks.variables if serial in self._variables]
        for serial in kept:
            self._stays(update, s, serial, s.number)
        return kept

    def _is_new(self, s: SmootherState, serial: int, oldest: int) -> bool:
        """Whether the graph was not told yet what is known of a landmark beforehand.

        It was if the landmark was measured before the pose with which the graph begins: the prior of that pose holds
        it. The prior of the pose with which the problem begins holds no measurement.
        """
        known = s.known[serial]
        if serial in self._told or 0 <= known.pose < oldest:
            return False
        return known.pose >= 0 or not 0 <= known.used <= oldest or oldest <= s.begun

    def _stays(self, update: GraphUpdate, s: SmootherState, serial: int, number: int) -> None:
        """A variable stays for as long as a pose."""
        self._variables[serial] = number
        update.timestamps[L(serial)] = float(s.ticks[s.of(number)])

    def _make_variable(self, update: GraphUpdate, serial: int, position: Array) -> None:
        """A landmark at a position (3,) becomes a variable, with the measurements of its smart factor."""
        track = self._smart.pop(serial)
        del self._grown[serial, track.poses[0]]
        if track.slot >= 0:
            update.removed.append(track.slot)
        for pose, point in zip(track.poses, track.points):
            update.factors.add(self._make.explicit(point, pose, serial))
        update.values.insert(L(serial), transform(update.to_graph, position[None])[0])

    def make_smart(self, update: GraphUpdate) -> list[tuple[Track, int]]:
        """The smart factors of what grew, and their places in the update."""
        made = []
        for track in self._grown.values():
            if track.stereo and len(track.poses) > 1:
                if track.slot >= 0:
                    update.removed.append(track.slot)
                made.append((track, update.factors.size()))
                track.factor = self._make.smart(track.points, track.keys)
                update.factors.add(track.factor)
        self._grown = {}
        return made

    def contradicted(self) -> bool:
        """Whether the measurements of a near landmark put it behind a camera: then poses are wrong.

        Noise alone may put a far one there. gtsam takes both for no information: so a path of a thousand frames of real
        tracks ran away.
        """
        return any(t.factor is not None and not t.far and not t.factor.isValid() for t in self._smart.values())

    def forget(self, s: SmootherState, oldest: int) -> None:
        """Forget what has left with the poses before the `oldest`: no slot is named after its factor has left."""
        self._smart = {n: track for n, track in self._smart.items() if track.poses[0] >= oldest}
        self._variables = {n: last for n, last in self._variables.items() if last >= oldest}
        self._told.intersection_update(s.known)
