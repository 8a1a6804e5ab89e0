"""Stereo images of a world, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from slam.data import StereoFrame
from slam.geometry.se3 import Array, exp, inverse, log
from slam.worlds.faults import Faults
from slam.worlds.imaging import sense, shading
from slam.worlds.lens import Lens
from slam.worlds.raster import draw
from slam.worlds.textures.ripmap import Ripmap
from slam.worlds.world import World

_PAINTED = 1500  # textures that are kept
_EXPOSURES = 6  # pictures averaged where the shutter is open for a while


class Recorder:
    """Renders the frames of a world; every frame's noise has a seed of its own.

    Args:
        world: what to render.
        values: values of all options.
        faults: which frames suffer from what.
    """

    def __init__(self, world: World, values: Mapping[str, Any], faults: Faults) -> None:
        self._world = world
        self._values = values
        self._faults = faults
        self._seed: int = values["seed"]

    def record(self, frame: int, index: int, stamp: float) -> StereoFrame:
        """The images of one frame of the world, as frame `index` of the recording."""
        rig = self._world.rig
        left = self._shoot(frame, self._lenses[0], np.eye(4), 2)
        right = None
        if not self._faults.dropright[frame]:
            right = self._shoot(frame, self._lenses[1], inverse(rig.T_right_left), 3)
        return StereoFrame(index, stamp, left, right)

    def _shoot(self, frame: int, lens: Lens, T_left_camera: Array, stream: int) -> np.ndarray:
        """One camera's image."""
        if self._values["shutter"] > 0:
            shares = self._values["shutter"] * ((np.arange(_EXPOSURES) + 0.5) / _EXPOSURES - 0.5)
            images = [self._picture(frame, lens, T_left_camera, x).astype(np.float32) for x in shares]
            image = np.rint(np.mean(images, axis=0)).astype(np.uint8)
        else:
            image = self._picture(frame, lens, T_left_camera, 0.0)
        rng = np.random.default_rng([self._seed, frame, stream])
        return sense(image, self._values, self._shading, self._faults, frame, rng)

    def _picture(self, frame: int, lens: Lens, T_left_camera: Array, ahead: float) -> np.ndarray:
        """One camera's light, `ahead` of the frame's time by a share of a frame."""
        T = _between(self._world.T_world_left, frame, ahead)
        bodies = np.array([np.eye(4), *(_between(Ts, frame, ahead) for Ts in self._world.T_world_object)])
        channels = 3 if self._values["colour"] else 1
        rows = self._world.drawn_there(frame)
        samples = draw(
            self._world.drawn_arrays.select(rows), lambda row: self._ripmap(int(rows[row])), bodies, T @ T_left_camera,
            lens.view, self._world.sky, channels,
        )  # fmt: skip
        return lens.expose(samples)

    @cached_property
    def _lenses(self) -> tuple[Lens, Lens]:
        """Left and right camera."""
        rig = self._world.rig
        return Lens.of(rig.left, self._values["supersample"]), Lens.of(rig.right, self._values["supersample"])

    @cached_property
    def _shading(self) -> np.ndarray:
        """Share of the light that reaches each pixel."""
        return shading(self._values["vignetting"], self._world.rig.width, self._world.rig.height)

    def _ripmap(self, rectangle: int) -> Ripmap:
        """The texture of a rectangle drawn, painted when first seen; the last ones are kept with the world."""
        texture = self._world.drawn[rectangle].texture
        key = (texture, self._values["colour"])
        painted = self._world.painted
        found: Ripmap | None = painted.pop(key, None)
        if found is None:
            picture = texture.paint(self._world.texels)
            found = Ripmap(picture if self._values["colour"] else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
            if len(painted) >= _PAINTED:
                del painted[next(iter(painted))]
        painted[key] = found  # at the end: what has not been seen for the longest time comes first
        return found


def _between(poses: Array, frame: int, ahead: float) -> Array:
    """The pose `ahead` of a frame by a share of a frame, of poses (N, 4, 4), at constant velocity."""
    other = frame + (1 if ahead > 0 else -1)
    if ahead == 0 or not 0 <= other < len(poses):
        return poses[frame]
    return poses[frame] @ exp(abs(ahead) * log(inverse(poses[frame]) @ poses[other]))
