"""From an undistorted view of the world, in samples, to a camera's own pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from slam.geometry.camera import PinholeCamera
from slam.geometry.se3 import Array


class View(NamedTuple):
    """An undistorted view to draw: camera matrix (3, 3) in samples, and size in samples."""

    K: Array
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Lens:
    """How one camera's pixels come from an undistorted view.

    Attributes:
        view: the undistorted view.
        places: where each sample of the camera's image lies in the view (H, W, 2); None where it is its own place.
        supersample: samples per pixel along each axis.
    """

    view: View
    places: np.ndarray | None
    supersample: int

    @classmethod
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
        low, high = rays.min(axis=0), rays.max(axis=0)
        margin = 2.0
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
