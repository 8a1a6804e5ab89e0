"""Initialization of bodies: from tracks that lie together and share a twist that a still scene does not explain."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, points_by_pose
from slam.models import ObjectModels
from slam.objects import membership
from slam.objects.bodies import Body, new_body
from slam.objects.candidates import region_radius
from slam.objects.config import ObjectsConfig
from slam.objects.points import compact
from slam.objects.tracks import Tracks, constant_velocity

_ROUNDS = 3  # of leaving out what rather stands still, and fitting again
_FAR = 3.0  # so many times the median distance from the median point is no part of a new body


class MovingGroup(NamedTuple):
    """Tracks that move alike."""

    members: NDArray[np.intp]  # their rows (K,)
    centre: Array  # the point (3,) that the twist is about [m], world coordinates
    twist: Array  # [ω, v] (6,) at the centre [rad/s, m/s]
    covariance: Array  # of the twist (6, 6)


class BodyInitializer(NamedTuple):
    """Initializes bodies in one frame."""

    rig: StereoRig  # the cameras
    config: ObjectsConfig  # settings
    sigma: float  # pixel noise [px]
    models: ObjectModels  # how bodies are assumed to move
    times: Array  # of the window's slots less the present (W,) [s]
    slot: int  # the present frame's place in the window
    stamp: float  # of the present frame [s]
    eye: Array  # the left camera's place (3,) in the world [m]

    def moving_group(self, tracks: Tracks, members: NDArray[np.intp]) -> MovingGroup | None:
        """Those of the tracks `members` (K,) that lie together and move alike; None if they are too few or too far."""
        members = members[compact(tracks.position[members], _FAR)]
        if len(members) < self.config.min_support:
            return None
        for _ in range(_ROUNDS):
            group = self._group(tracks, members)
            if not self.resolves(group.centre):
                return None  # what stands still beside it could not be told from it
            moves = membership.membership_test(self.body(0, tracks, group), tracks, members).gain > 0
            if moves.all():
                return group
            members = members[moves]  # what lies among them and rather stands still slows them down
            if len(members) < self.config.min_support:
                return None
        return self._group(tracks, members)

    def _group(self, tracks: Tracks, members: NDArray[np.intp]) -> MovingGroup:
        """Tracks with the twist that fits them best."""
        motion = constant_velocity(tracks, members, self.times, self.config.max_speed)
        centre = motion.position.mean(axis=0)
        information = np.linalg.inv(motion.velocity_covariance)
        # Velocities of a rigid body's points are V = v + ω × r: linear in [ω, v]. Without a prior the depth noise of
        # few, close points would turn it wildly.
        J = -points_by_pose(motion.position - centre)
        JA = np.swapaxes(J, 1, 2) @ information
        prior = np.repeat([self.models.initial_angular_velocity_sigma**-2, 1e-9], 3)
        covariance = np.linalg.inv((JA @ J).sum(axis=0) + np.diag(prior))
        twist = covariance @ (JA @ motion.velocity[:, :, None]).sum(axis=0)[:, 0]
        # The twist is the mean over the window: the present one differs by what a third of its time allows.
        linear, angular = self.models.velocity_variance(-float(self.times.min()) / 3.0)
        return MovingGroup(members, centre, twist, covariance + np.diag([angular] * 3 + [linear] * 3))

    def body(self, id: int, tracks: Tracks, group: MovingGroup) -> Body:
        """A new body with a group's twist, fitted to its tracks."""
        body = new_body(id, group.centre, group.twist, self.times, self.stamp, self.config.size, group.covariance)
        return membership.fitted(body, tracks, group.members, self.slot)

    def resolves(self, place: Array) -> bool:
        """Whether the noise of a measured depth at a place (3,) is less than the size of a body there."""
        depth = float(np.linalg.norm(place - self.eye))
        return bool(self.depth_noise(depth) < region_radius(depth, self.config.size))

    def depth_noise(self, depth: Any) -> Any:
        """Standard deviation [m] of one measured depth [m]."""
        return depth**2 * self.sigma / (self.rig.left.fu * self.rig.baseline)
