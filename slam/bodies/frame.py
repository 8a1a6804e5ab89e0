"""What the detector's parts know of the frame in work."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slam.bodies.config import ObjectsConfig
from slam.data import IdArray, IndexArray, RecentPoses, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import ObjectModels

_SHARE = 0.05  # of the depth, as the radius of what may be a body where bodies have no least size


@dataclass(frozen=True, eq=False)
class Setup:
    """What stays the same in a run."""

    rig: StereoRig
    config: ObjectsConfig
    models: ObjectModels  # how bodies are assumed to move
    sigma: float  # pixel noise [px]

    @cached_property
    def slide(self) -> float:
        """Variance of a feature's direction with the angle from which it is seen [rad² / rad]."""
        return (self.models.drift / self.rig.left.fu) ** 2

    def depth_noise(self, depth: Any) -> Any:
        """Standard deviation [m] of one measured depth [m]."""
        return depth**2 * self.sigma / (self.rig.left.fu * self.rig.baseline)

    def radius(self, depth: Any) -> Any:
        """Radius [m] of the region that a body may fill: half its least size, or a share of its depth."""
        return np.maximum(0.5 * self.config.size, _SHARE * depth)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame, with the window of frames before it."""

    setup: Setup
    number: int
    features: StereoFeatures
    local: Array  # the features' points in camera coordinates (N, 3), NaN where there is no depth
    stamps: Array  # of the window's slots (W,) [s]; NaN where there is none yet
    poses: Array  # T_world_left (W, 4, 4) in them
    cameras: RecentPoses  # the camera's last poses, with their joint covariance

    @cached_property
    def slot(self) -> int:
        """The frame's place in the window."""
        return self.number % len(self.stamps)

    @cached_property
    def ages(self) -> IndexArray:
        """Of the window's slots (W,), in frames."""
        return np.asarray((self.slot - np.arange(len(self.stamps))) % len(self.stamps))

    @cached_property
    def times(self) -> Array:
        """Of the window's slots less the present (W,) [s], zero where there is none yet."""
        return np.where(np.isnan(self.stamps), 0.0, self.stamps - self.features.stamp)

    @cached_property
    def dt(self) -> float:
        """Time since the previous frame [s]."""
        return float(-self.times[self.slot - 1])

    @cached_property
    def T_world_left(self) -> Array:
        """The camera's pose (4, 4)."""
        return np.asarray(self.poses[self.slot])

    @cached_property
    def eye(self) -> Array:
        """The camera's place (3,) in the world [m]."""
        return np.asarray(self.poses[self.slot, :3, 3])

    def resolves(self, place: Array) -> bool:
        """Whether the noise of a measured depth at a place (3,) is less than the size of a body there.

        Elsewhere what stands still beside a body could not be told from it.
        """
        depth = float(np.linalg.norm(place - self.eye))
        return bool(self.setup.depth_noise(depth) < self.setup.radius(depth))


NO_IDS: IdArray = np.zeros(0, np.int64)  #: none
