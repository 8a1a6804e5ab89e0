"""One description of a world, from which observations and images are made."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from slam.data import IdArray
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.worlds.geometry import Landmarks, Rectangle, RectangleArrays


def _to_corner(rig: StereoRig) -> float:
    """Distance to a point in a corner of the left image, over its depth; generously."""
    camera = rig.left
    x, y = max(camera.u0, camera.width - camera.u0) / camera.fu, max(camera.v0, camera.height - camera.v0) / camera.fv
    return float(1.1 * np.sqrt(1 + x * x + y * y))


@dataclass(frozen=True, eq=False)
class World:
    """Surfaces, landmarks, a camera path and objects with their motion.

    Attributes:
        name: its name.
        kind: kind of motion, ``"handheld"`` or ``"driving"``.
        rig: the stereo rig.
        stamps: time of each frame (N,) [s].
        T_world_left: pose of the left camera at each frame (N, 4, 4).
        rectangles: every surface.
        landmarks: points that stand out on them.
        T_world_object: poses of the objects 1..B at each frame (B, N, 4, 4).
        reach: nearest and farthest distance at which a landmark can be detected [m].
        texels: texels per metre at which the surfaces are painted.
        sky: colour (BGR) where no surface is.
        painted: textures painted so far, filled by the recorder.
        seen: landmarks seen in frames so far, filled by the simulator of observations.
    """

    name: str
    kind: str
    rig: StereoRig
    stamps: Array
    T_world_left: Array
    rectangles: tuple[Rectangle, ...]
    landmarks: Landmarks
    T_world_object: Array
    reach: tuple[float, float]
    texels: float
    sky: tuple[int, int, int] = (230, 225, 220)
    painted: dict[Any, Any] = field(default_factory=dict, repr=False)
    seen: dict[int, Any] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.stamps)

    @cached_property
    def object_ids(self) -> IdArray:
        """Ids of the moving objects (B,)."""
        return np.arange(1, len(self.T_world_object) + 1)

    def T_world_body(self, frame: int) -> Array:
        """Poses (B + 1, 4, 4) of all bodies in one frame; row 0, the still world, is the identity."""
        return np.concatenate([np.eye(4)[None], self.T_world_object[:, frame]])

    @cached_property
    def arrays(self) -> RectangleArrays:
        """All rectangles as arrays."""
        return RectangleArrays.of(self.rectangles)

    @cached_property
    def drawn(self) -> tuple[Rectangle, ...]:
        """The rectangles as they are drawn: some in parts, so that only what comes into view is painted."""
        return tuple(piece for r in self.rectangles for piece in r.parts())

    @cached_property
    def drawn_arrays(self) -> RectangleArrays:
        """`drawn` as arrays."""
        return RectangleArrays.of(self.drawn)

    @cached_property
    def occluders(self) -> RectangleArrays:
        """The rectangles that may hide others."""
        return self.arrays.select(np.flatnonzero([r.occludes for r in self.rectangles]))

    def landmarks_near(self, frame: int) -> IdArray:
        """Ids of the landmarks that may be within reach in a frame, and of all that move."""
        return self._within_sight(self.landmarks.positions, 0.0, self.landmarks.object, frame)

    def occluders_near(self, frame: int) -> RectangleArrays:
        """The rectangles that may hide landmarks within reach in a frame."""
        every = self.occluders
        return every.select(self._within_sight(every.middle, every.radius, every.body, frame))

    def _within_sight(self, points: Array, radius: Array | float, body: IdArray, frame: int) -> IdArray:
        """Indices of points (P, 3) that may be within reach in a frame, and of all that move."""
        offset = points - self.T_world_left[frame, :3, 3]
        square = np.einsum("ij,ij->i", offset, offset)
        return np.flatnonzero((square < (self.reach[1] * _to_corner(self.rig) + radius) ** 2) | (body > 0))
