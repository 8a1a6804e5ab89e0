"""Whether a body has moved relative to the world: a test against the whole uncertainty of what its tracks measured.

Two tests must agree, the weaker of which counts. The velocity on which the members' displacements from older to recent
frames agree is known to within

- their own noise, whose size is that of their scatter about it (matches slide over a surface, depths err,
  limbs swing), so that the test is an F test,
- the error of the camera's motion in between, as the rest of the scene tells it, and
- the error of the rig, which is no smaller than the noise of a pixel, but lasts: what is seen with a wrong disparity
  seems to move as the camera does. Members share these two errors, which do not fall with their number.

Members also share errors of which nothing is known: that of a junction of two edges at different depths, for instance,
which slides along both as the camera moves, with all features around it. Therefore the body's places in the frames of
the window must lie along a way better than they scatter about it (a second F test): such a junction jumps, and a body
goes on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from slam.bodies.belief import MIN_POINTS
from slam.bodies.bodies import Body
from slam.bodies.finder import Displacements, Scene
from slam.bodies.fits import EXPLAINED, times_vectors
from slam.bodies.frame import Frame
from slam.chi_square import chi_square_limit
from slam.data import IndexArray
from slam.geometry.arrays import median
from slam.geometry.se3 import Array, points_by_pose
from slam.tracks.table import Tracks

PROVEN = 12.0  #: −log10 of the chance from which a body has moved for certain if it went farther than the camera; at 8
#: the same bodies are found in `boxes` and on drives, and twice as many pieces of a walker
PROOF = 4  #: by frames that are certain by both tests, each of which counts twice, or by the left image and members
_SLIDES = 20.0  # the same elsewhere: what slides with the camera was seen to agree by up to some 1e-19
_FARTHER = 2.0  # times the camera's way; from 2 to 4 nothing changes, at 1 what slides in EuRoC MH_01 is a body
_ALLOWANCE = 3.0  # −log10 of the chance below which a frame says that a body moves
_MOST = 40.0  # numerics: of the evidence of a frame
_MEDIAN = chi_square_limit(3, 0.5)  # of χ²(3)
_LASTS = 0.2  # [px] of the left image's errors that all features near one another share: those of a good calibration
_TINY = 1e-9  # numerics: of squared angles
_SINGULAR = 1e-6  # numerics: share of the trace
_WEAK = 1e-9  # numerics: of information [1/m²], of variance [m²]


@dataclass(frozen=True, eq=False)
class Way:
    """Where a body was in the frames of the window."""

    places: Array  # of its middle in some of them (K, 3), in world coordinates [m]
    times: Array  # of these frames (K,) [s]
    by_rig: Array  # how far it seems to go in a frame by a disparity that is wrong by the deviation of a pixel (3,) [m]
    of_camera: float  # how far the camera went in these frames [m]
    # whether it is a part of another body, which moves for certain: it does not slide over the still world
    part: bool = False

    @classmethod
    def of(cls, body: Body, frame: Frame) -> Way:
        """Of a body that is measured, in those frames of the window in which it was."""
        stamps, cameras = frame.stamps, frame.poses
        seen = np.flatnonzero(body.known & np.isfinite(stamps))
        seen = seen[np.argsort(stamps[seen])]
        places = body.history[seen, :3, :3] @ (0.5 * (body.lower + body.upper)) + body.history[seen, :3, 3]
        rays = places - cameras[seen, :3, 3]
        depth = np.einsum("ni,ni->n", rays, cameras[seen, :3, 2])
        off = rays * (frame.setup.depth_noise(depth) / depth)[:, None]  # by a disparity that is wrong by sigma
        camera = float(np.linalg.norm(np.ptp(cameras[seen, :3, 3], axis=0)))
        by_rig = (off[-1] - off[0]) / max(len(seen) - 1, 1)
        return cls(places, stamps[seen], by_rig, camera, body.apart_from is not None)

    @property
    def bar(self) -> float:
        """−log10 of the chance that is asked for: what goes farther than the camera hardly slides with it."""
        length = float(np.linalg.norm(np.ptp(self.places, axis=0)))
        if self.part or length > _FARTHER * self.of_camera:
            return PROVEN
        return _SLIDES


def with_frame(
    evidence: float, moved: Displacements, scene: Scene, way: Way, left: float, far: bool
) -> tuple[float, int]:
    """The evidence that a body moves still, after one more frame, and what this frame counts for its `PROOF`.

    The evidence is a cumulative sum of −log10 of the chance that the weaker test gives; it fades while a body rests.
    `left` is what the left image says; for a body that was followed `far`, for farther than it is wide, its way alone
    counts.
    """
    by_frames = -float(np.log10(max(_by_frames(way), 10.0**-_MOST)))
    by_members = 0.0
    if len(moved.d) >= MIN_POINTS:
        by_members = -float(np.log10(max(_by_members(moved, scene, way.by_rig), 10.0**-_MOST)))
        evidence = max(0.0, evidence + (by_frames if far else min(by_frames, by_members)) - _ALLOWANCE)
    if by_frames >= way.bar and (far or by_members >= way.bar):
        return evidence, 2
    return evidence, int(by_members >= PROVEN and left >= _SLIDES)


def _by_members(moved: Displacements, scene: Scene, by_rig: Array) -> float:
    """Probability of so large a velocity of the members if they stand still."""
    lag = moved.lag[:, None, None]
    total = np.linalg.inv((lag**2 * moved.W).sum(axis=0) + _WEAK * np.eye(3))
    by_common = -lag * points_by_pose(moved.points)
    gap = moved.d - by_common @ scene.common
    weight = total @ (lag * moved.W)
    velocity = np.einsum("nij,nj->i", weight, gap)
    rest = gap - moved.lag[:, None] * velocity
    scatter = median(np.einsum("ni,nij,nj->n", rest, moved.W, rest)) / _MEDIAN
    by_pose = np.einsum("nij,njk->ik", weight, by_common)
    shared = by_pose @ scene.covariance @ by_pose.T + np.outer(by_rig, by_rig)
    test = float(velocity @ np.linalg.solve(max(scatter, 1.0) * total + shared, velocity))
    return float(chdtrc(3, test))


def by_left_image(tracks: Tracks, rows: IndexArray, frame: Frame, scene: Scene) -> float:
    """What the left image alone says of tracks (N,): −log10 of the chance that they stand still, at whatever depth.

    What stereo matched wrongly, a wall with the right pixel of the rail before it, moves as the camera does, smoothly
    and with all its neighbours; but to the left camera it stands still, at another depth. So an even velocity that all
    points share is tested against points that stand still at any depth, by an F test, and against errors that all
    share: of the camera's motion, and of the lens. It is worth nothing where the second explains nearly all of it.
    """
    rows = rows[np.count_nonzero(tracks.dof[rows], axis=1) >= MIN_POINTS]
    known, n = tracks.dof[rows] > 0, len(rows)
    dof = int(2 * known.sum()) - 3 * n - 3
    if n < MIN_POINTS or dof < MIN_POINTS:
        return 0.0
    eyes, ages, each = frame.poses[:, :3, 3], frame.ages, np.arange(n)
    frames = float(ages[np.isfinite(frame.stamps)].max())
    points = tracks.anchor[rows, None] + tracks.p[rows] - frame.eye
    common = (points_by_pose(points.reshape(-1, 3)) @ scene.common).reshape(points.shape)
    rays = np.where(known[..., None], points + (frame.eye - eyes) - ages[:, None] * common, 1.0)
    depth = np.linalg.norm(rays, axis=2)
    rays /= depth[..., None]
    newest = np.argmin(np.where(known, ages, len(ages)), axis=1)
    ahead, near = rays[each, newest], 1.0 / depth[each, newest]
    across = np.where(known[..., None, None], np.eye(3) - rays[..., None] * rays[..., None, :], 0.0)
    parallax = times_vectors(across, (eyes - eyes[newest, None]) * near[:, None, None])
    # how far each ray is off a still point, and how that changes with the point's depth and with the velocity
    off = parallax - times_vectors(across, ahead[:, None])
    by_velocity = across * (near[:, None] * -ages / frames)[..., None, None]
    columns = np.concatenate([off[..., None], parallax[..., None], by_velocity], axis=3)
    towards = across.sum(axis=1) + ahead[:, :, None] * ahead[:, None]  # best directions, whatever the rest
    columns -= across @ np.linalg.solve(towards, columns.sum(axis=1))[:, None]
    columns = columns.reshape(n, -1, 5)
    still = float((columns[..., 0] ** 2).sum())
    by_depth = columns[..., 1:2]
    best = (by_depth * columns).sum(axis=1) / ((by_depth**2).sum(axis=1) + _TINY)  # depths, whatever the velocity
    columns = (columns - by_depth * best[:, None]).reshape(-1, 5)
    off, by_velocity = columns[:, 0], columns[:, 2:]
    information = by_velocity.T @ by_velocity
    information += _SINGULAR * np.trace(information) * np.eye(3)
    velocity = np.linalg.solve(information, by_velocity.T @ off)  # in the frames of the window [m]
    rest, moving = float(off @ off), float(((off - by_velocity @ velocity) ** 2).sum()) + _TINY**2
    if rest - moving < EXPLAINED * (still - moving):
        return 0.0
    by_common = frames * points_by_pose(points[each, newest].mean(axis=0)[None])[0]
    lens = 12.0 * (_LASTS / (frame.setup.rig.left.fu * np.median(near))) ** 2  # 12: an even motion's square by its mean
    shared = by_common @ scene.covariance @ by_common.T + lens * np.eye(3)
    test = velocity @ np.linalg.solve(np.linalg.inv(information) * moving / dof + shared, velocity)
    chance = max(float(fdtrc(3, dof, (rest - moving) / 3.0 / (moving / dof))), float(chdtrc(3, test)))
    return -float(np.log10(max(chance, 10.0**-_MOST)))


def _by_frames(way: Way) -> float:
    """Probability of so long a way, even or evenly accelerated, if it is chance, as the scatter about it is."""
    n = len(way.places)
    if n < MIN_POINTS:
        return 1.0
    t = way.times - way.times.mean()
    basis, _ = np.linalg.qr(np.stack([np.ones(n), t, t * t], axis=1))
    offset = way.places - way.places.mean(axis=0)
    along = float(((basis[:, 1:].T @ offset) ** 2).sum())
    rest = max(float((offset**2).sum()) - along, 0.0) + _WEAK
    return float(fdtrc(6, 3 * n - 9, (along / 6.0) / (rest / (3 * n - 9))))
