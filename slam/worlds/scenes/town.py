"""A closed town: streets around two blocks, driven again in the same direction and in the opposite one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.worlds.paths import camera_poses, sway
from slam.worlds.scenes import drive
from slam.worlds.scenes.streets import EYE
from slam.worlds.world import World

TEXT = "a drive around the blocks of a town at KITTI's scale, back to its streets after 550 m, and the other way"
OPTIONS = drive.STREETS
DEFAULTS = drive.DEFAULTS

PACE = 8.0  #: driving speed [m/s]
#: Where the streets of the drive meet [m]: once around both blocks, on around the first one, and back.
CORNERS = (
    (0, -20), (0, 110), (180, 110), (180, 0), (0, 0), (0, 110), (90, 110), (90, 0), (180, 0), (180, 110), (60, 110)
)  # fmt: skip

_LANE = 1.5  # from the middle of a street to the right [m]
_ROUND = 8.0  # standard deviation of the filter that rounds the corners [m]: their radius is 7 m
_SIDEWAYS = 2.0  # greatest acceleration in a bend [m/s²]
_STEP = 0.1  # [m]


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    return drive.town("town", _path(values["layout"]), values)


def _path(layout: int) -> Trajectory:
    """The drive, at the usual pace."""
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
    height = EYE + 0.01 * sway(stamps, rng, 0.8, 2)
    positions = np.column_stack([way + aside[:, None] * across, height])
    pitch, roll = 0.003 * sway(stamps, rng, 0.8, 2), 0.002 * sway(stamps, rng, 0.8, 2)
    return Trajectory(stamps, camera_poses(positions, yaw, pitch, roll))


def _way() -> Array:
    """Places (N, 2) [m] along the drive in equal steps: in the right lane, with rounded corners."""
    corners = _in_lane(np.array(CORNERS, float))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    fine = np.arange(0.0, length[-1], _STEP)
    polygon = np.stack([np.interp(fine, length, x) for x in corners.T], axis=1)
    smooth = gaussian_filter1d(polygon, _ROUND / _STEP, axis=0, mode="nearest")
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    even = np.arange(2 * _ROUND, run[-1] - 2 * _ROUND, _STEP)
    return np.stack([np.interp(even, run, x) for x in smooth.T], axis=1)


def _in_lane(corners: Array) -> Array:
    """Corners (N, 2) of a polygon, moved to the right of both streets that meet in each."""
    ahead = np.diff(corners, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = _LANE * np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    straight = (ahead[1:] * ahead[:-1]).sum(axis=1) > 0.9
    middle = np.where(straight[:, None], right[1:], right[1:] + right[:-1])
    return corners + np.concatenate([right[:1], middle, right[-1:]])
