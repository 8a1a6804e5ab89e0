"""Which measurement goes into which factor of the graph: smart factors that grow, and landmarks that are variables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from backends.smoother.factors import FactorMaker, landmark_key, pose_key, to_pose3
from backends.smoother.landmarks import VARIABLE
from backends.smoother.state import SmootherState
from slam.geometry.se3 import Array, inverse, transform
from slam.window.motion import STANDS, is_first

_LOOSE = np.diag(np.repeat([9.0, 1e4], 3))  # numerics: variances [rad²], [m²] of a motion that is unknown
_LONGEST = 64  # cost: measurements in a factor of what was a variable; its cost grows with their square


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
    slot: int = -1  # of the factor in the solver, −1 while there is none


@dataclass
class GraphProblem:
    """Factors and first values, and what grew."""

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)  # for gtsam
    values: gtsam.Values = field(default_factory=gtsam.Values)
    removed: list[int] = field(default_factory=list)  # slots of factors that others replace
    # smart factors with new measurements, by serial number of the landmark and number of the first pose
    grown: dict[tuple[int, int], Track] = field(default_factory=dict)
    ages: dict[Any, Any] = field(default_factory=dict)  # of variables, for the fixed lag: `SmootherState.ages`
    to_graph: Array = field(default_factory=lambda: np.eye(4))  # takes the state's coordinates to gtsam's


class Tracks:
    """Landmarks as factors: which measurement goes into which. Each is used once.

    A landmark is a smart factor that grows until the landmark goes on in a new one (`SmootherLandmarks.measured`):
    factors end before their first pose leaves the lag. A landmark of which more is known than what was measured is a
    variable of its own, and so are some that were measured for longer: those take over what is in their smart factor.

    No slot is named after its factor has left the solver: a factor begins at most `track` poses before the newest one,
    which is no more than the lag and one (`Steps.track`).
    """

    def __init__(self, make: FactorMaker, lag: int | None) -> None:
        self._make, self._lag = make, lag
        self._smart: dict[int, Track] = {}
        self._variables: dict[int, int] = {}  # numbers of the poses as long as which they stay
        self._oldest = 0  # number of the oldest pose in the graph

    def add_pose(self, problem: GraphProblem, s: SmootherState, number: int, oldest: int) -> None:
        """A pose, and its motion since the one before it, if it is not the `oldest` in the graph."""
        if number > oldest:
            problem.factors.add(self._motion(s, number, oldest))
        problem.values.insert(pose_key(number), to_pose3(problem.to_graph @ s.poses[s.of(number)]))
        problem.ages[pose_key(number)] = float(s.ages[s.of(number)])

    def _motion(self, s: SmootherState, number: int, oldest: int) -> gtsam.NonlinearFactor:
        """What the motion model says of a pose: its velocity is that between the two poses before, but for noise.

        Where the graph has but one of these two, the pose is hardly held where it is.
        """
        row, (dt, before) = s.of(number), s.intervals(number)
        if s.rests[row]:
            return self._make.tie(number - 1, number, np.eye(4), STANDS**2 * np.eye(6))
        if not is_first(before, dt) and number - 2 < oldest:
            return self._make.tie(number - 1, number, inverse(s.poses[row - 1]) @ s.poses[row], _LOOSE)
        count = 2 if is_first(before, dt) else 3
        keys = [pose_key(i) for i in range(number + 1 - count, number + 1)]
        return self._make.motion(keys, np.array([before or np.nan, dt]))

    def add_rows(self, problem: GraphProblem, s: SmootherState, number: int, oldest: int, begin: int = 0) -> None:
        """What was measured from a pose, from some row on."""
        sight, make, some = s.sights[s.of(number)], self._make, bool(s.known or self._variables)
        key = pose_key(number)
        rows = (column[begin:].tolist() for column in (sight.serials, sight.since, sight.z))
        for serial, since, z in zip(*rows):
            point = make.point(z)
            if some and self._is_variable(problem, s, serial, since, oldest):
                self._stays(problem, s, serial, number)
                problem.factors.add(make.explicit(point, number, serial))
                continue
            track = self._smart.get(serial)
            if track is None or not (
                track.since == since
                if since != VARIABLE  # what was a variable, and is none in a graph that was built anew
                else track.poses[0] >= oldest - 1 and len(track.poses) < _LONGEST
            ):
                self._smart[serial] = track = Track(since)
            track.poses.append(number)
            track.keys.append(key)
            track.points.append(point)
            track.stereo = track.stereo or z[2] == z[2]  # not NaN
            track.far = track.far or z[0] - z[2] < make.far
            problem.grown[serial, track.poses[0]] = track
            if since == VARIABLE and track.stereo:
                self._turn(problem, s, serial, number)

    def keep(self, problem: GraphProblem, s: SmootherState) -> list[int]:
        """Variables that the state keeps do not leave; their serial numbers."""
        kept = list(filter(self._is_there, s.landmarks.serial[s.landmarks.since == VARIABLE].tolist()))
        for serial in kept:
            self._stays(problem, s, serial, s.number)
        return kept

    def _is_there(self, serial: int) -> bool:
        """Whether a variable has not left the lag."""
        return serial in self._variables and self._variables[serial] >= self._oldest

    def _stays(self, problem: GraphProblem, s: SmootherState, serial: int, number: int) -> None:
        """A variable stays for as long as a pose."""
        self._variables[serial] = number
        problem.ages[landmark_key(serial)] = float(s.ages[s.of(number)])

    def _turn(self, problem: GraphProblem, s: SmootherState, serial: int, number: int) -> None:
        """A landmark becomes a variable, if the state has it as one, with the measurements of its smart factor."""
        row = np.flatnonzero((s.landmarks.serial == serial) & (s.landmarks.since == VARIABLE))
        if not len(row):
            return
        track = self._smart.pop(serial)
        del problem.grown[serial, track.poses[0]]
        if track.slot >= 0:
            problem.removed.append(track.slot)
        for pose, point in zip(track.poses, track.points):
            problem.factors.add(self._make.explicit(point, pose, serial))
        problem.values.insert(landmark_key(serial), transform(problem.to_graph, s.landmarks.position[row])[0])
        self._stays(problem, s, serial, number)

    def _is_variable(self, problem: GraphProblem, s: SmootherState, serial: int, since: int, oldest: int) -> bool:
        """Whether a landmark is a variable; it becomes one if it is known beforehand, and that was not used yet.

        It was if the landmark was measured before the pose with which the graph begins: the prior of that pose holds
        it. The prior of the pose with which the problem begins holds no measurement.
        """
        known = s.known.get(serial)
        if serial in self._variables and (since == VARIABLE or known is not None):
            return self._is_there(serial)
        if known is None or 0 <= known.pose < oldest:
            return False
        if known.pose < 0 <= known.used <= oldest and oldest > s.begun:
            return False
        self.add_known(problem, s, serial)
        return True

    def add_known(self, problem: GraphProblem, s: SmootherState, serial: int) -> None:
        """A landmark of which something is known, as a variable."""
        known = s.known[serial]
        if known.pose < 0:
            problem.factors.add(self._make.known(serial, known.position, known.covariance))
            place = known.position
        else:
            problem.factors.add(self._make.known_from(known.pose, serial, known.position, known.covariance))
            place = transform(problem.to_graph @ s.poses[s.of(known.pose)], known.position[None])[0]
        problem.values.insert(landmark_key(serial), place)

    def make_smart(self, problem: GraphProblem, silent: bool) -> list[tuple[Track, int]]:
        """The smart factors of what grew, and their places in the problem; see `FactorMaker.smart`."""
        made = []
        for track in problem.grown.values():
            if track.stereo and len(track.poses) > 1:
                if track.slot >= 0:
                    problem.removed.append(track.slot)
                made.append((track, problem.factors.size()))
                problem.factors.add(self._make.smart(track.points, track.keys, silent or track.far))
        return made

    def forget(self, s: SmootherState, oldest: int) -> None:
        """After its newest pose was solved for: forget what will not grow or come back; once in a while.

        A landmark that was known beforehand stays listed, so that the graph is not told of it again.
        """
        self._oldest = oldest
        if self._lag is not None and not s.number % self._lag:
            self._smart = {n: track for n, track in self._smart.items() if track.poses[0] >= oldest}
            self._variables = {n: last for n, last in self._variables.items() if last >= oldest or n in s.known}
