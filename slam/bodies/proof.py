"""Whether a body has moved in the world, or a part of one in its whole, given all that is uncertain of its tracks.

Two tests must agree, the weaker of which counts. The motion on which the members' displacements from older to recent
frames agree, less that of the rest of the scene, is known to within

- their own noise, whose size is that of their scatter about it (matches slide over a surface, depths err, limbs swing),
- the error of the camera's motion in between, as the rest of the scene tells it, and
- the error of the rig, which is no smaller than the noise of a pixel, but lasts: what is seen with a wrong disparity
  seems to move as the camera does. Members share these two errors, which do not fall with their number.

Members also share errors of which nothing is known: a junction of two edges at different depths slides along both as
the camera moves. Therefore the body's places in the frames of the window, or those of its ends, must lie along a way
better than they scatter about it (an F test): a junction jumps. What the way has in common with the camera's says
nothing, nor do members that find a right match in half of their frames only, as along a repeated pattern. What was
followed for far must go a way in the camera's axes, too: a bonnet, or a reflection in a windscreen, rests there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from slam.bodies.bodies import Body
from slam.bodies.config import MIN_POINTS
from slam.bodies.finder import Displacements, Scene
from slam.bodies.frame import Frame
from slam.bodies.scene_kernels import MEDIAN, PRIOR
from slam.geometry.arrays import median
from slam.geometry.se3 import Array, inverse, points_by_pose

PROVEN = 12.0  #: −log10 of the chance from which a frame proves that a body moves that went farther than the camera
_SLIDES = 20.0  # the same elsewhere: what slides with the camera was seen to agree by up to 1e-16
_FARTHER = 2.0  # times the camera's way; from 2 to 4 nothing changes, at 1 what slides in EuRoC MH_01 is a body
_BOTH = 0.75  # share of measurements that both cameras make: of bodies 0.93, with wrong matches 0.5
_ALLOWANCE = 3.0  # −log10 of the chance below which a frame says that a body moves
_MOST = 40.0  # numerics: of the evidence of a frame
_WEAK = 1e-9  # numerics: of variance [m²]
_ENDS = 0.5 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])  # of a body, from its middle, in its sides


@dataclass(frozen=True, eq=False)
class Way:
    """Where a body was in the frames of the window."""

    places: Array  # of its middle and ends in some of them (K, 4, 3), in the world or in its whole [m]
    in_view: Array  # the same in the camera's axes (K, 4, 3) [m]
    times: Array  # of these frames (K,) [s]
    by_rig: Array  # how far it seems to go in a frame by a disparity that is wrong by the deviation of a pixel (3,) [m]
    cameras: Array  # where the camera was in these frames (K, 3) [m]

    @classmethod
    def of(cls, body: Body, frame: Frame, whole: Body | None) -> Way:
        """Of a body that is measured, in those frames of the window in which it was: in the world, or in its whole."""
        stamps, cameras, history = frame.stamps, frame.poses, body.history
        known = body.known & np.isfinite(stamps)
        if whole is not None:
            axes, known = inverse(whole.history), known & whole.known
            cameras, history = axes @ cameras, axes @ history
        seen = np.flatnonzero(known)
        seen = seen[np.argsort(stamps[seen])]
        ends = 0.5 * (body.lower + body.upper) + _ENDS * (body.upper - body.lower)
        cameras, history = cameras[seen], history[seen]
        places, in_view = (
            T[:, None, :3, 3] + ends @ np.swapaxes(T[:, :3, :3], 1, 2) for T in (history, inverse(cameras) @ history)
        )
        rays, depth = places[:, 0] - cameras[:, :3, 3], in_view[:, 0, 2]
        off = rays * (frame.setup.depth_noise(depth) / depth)[:, None]  # by a disparity that is wrong by sigma
        by_rig = (off[-1] - off[0]) / max(len(seen) - 1, 1)
        return cls(places, in_view, stamps[seen], by_rig, cameras[:, :3, 3])

    @property
    def bar(self) -> float:
        """−log10 of the chance from which it is certain: what slides does not go farther than the camera by far."""
        went = np.linalg.norm(np.ptp(self.places, axis=0), axis=1).max()
        return PROVEN if went > _FARTHER * np.linalg.norm(np.ptp(self.cameras, axis=0)) else _SLIDES

    def beside_camera(self) -> Array:
        """The places (K, 4, 3) less the share of the camera's way, 0 to 1, that is most like the way of their middle.

        What is seen at a wrong depth z instead of Z seems to go the share 1 − z/Z of the camera's way, as evenly.
        """
        camera = (self.cameras - self.cameras.mean(axis=0))[:, None]
        share = (self.places[:, :1] * camera).sum() / max(float((camera**2).sum()), _WEAK)
        return np.asarray(self.places - np.clip(share, 0.0, 1.0) * camera)


def with_frame(
    evidence: float, moved: Displacements, scene: Scene, way: Way, far: bool, both: float
) -> tuple[float, int]:  # fmt: skip
    """The evidence that a body moves still, after one more frame, and what this frame counts for its `PROOF`.

    The evidence is a cumulative sum of −log10 of the chance that the weaker test gives; it fades while a body rests.
    For a body that was followed `far`, for farther than it is wide, its way alone counts, if it goes one in the
    camera's axes as well. Both cameras made the share `both` of the members' measurements.
    """
    says, turns, bar = _by_frames(way.places if far else way.beside_camera(), way.times), 0.0, way.bar
    if both < _BOTH or (far and _by_frames(way.in_view, way.times) < PROVEN):
        bar = np.inf
    if len(moved.d) < MIN_POINTS:
        return evidence, 2 * (far and says >= bar)
    if not far:
        by_members, turns = _by_members(moved, scene, way.by_rig)
        says = min(says, by_members)
    counts = 0 if says < max(0.5 * PROVEN, bar - turns) else 2 if says >= PROVEN else 1
    return max(0.0, evidence + says - _ALLOWANCE), counts


def _evidence(chance: float) -> float:
    """−log10 of a chance."""
    return -float(np.log10(max(chance, 10.0**-_MOST)))


def _by_members(moved: Displacements, scene: Scene, by_rig: Array) -> tuple[float, float]:
    """−log10 of the chance of so large a common motion of the members, and of such a turn, if they stand still."""
    J, dof = -moved.lag[:, None, None] * points_by_pose(moved.points), 3 * len(moved.d)
    JW = np.swapaxes(J, 1, 2) @ moved.W
    P = np.linalg.inv((JW @ J).sum(axis=0) + np.diag(PRIOR))
    gap = moved.d - J @ scene.common
    motion = P @ np.einsum("nij,nj->i", JW, gap)
    rest = gap - J @ motion
    scatter = median(np.einsum("ni,nij,nj->n", rest, moved.W, rest)) / MEDIAN * dof / (dof - 6)
    covariance = max(scatter, 1.0) * P + scene.covariance
    covariance[3:, 3:] += np.outer(by_rig, by_rig)
    turn = motion[:3] @ np.linalg.solve(covariance[:3, :3], motion[:3])
    motion_test = motion @ np.linalg.solve(covariance, motion)
    return _evidence(float(chdtrc(6, motion_test))), _evidence(float(chdtrc(3, turn)))


def _by_frames(places: Array, times: Array) -> float:
    """What its way says: −log10 of the chance of so long a one, even or evenly accelerated, by its scatter about it."""
    n = len(places)
    if n < MIN_POINTS:
        return 0.0
    t = times - times.mean()
    bend = t * t - (t @ t) / n
    bend -= t * ((bend @ t) / (t @ t))
    basis = np.array([t / np.sqrt(t @ t), bend / np.sqrt(bend @ bend)])
    offset = (places - places.mean(axis=0)).reshape(n, -1)
    ways, squares = np.square(basis @ offset).sum(axis=0), np.square(offset).sum(axis=0)  # of the middle first
    both = ((float(ways[:k].sum()), float(squares[:k].sum())) for k in (3, len(ways)))
    ratio = max(way / (max(every - way, 0.0) + _WEAK) for way, every in both)
    return _evidence(2.0 * float(fdtrc(6, 3 * n - 9, ratio * (3 * n - 9) / 6.0)))
