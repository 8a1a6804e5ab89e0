"""What describes a world, and the one form of it from which observations and images are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from slam.data import IdArray
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.worlds.geometry import Landmarks, Parts, Rectangle, RectangleArrays
from slam.worlds.options import Option


@dataclass(frozen=True)
class Scene:
    """A world as it is described: built in, or one's own."""

    text: str  # what it is, in a line
    build: Callable[[Mapping[str, Any]], Parts]  # makes its parts from the values of its options
    reach: tuple[float, float]  # nearest and farthest distance of a feature [m]
    texels: float  # per metre of a surface
    kind: str = "handheld"  # of motion, or ``"driving"``
    options: tuple[Option, ...] = ()  # that it has alone
    defaults: Mapping[str, Any] = field(default_factory=dict)  # of common options, where they are others than usual
    alike: bool = False  # see `slam.worlds.geometry.place_landmarks`


@dataclass(frozen=True, eq=False)
class World:
    """Surfaces, landmarks, a camera path and objects with their motion."""

    name: str
    kind: str  # of motion, ``"handheld"`` or ``"driving"``
    rig: StereoRig
    stamps: Array  # time of each frame (N,) [s]
    T_world_left: Array  # pose of the left camera at each frame (N, 4, 4)
    rectangles: tuple[Rectangle, ...]  # every surface
    landmarks: Landmarks  # points that stand out on them
    T_world_object: Array  # poses of the objects 1..B at each frame (B, N, 4, 4)
    reach: tuple[float, float]  # nearest and farthest distance at which a landmark can be detected [m]
    texels: float  # per metre, at which the surfaces are painted
    painted: dict[Any, Any] = field(default_factory=dict, repr=False)  # textures painted so far, by the recorder

    def __len__(self) -> int:
        return len(self.stamps)

    def T_world_body(self, frame: int) -> Array:
        """Poses (B + 1, 4, 4) of all bodies in one frame; row 0, the still world, is the identity."""
        return np.concatenate([np.eye(4)[None], self.T_world_object[:, frame]])

    @cached_property
    def arrays(self) -> RectangleArrays:
        """All rectangles as arrays."""
        return RectangleArrays.of(self.rectangles)

    @cached_property
    def drawn(self) -> tuple[tuple[Rectangle, ...], RectangleArrays]:
        """The rectangles as they are drawn: some in parts, so that only what comes into view is painted."""
        pieces = tuple(piece for r in self.rectangles for piece in r.parts())
        return pieces, RectangleArrays.of(pieces)

    @cached_property
    def occluders(self) -> RectangleArrays:
        """The rectangles that may hide others."""
        return self.arrays.select(np.flatnonzero([r.occludes for r in self.rectangles]))

    def near(self, points: Array, radius: Array | float, body: IdArray, frame: int) -> IdArray:
        """Indices of balls (P, 3) that may be within reach and in view in a frame, and of all that move."""
        camera = self.rig.left
        x, y = max(camera.u0, camera.width - camera.u0), max(camera.v0, camera.height - camera.v0)
        corner = 1.1 * np.sqrt(1 + (x / camera.fu) ** 2 + (y / camera.fv) ** 2)  # distance over depth, generously
        offset = points - self.T_world_left[frame, :3, 3]
        square = np.einsum("ij,ij->i", offset, offset)
        return np.flatnonzero((square < (self.reach[1] * corner + radius) ** 2) | (body > 0))
