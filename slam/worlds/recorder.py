"""Stereo images of a world, frame by frame: its view through a lens, with light, sensor noise, and faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from statistics import NormalDist
from typing import Any

import cv2
import numpy as np

from slam.geometry.camera import PinholeCamera
from slam.geometry.se3 import inverse
from slam.worlds.painting import paint
from slam.worlds.raster import Ripmap, View, draw, place, shown
from slam.worlds.world import World

_PAINTED = 1500  # textures that are kept
_SUPERSAMPLE = 2  # samples per pixel along each axis
_SKY = (230, 225, 220)  # where no surface is, BGR


def record(world: World, values: Mapping[str, Any], frame: int, right: bool, black: bool) -> list[np.ndarray]:
    """The left image of a frame of a world, and its `right` one; every frame's noise has a seed of its own."""
    cameras = [(world.rig.left, np.eye(4)), (world.rig.right, inverse(world.rig.T_right_left))][: 1 + right]
    bodies, images = world.T_world_body(frame), []
    sky = _SKY if values["colour"] else (round(float(np.mean(_SKY))),)
    for stream, (camera, T_left_camera) in enumerate(cameras, start=2):
        lens, pose = Lens.of(camera, _SUPERSAMPLE), world.T_world_left[frame] @ T_left_camera
        samples = draw(world.drawn[1], partial(_ripmap, world, values["colour"]), bodies, pose, lens.view, sky)
        rng = np.random.default_rng([values["seed"], frame, stream])
        images.append(sense(lens.expose(samples), values, black, rng))
    return images


def _ripmap(world: World, colour: int, rectangle: int) -> Ripmap:
    """The texture of a rectangle drawn, painted when first seen; the last ones are kept with the world."""
    texture = world.drawn[0][rectangle].texture
    found: Ripmap | None = world.painted.pop((texture, colour), None)
    if found is None:
        picture = paint(texture, world.texels)
        found = Ripmap(picture if colour else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        if len(world.painted) >= _PAINTED:
            del world.painted[next(iter(world.painted))]
    world.painted[texture, colour] = found  # at the end: what has not been seen for the longest time comes first
    return found


@dataclass(frozen=True, eq=False)
class Lens:
    """How one camera's pixels come from an undistorted view."""

    view: View  # the undistorted view
    places: np.ndarray | None  # of the image's samples in the view (H, W, 2) float32; None where they are its own
    supersample: int  # samples per pixel along each axis

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, camera: PinholeCamera, supersample: int) -> Lens:
        """The lens of a camera. A sample's centre is at ((i + ½) / supersample − ½) pixels."""
        s = supersample
        width, height = camera.width * s, camera.height * s
        K = camera.K
        K[:2] *= s
        K[:2, 2] += (s - 1) / 2
        if not camera.has_distortion:
            return cls(View(K, width, height), None, s)
        y, x = np.mgrid[:height, :width]
        uv = np.stack([x.ravel(), y.ravel()], axis=1) / s - (s - 1) / (2 * s)
        rays = camera.normalise(uv)
        rays = np.where(np.isfinite(rays), rays, 0.0)
        low, high, margin = rays.min(axis=0), rays.max(axis=0), 2.0
        K[:2, 2] = margin - low * (K[0, 0], K[1, 1])
        size = np.ceil((high - low) * (K[0, 0], K[1, 1]) + 2 * margin).astype(int) + 1
        places = (rays * (K[0, 0], K[1, 1]) + K[:2, 2]).astype(np.float32).reshape(height, width, 2)
        return cls(View(K, *size), places, s)

    def expose(self, samples: np.ndarray) -> np.ndarray:
        """The camera's image from samples of the view: distorted, and averaged over each pixel."""
        if self.places is not None:
            samples = cv2.remap(samples, self.places, None, cv2.INTER_LINEAR)
        size = samples.shape[1] // self.supersample, samples.shape[0] // self.supersample
        return cv2.resize(samples, size, interpolation=cv2.INTER_AREA)


@lru_cache(maxsize=1)
def truth_images(world: World, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) float32 [m], 0 for none, and objects (H, W) int32, at the centres of the left image's pixels."""
    lens, bodies = Lens.of(world.rig.left, 1), world.T_world_body(frame)
    placed = place(world.arrays, bodies, world.T_world_left[frame], lens.view)
    labels = shown(placed, lens.view).astype(int)
    x, y = np.meshgrid(np.arange(world.rig.width), np.arange(world.rig.height), indexing="xy")
    if lens.places is not None:
        x, y = np.moveaxis(lens.places.astype(float), 2, 0)
        labels = labels[np.rint(y).astype(int), np.rint(x).astype(int)]
    planes = np.concatenate([[[0.0, 0.0, np.inf]], placed.Q[:, 2]])[labels]  # row 0: nothing, whose depth is 0
    depth = 1 / (planes[..., 0] * x + planes[..., 1] * y + planes[..., 2])
    return depth.astype(np.float32), np.append(0, world.arrays.body[placed.source])[labels].astype(np.int32)


def sense(image: np.ndarray, values: Mapping[str, Any], black: bool, rng: np.random.Generator) -> np.ndarray:
    """The image that the camera gives, uint8, by the values of the options; nothing but noise in a `black` frame."""
    if values["lens"] > 0.05:
        image = cv2.GaussianBlur(image, (0, 0), values["lens"])
    light = _shading(values["vignetting"], image.shape[1], image.shape[0]) * np.float32(not black)
    out = cv2.multiply(image, light if image.ndim == 2 else cv2.merge([light] * 3), dtype=cv2.CV_32F)
    if values["noise"] > 0:
        # Each number is the sum of two drawn from 256 quantiles of the normal law: a tenth of the time of exact ones.
        drawn = cv2.LUT(rng.integers(0, 256, 2 * image.size, np.uint8).reshape(-1, 1), _quantiles())
        first, second = drawn.reshape(2, *image.shape)
        cv2.scaleAdd(cv2.add(first, second), values["noise"], out, dst=out)
    return cv2.convertScaleAbs(cv2.max(out, 0.0))  # to the nearest grey level


@lru_cache(maxsize=4)
def _shading(vignetting: float, width: int, height: int) -> np.ndarray:
    """Share of the light that reaches each pixel (H, W) float32; `vignetting` is lost in the corners."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x / (width - 1) * 2 - 1, y / (height - 1) * 2 - 1
    return (1 - vignetting * (x * x + y * y) / 2).astype(np.float32)


@lru_cache(maxsize=1)
def _quantiles() -> np.ndarray:
    """Middles of 256 equally likely parts of the normal law, with variance ½ (256,) float32."""
    values = np.array([NormalDist().inv_cdf((i + 0.5) / 256) for i in range(256)])
    return (values / (values.std() * np.sqrt(2))).astype(np.float32)
