"""From pictures of a world to what a camera gives: lens, light, sensor noise, and faults of single frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import cv2
import numpy as np

from slam.worlds.faults import Faults, in_hand


def shading(vignetting: float, width: int, height: int) -> np.ndarray:
    """Share of the light that reaches each pixel (H, W) float32; `vignetting` is lost in the corners."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x / (width - 1) * 2 - 1, y / (height - 1) * 2 - 1
    return (1 - vignetting * (x * x + y * y) / 2).astype(np.float32)


def sense(
    image: np.ndarray,
    values: Mapping[str, Any],
    light: np.ndarray,
    faults: Faults,
    frame: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """The image that the camera gives, uint8, by the values of the options; `light` is the `shading`."""
    if faults.hand[frame]:
        image = _cover(image)
    if faults.blur[frame]:
        image = cv2.GaussianBlur(image, (0, 0), image.shape[1] / 80)
    elif values["lens"] > 0.05:
        image = cv2.GaussianBlur(image, (0, 0), values["lens"])
    gain = 0.0 if faults.black[frame] else 12.0 if faults.bright[frame] else 1.0
    light = light * np.float32(gain)
    out = cv2.multiply(image, light if image.ndim == 2 else cv2.merge([light] * 3), dtype=cv2.CV_32F)
    noise = values["noise"] * (8.0 if faults.burst[frame] else 1.0)
    if noise > 0:
        cv2.scaleAdd(normal_noise(image.shape, rng), noise, out, dst=out)
    return cv2.convertScaleAbs(cv2.max(out, 0.0))  # to the nearest grey level


def normal_noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Noise of standard deviation 1 (shape) float32: the sum of two numbers drawn from 256 quantiles of the normal law.

    A tenth of the time of a generator of exact normal numbers; nothing is beyond 4.1.
    """
    size = math.prod(shape)
    drawn = rng.integers(0, 256, 2 * size, np.uint8)
    parts = cv2.LUT(drawn.reshape(2 * size, 1), _quantiles()).reshape(2, *shape)
    return cv2.add(parts[0], parts[1])


@lru_cache(maxsize=1)
def _quantiles() -> np.ndarray:
    """Middles of 256 equally likely parts of the normal law, with variance ½ (256,) float32."""
    law = NormalDist()
    values = np.array([law.inv_cdf((i + 0.5) / 256) for i in range(256)])
    return (values / (values.std() * np.sqrt(2))).astype(np.float32)


def _cover(image: np.ndarray) -> np.ndarray:
    """The image with a hand before the lens: near, dark, out of focus."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    inside = in_hand(np.stack([x.ravel(), y.ravel()], axis=1), width, height).reshape(height, width)
    weight = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), width / 40)
    skin = np.float32(55) if image.ndim == 2 else np.array([45, 55, 80], np.float32)
    weight = weight if image.ndim == 2 else weight[..., None]
    return (image * (1 - weight) + skin * weight).astype(np.uint8)
