"""Drives along any path: read from a file, levelled, sampled at a frame rate, and what of them is new road."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from slam.errors import SequenceError, TrajectoryError
from slam.files import expanded, read_text
from slam.geometry.se3 import Array, is_rotation, pose
from slam.geometry.trajectory import Trajectory
from slam.worlds.paths import camera_poses, sway

STEP = 0.5  #: distance between samples of a road [m]
SAME_ROAD = 5.0  #: a later drive within this distance of a road's middle runs along that road [m]
_FILE_RATE = 10.0  # of paths without stamps, KITTI's [Hz]
_SHORTEST, _LONGEST = 10.0, 100_000.0  # of a path [m]
_SMOOTHED = 2.0  # standard deviation of the filter that takes noise off the road's course [m]
_BEYOND = 60.0  # a road goes on so far behind the path's start and beyond its end [m]
_TURNED = 25.0  # what lies so much further along the path is another drive along a road, or another road [m]


def read_path(text: str) -> Trajectory:
    """The path of a file: rows of twelve numbers (KITTI, at 10 Hz) or of eight (TUM); stamps begin at 0.

    Raises SequenceError where no file is named, it is missing or no path, or nobody could drive along it.
    """
    if not text:
        raise SequenceError("no path is named: drive?path=FILE, poses in the form of KITTI or TUM")
    file = expanded(text)
    try:
        rows = (line.partition("#")[0].split() for line in read_text(file, error=TrajectoryError).splitlines())
        of_kitti = len(next(filter(None, rows), [])) == 12
        path = Trajectory.read_kitti(file) if of_kitti else Trajectory.read_tum(file)
    except TrajectoryError as error:
        raise SequenceError(str(error)) from error
    path = Trajectory(path.stamps / _FILE_RATE if of_kitti else path.stamps - path.stamps[0], path.poses)
    R, steps = path.poses[:, :3, :3], np.diff(path.positions, axis=0)
    wrong = ~is_rotation(R, 1e-3)
    if wrong.any():
        raise SequenceError(f"{file}: the pose of row {int(np.argmax(wrong))} has no rotation")
    down = R[:, :, 1].mean(axis=0)
    if np.linalg.norm(down) < 0.5 or abs(R[0, :, 2] @ down) > 0.9 * np.linalg.norm(down):
        raise SequenceError(f"{file}: no path of a vehicle: the camera's y axis must point downwards")
    length = float(np.linalg.norm((steps @ level(path).T)[:, :2], axis=1).sum())
    if not _SHORTEST <= length <= _LONGEST:
        limits = f"{_SHORTEST:.0f} m to {_LONGEST / 1000:.0f} km"
        raise SequenceError(f"{file}: a path of {length:.1f} m in {len(path)} poses; a drive needs {limits}")
    return path


def sampled(path: Trajectory, values: Mapping[str, Any]) -> Trajectory:
    """The path at the frames of the options `rate`, `speed` and `frames`; poses of the path stay as they are."""
    count = int(path.stamps[-1] * values["rate"] / values["speed"] + 1e-6) + 1
    stamps = np.arange(min(count, values["frames"] or count)) / values["rate"]
    times = np.minimum(stamps * values["speed"], path.stamps[-1])
    after = np.clip(np.searchsorted(path.stamps, times), 1, len(path) - 1)
    nearest = after - (times - path.stamps[after - 1] < path.stamps[after] - times)
    positions = interpolated(times, path.stamps, path.positions)
    turns = Slerp(path.stamps, Rotation.from_matrix(path.poses[:, :3, :3]))(times)
    poses = pose(turns.as_matrix(), positions)
    exact = np.abs(path.stamps[nearest] - times) < 1e-6
    poses[exact] = path.poses[nearest[exact]]
    return Trajectory(stamps, poses)


def level(path: Trajectory) -> Array:
    """Rotation (3, 3) from a path's axes to level ones: x right, y forward at the start, z up.

    Upwards is where the camera's y axis points away from, on average.
    """
    up = -path.poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = path.poses[0, :3, 2]
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


@dataclass(frozen=True, eq=False)
class Road:
    """The roads that a path runs along, sampled along the path; what is driven again counts once."""

    xy: Array  # middle of the road (N, 2) [m], level
    left: Array  # unit vectors to its left (N, 2)
    way: Array  # distance along the path (N,) [m], from below 0 to beyond its end
    drives: Array  # all of the path, also what is driven again (M, 3) [m], level

    @classmethod
    def along(cls, positions: Array) -> Road:
        """The roads of camera positions (N, 3) [m] in level axes."""
        way, course = _course(positions)
        heading = np.gradient(course[:, :2], axis=0)
        heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-9)
        left = np.stack([-heading[:, 1], heading[:, 0]], axis=1)
        new = np.zeros(len(way), bool)  # what is not within `SAME_ROAD` of an earlier road
        for i, near in enumerate(cKDTree(course[:, :2]).query_ball_point(course[:, :2], SAME_ROAD)):
            others = np.array(near)
            new[i] = not (new[others] & (way[others] < way[i] - _TURNED)).any()
        return cls(course[new, :2], left[new], way[new], course)


def _driven(places: Array) -> Array:
    """How far places (N, D) [m] are along their way (N,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


def interpolated(at: Array, way: Array, places: Array) -> Array:
    """Places (M, D) at so much of a way (M,), by those (N, D) that are known at `way` (N,)."""
    return np.stack([np.interp(at, way, x) for x in places.T], axis=1)


def _course(positions: Array) -> tuple[Array, Array]:
    """Distances along a path (N,) [m] in equal steps, and smoothed places there (N, 3) [m], continued at both ends."""
    way = _driven(positions[:, :2])
    moved = np.diff(way, prepend=-1.0) > 1e-4
    way = way[moved]
    even = np.arange(0.0, way[-1], STEP)
    course = gaussian_filter1d(interpolated(even, way, positions[moved]), _SMOOTHED / STEP, axis=0, mode="nearest")
    beyond = np.arange(STEP, _BEYOND, STEP)
    span, ends = min(round(4 / STEP), len(course) - 1), []
    for start, inner in ((0, span), (-1, -1 - span)):
        ahead = (course[start] - course[inner]) * (1, 1, 0)  # level
        ends.append(course[start] + beyond[:, None] * (ahead / max(float(np.linalg.norm(ahead)), 1e-9)))
    way = np.concatenate([-beyond[::-1], even, even[-1] + beyond])
    return way, np.concatenate([ends[0][::-1], course, ends[1]])


PACE = 8.0  #: driving speed of the built-in drive [m/s]
#: Where its streets meet [m]: once around both blocks, on around the first one, and back.
CORNERS = (
    (0, -20), (0, 110), (180, 110), (180, 0), (0, 0), (0, 110), (90, 110), (90, 0), (180, 0), (180, 110), (60, 110)
)  # fmt: skip
EYE = 1.65  #: height of the camera above the ground [m]
_LANE = 1.5  # from the middle of a street to the right [m]
_ROUND = 8.0  # standard deviation of the filter that rounds the corners [m]: their radius is 7 m
_SIDEWAYS = 2.0  # greatest acceleration in a bend [m/s²]
_STEP = 0.1  # [m]


def around_blocks(layout: int) -> Trajectory:
    """The built-in drive around the blocks of a town, at the usual pace."""
    way = _way()
    heading = np.gradient(way, _STEP, axis=0)
    yaw = np.unwrap(np.arctan2(-heading[:, 0], heading[:, 1]))
    bend = np.abs(np.gradient(yaw, _STEP))
    pace = np.minimum(PACE, np.sqrt(_SIDEWAYS / np.maximum(bend, 1e-9)))
    pace = gaussian_filter1d(pace, 6.0 / _STEP, mode="nearest")
    stamps = np.concatenate([[0.0], np.cumsum(2 * _STEP / (pace[1:] + pace[:-1]))])
    rng = np.random.default_rng([layout, 47])
    aside = 0.15 * sway(stamps, rng, 0.03, 0.15)
    across = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    return Trajectory(stamps, in_a_car(way + aside[:, None] * across, yaw, stamps, rng))


def in_a_car(xy: Array, yaw: Array, stamps: Array, rng: np.random.Generator) -> Array:
    """Camera poses (N, 4, 4) at level places (N, 2) [m] and headings (N,) [rad], shaken at times `stamps` [s]."""
    positions = np.column_stack([xy, EYE + 0.01 * sway(stamps, rng, 0.8, 2)])
    return camera_poses(positions, yaw, 0.003 * sway(stamps, rng, 0.8, 2), 0.002 * sway(stamps, rng, 0.8, 2))


def _way() -> Array:
    """Places (N, 2) [m] along the drive in equal steps: in the right lane, with rounded corners."""
    corners = np.array(CORNERS, float)
    ahead = np.diff(corners, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = _LANE * np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)  # from the middle of each street
    straight = (ahead[1:] * ahead[:-1]).sum(axis=1) > 0.9
    middle = np.where(straight[:, None], right[1:], right[1:] + right[:-1])
    corners += np.concatenate([right[:1], middle, right[-1:]])
    length = _driven(corners)
    fine = np.arange(0.0, length[-1], _STEP)
    smooth = gaussian_filter1d(interpolated(fine, length, corners), _ROUND / _STEP, axis=0, mode="nearest")
    run = _driven(smooth)
    return interpolated(np.arange(2 * _ROUND, run[-1] - 2 * _ROUND, _STEP), run, smooth)
