"""A camera before a cloud of points with descriptors, for tests of association and of the whole system."""

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.geometry import se3
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels
from slam.tracks.config import MapConfig

RIG = StereoRig.rectified_pair(300, 159.5, 119.5, 0.12, 320, 240)

#: For its points.
CONFIG = SystemConfig(models=EstimatorModels(pixel_sigma=0.5), map=MapConfig(target_in_view=40, max_depth_error=0.3))

#: For what is above the back ends: the fast tests try one of them.
BACKENDS = ["ekf", *(pytest.param(name, marks=pytest.mark.slow) for name in ("smoother", "window"))]

#: Distorted, with the right camera turned and shifted.
GENERAL_RIG = StereoRig(
    PinholeCamera(410.0, 405.0, 310.0, 245.0, 640, 480, "radtan", (-0.1, 0.02, 1e-3, -5e-4)),
    PinholeCamera(400.0, 402.0, 325.0, 238.0, 640, 480, "radtan", (-0.08, 0.01, -5e-4, 1e-3)),
    se3.so3_exp(np.array([0.01, -0.03, 0.005])),
    np.array([-0.2, 0.004, -0.006]),
)


def features_at(
    left: np.ndarray, right: np.ndarray, looks: np.ndarray, stamp: float = 0.0, response: np.ndarray | None = None
) -> StereoFeatures:
    """Features at pixels (N, 2) that differ in their descriptors (N, D), and in their response (N,) if it is given."""
    one = np.ones(len(left))
    strength = one if response is None else response
    return StereoFeatures(stamp, left, right, one, 0 * one, strength, one.astype(np.int8), looks)


class Cloud:
    """Points with unit descriptors; what a camera sees of them."""

    def __init__(self, count: int = 120, seed: int = 0, dimensions: int = 32, rig: StereoRig = RIG) -> None:
        self.rig = rig
        self.rng = np.random.default_rng(seed)
        self.points = np.column_stack(
            [self.rng.uniform(-2, 2, count), self.rng.uniform(-1.5, 1.5, count), self.rng.uniform(2, 6, count)]
        )
        d = self.rng.normal(size=(count, dimensions))
        self.descriptors = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
        self.laplacian = np.where(self.rng.random(count) < 0.5, -1, 1).astype(np.int8)

    def features(self, T_world_left: np.ndarray, stamp: float, noise: float = 0.0) -> tuple[StereoFeatures, np.ndarray]:
        """Features in an order of their own, and which point each is (N,)."""
        local = se3.transform(se3.inverse(T_world_left), self.points)
        left, right = self.rig.project(local)
        ids = self.rng.permutation(np.flatnonzero(self.rig.left.in_image(left)))
        uv = left[ids] + noise * self.rng.normal(size=(len(ids), 2))
        uv_right = right[ids] + noise * self.rng.normal(size=(len(ids), 2))
        if self.rig.is_rectified:
            uv_right[:, 1] = uv[:, 1]
        n = len(ids)
        return StereoFeatures(
            stamp, uv, uv_right, np.full(n, 12.0), np.zeros(n), 1.0 + self.rng.random(n), self.laplacian[ids],
            self.descriptors[ids],
        ), ids  # fmt: skip


def path(frames: int) -> list[np.ndarray]:
    """A smooth hand-held path (frames, 4, 4) from the origin."""
    t = np.arange(frames) / 30
    swing = np.stack([0.1 * np.sin(t), 0.2 * np.sin(0.7 * t), 0.05 * np.sin(1.3 * t)], axis=1)
    shift = np.stack([0.3 * np.sin(0.8 * t), 0.1 * np.sin(1.1 * t), 0.3 * t], axis=1)
    return [se3.exp(np.concatenate([a, b])) for a, b in zip(swing, shift)]
