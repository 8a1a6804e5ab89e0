"""What the rig sees of a rigid body, as a function of the body's pose relative to the camera and of its points.

Seen from the body it is the camera that moves among fixed points; so an update of a body has the form of an update of
the camera, and is solved by the same `backends.ekf.solve`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backends.ekf.measurement import Linearisation
from backends.ekf.objects_kernels import point_geometry
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, hat, pose, so3_exp, so3_left_jacobian, so3_log


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Points of a body, each in inverse-depth coordinates of the camera that saw it first.

    In them the pixels of that camera are linear, and those of any later one nearly so: what stereo says of a far point
    is Gaussian in these coordinates, and not in Cartesian ones.

    Attributes:
        T_body_anchor: pose (M, 4, 4) in the body of the camera that saw each point first; fixed.
        coordinates: ``(x/z, y/z, 1/z)`` (M, 3) in that camera's frame.
    """

    T_body_anchor: Array
    coordinates: Array

    @classmethod
    def at(cls, T_body_left: Array, h: Array) -> BodyPoints:
        """Points first seen at h (M, 3) in coordinates of the camera that stands at `T_body_left` (4, 4)."""
        coordinates = np.concatenate([h[:, :2], np.ones((len(h), 1))], axis=1) / h[:, 2:]
        return cls(np.broadcast_to(T_body_left, (len(h), 4, 4)).copy(), coordinates)

    def __len__(self) -> int:
        return len(self.coordinates)

    def select(self, rows: NDArray[Any]) -> BodyPoints:
        """Some of the points."""
        return BodyPoints(self.T_body_anchor[rows], self.coordinates[rows])

    def with_more(self, more: BodyPoints) -> BodyPoints:
        """These and others."""
        return BodyPoints(
            np.concatenate([self.T_body_anchor, more.T_body_anchor]),
            np.concatenate([self.coordinates, more.coordinates]),
        )

    def plus(self, change: Array) -> BodyPoints:
        """The points with coordinates changed by (M, 3)."""
        return BodyPoints(self.T_body_anchor, self.coordinates + change)

    def cartesian(self) -> Array:
        """Positions (M, 3) in body coordinates [m]; NaN for a point that came to lie behind its first camera."""
        return self._geometry[0]

    def derivatives(self) -> Array:
        """Derivatives (M, 3, 3) of the positions by the coordinates."""
        return self._geometry[1]

    def by_position(self) -> Array:
        """Derivatives (M, 3, 3) of the coordinates by the positions."""
        return self._geometry[2]

    def by_frame(self) -> Array:
        """Change (3M, 6) of the coordinates with a change [θ, τ] of the body's frame that leaves points in place."""
        return self._geometry[3]

    @cached_property
    def _geometry(self) -> tuple[Array, Array, Array, Array]:
        """All of this; the arrays never change, so that it is computed once."""
        positions, derivatives, by_position, by_frame = point_geometry(self.T_body_anchor, self.coordinates)
        return positions, derivatives, by_position, by_frame.reshape(-1, 6)


class BodyMeasurement:
    """(uL, vL, uR) of a body's points, as a function of ``x = [r, φ, δY of each point]`` (6 + 3M,).

    r and φ displace the camera in the body: ``h = Rᵀ (exp(−φ) (Y − r) − t)``, where ``(R, t)`` is the predicted
    camera pose in the body. A change ``[θ, τ]`` of the body's pose (see `moved`) is ``φ = −θ, r = −τ``. The change δY
    of a point is one of its inverse-depth coordinates ζ, named by what it makes of the position to first order:
    ``Y = Y(ζ₀ + D⁻¹ δY)`` with D = ∂Y/∂ζ at ζ₀.

    Derivatives are taken at δY = 0 always: in ζ there is next to no difference.

    Args:
        rig: the cameras.
        T_body_left: predicted pose (4, 4) of the left camera in the body.
        points: the points (M) as they are believed to be.
    """

    def __init__(self, rig: StereoRig, T_body_left: Array, points: BodyPoints) -> None:
        self._rig = rig
        self._R = T_body_left[:3, :3].T
        self._t = self._R @ T_body_left[:3, 3]
        self._points = points
        self._Y = points.cartesian()
        self._by_Y = points.by_position()

    def predict(self, x: Array) -> Array:
        """Predicted components (M, 3) [px]; NaN behind a camera."""
        return self._rig.project_stereo(self._local(x, self._changed(x).cartesian())[0], jacobian=False)[0]

    def linearise(self, x: Array) -> Linearisation:
        """The same with derivatives by [Y − r, φ]."""
        points = self._changed(x)
        h, q, R = self._local(x, points.cartesian())
        z, J = self._rig.project_stereo(h)
        by_point = J @ R
        by_turn = by_point @ hat(q) @ so3_left_jacobian(x[3:6])
        return Linearisation(
            z, np.concatenate([by_point, by_turn], axis=2), by_point @ points.derivatives() @ self._by_Y
        )

    def _changed(self, x: Array) -> BodyPoints:
        if not x[6:].any():
            return self._points
        return self._points.plus((self._by_Y @ x[6:].reshape(-1, 3, 1))[:, :, 0])

    def _local(self, x: Array, Y: Array) -> tuple[Array, Array, Array]:
        """Points (M, 3) in camera coordinates, ``q = Y − r`` (M, 3), and the rotation (3, 3) from one to the other."""
        R = self._R @ so3_exp(-x[3:6])
        q = Y - x[:3]
        return q @ R.T - self._t, q, R


def moved(T: Array, change: Array) -> Array:
    """A pose (4, 4) changed by [θ, τ] (6,): turned by exp(θ), and shifted by τ in the axes then; to first order
    ``T exp([θ, τ])``.
    """
    R = T[:3, :3] @ so3_exp(change[:3])
    return pose(R, T[:3, 3] + R @ change[3:])


def change_between(T: Array, target: Array) -> Array:
    """The change [θ, τ] (6,) that moves one pose (4, 4) to the other."""
    return np.concatenate([so3_log(T[:3, :3].T @ target[:3, :3]), target[:3, :3].T @ (target[:3, 3] - T[:3, 3])])
