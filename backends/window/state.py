"""What the window back end knows: a frozen value that a call replaces when all of it is done; and its options."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam.bounds import require_not_negative
from slam.data import IdArray, IndexArray
from slam.geometry.arrays import LandmarkRows, changed
from slam.geometry.se3 import Array, exp, inverse, log
from slam.window.marginal import Conditional
from slam.window.problem import Motion, Places, RelativePrior, Rows
from slam.window.stereo import relative_covariance


@dataclass(frozen=True)
class WindowConfig:
    """Options of `WindowBackend`.

    Attributes:
        poses: most poses whose measurements are kept and linearised again with every frame; of as many, two leave.
        reference: frames after which another pose becomes the one that the marginal prior is relative to.
        lag: least number of poses that are revised with what later frames measure; older ones are final.
        landmarks: most landmarks that keep their covariance with the poses once the first pose that saw them has left.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    poses: int = 8
    reference: int = 10
    lag: int = 50
    landmarks: int = 100

    def __post_init__(self) -> None:
        ranges = {"poses": (3, 10**3), "reference": (1, 10**6), "lag": (0, 10**5), "landmarks": (0, 10**5)}
        require_not_negative(self, ranges, "window")


@dataclass(frozen=True, eq=False)
class WindowLandmarks(LandmarkRows):
    """A row for each landmark, and for each that was removed (its id is −1) but has measurements in the window."""

    serial: IdArray  # number of each in the order of their coming (S,); an id may come back, a serial number not
    position: Array  # in world coordinates (S, 3) [m]
    local: Array  # covariance (S, 3, 3) [m²] in the coordinates of the newest pose that was solved for
    world: Array  # covariance (S, 3, 3) [m²] in world coordinates
    last: IndexArray  # number of the frame that measured it last (S,)
    mean: Array  # what was known beforehand, in world coordinates, and is not in the prior yet: position (S, 3)
    information: Array  # and information (S, 3, 3), zero for nothing
    by_rig: Array  # derivatives of the positions by errors of the rig (S, 3, m)

    @classmethod
    def none(cls, m: int = 0) -> WindowLandmarks:
        """No landmark."""
        none, three, nine = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
        return cls(none, none, three, nine, nine, none, three, nine, np.zeros((0, 3, m)))


@dataclass(frozen=True, eq=False)
class Left:
    """Poses that left the window at once, and landmarks that left the prior with them, given all that stayed."""

    frames: IndexArray  # numbers of their frames (Q,), and T_world_left (Q, 4, 4) then
    poses: Array
    serials: IdArray  # of landmarks that left (G,), and positions then (G, 3)
    points: Array
    stayed_frames: IndexArray  # of poses that stayed (P,), (P, 4, 4)
    stayed_poses: Array
    stayed_serials: IdArray  # of landmarks that stayed (D,), (D, 3)
    stayed_points: Array
    conditional: Conditional  # changes of what left by those of what stayed


@dataclass(frozen=True, eq=False)
class WindowState:
    """The window. Rows, places, motion and prior name poses by place in the window, landmarks by row."""

    frames: IndexArray  # numbers of its frames (K,), ascending; the last one is the newest
    stamps: Array  # their times (K,) [s]
    poses: Array  # T_world_left (K, 4, 4)
    covariance: Array  # of the poses together (6 K, 6 K)
    by_rig: Array  # derivatives of the poses by errors of the rig (6 K, m); of the first one, before it is there
    solved: int = 0  # place in the window of the newest pose that was solved for
    begun: int = 0  # number of the frame in which the present problem begins: the first, or that of a restart
    # covariance of the attitude of the pose with which the problem begins (3, 3) [rad²], about the world's axes
    turned: Array = field(default_factory=lambda: np.zeros((3, 3)))
    rows: Rows = field(default_factory=Rows.none)
    places: Places = field(default_factory=Places.none)
    motion: Motion = field(default_factory=Motion.none)
    prior: RelativePrior = field(default_factory=RelativePrior.none)
    cost: float = 0.0  # sum of squares at the estimate
    landmarks: WindowLandmarks = field(default_factory=WindowLandmarks.none)
    past: tuple[Left, ...] = ()  # poses that have left the window and are still revised, the oldest first
    serials: int = 0  # number of landmarks so far
    measured: bool = False  # whether the newest pose may not be updated any more
    contradicted: int = 0  # updates in succession in which most observations agreed on another pose than expected

    @classmethod
    def empty(cls, by_rig: Array) -> WindowState:
        """Before the first prediction; `by_rig` (6, m) is of the first pose."""
        none, landmarks = np.zeros(0, np.int64), WindowLandmarks.none(by_rig.shape[1])
        return cls(none, np.zeros(0), np.zeros((0, 4, 4)), np.zeros((0, 0)), by_rig, landmarks=landmarks)

    def relative(self, earlier: int) -> Array:
        """Covariance (6, 6) of the newest pose relative to another one of the window, both perturbed on the right."""
        if earlier == len(self.frames) - 1:
            return np.zeros((6, 6))
        return relative_covariance(self.covariance, self.poses[earlier], self.poses[-1], 6 * earlier)

    def revised_poses(self) -> dict[int, Array]:
        """Poses (4, 4) by frame, of the window and of its past.

        Each pose that left follows from what stayed then, beginning with the one that left last (as in the backward
        pass of Rauch, Tung and Striebel).
        """
        marks, members = self.landmarks, self.prior.points
        known = dict(zip(self.frames.tolist(), self.poses))
        where = dict(zip(marks.serial[members].tolist(), marks.position[members]))
        for one in reversed(self.past):
            now = np.array([where[serial] for serial in one.stayed_serials.tolist()]).reshape(-1, 3)
            poses = np.array([known[frame] for frame in one.stayed_frames.tolist()])
            moved, turned = one.conditional.of(now - one.stayed_points, log(inverse(one.stayed_poses) @ poses))
            known.update(zip(one.frames.tolist(), one.poses @ exp(turned)))
            where.update(zip(one.serials.tolist(), one.points + moved))
        return known


def settle(before: WindowState, after: WindowState, lag: int) -> tuple[WindowState, dict[int, Array]]:
    """The state after a step with a past of `lag` frames, and the poses (4, 4) by frame that are final with it.

    The past is cut once it is half as long again.
    """
    if after.begun != before.begun:  # the problem was begun anew: what was before is final
        return after, before.revised_poses()
    if after.past is before.past:
        return after, {}
    surplus = sum(len(one.frames) for one in after.past) - lag
    if surplus <= lag // 2:
        return after, {}
    cut, poses = 0, after.revised_poses()
    final: list[int] = []
    while len(final) < surplus:
        final += after.past[cut].frames.tolist()
        cut += 1
    return changed(after, past=after.past[cut:]), {frame: poses[frame] for frame in final}
