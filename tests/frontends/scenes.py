"""Images of smooth random texture, and pairs of them with known motion."""

from functools import cache

import cv2
import numpy as np

from slam.geometry.rig import StereoRig

RIG = StereoRig.rectified_pair(260.0, 160.0, 120.0, 0.12, 320, 240)


@cache
def texture(height, width, seed=0, finest=1.5):
    """Random texture (height, width) float32, mean 120, deviation 35, without detail finer than a few pixels.

    Made once and shared: it cannot be written to.
    """
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((height, width)).astype(np.float32)
    total = sum(cv2.GaussianBlur(noise, (0, 0), finest * k) * k for k in (1, 2, 4, 8))
    values = (total - total.mean()) / total.std() * 35 + 120
    values.flags.writeable = False
    return values


def photograph(values, noise=0.0, seed=0):
    """What an 8-bit camera makes of grey values."""
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(values + noise * rng.standard_normal(values.shape)), 0, 255).astype(np.uint8)


def warped(values, A, noise=0.0, seed=1):
    """Photograph of grey values under the affine map ``x' = A[:, :2] x + A[:, 2]`` of pixels."""
    height, width = values.shape
    moved = cv2.warpAffine(values, A, (width, height), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    return photograph(moved, noise, seed)


def zoom_about(centre, factor, degrees=0.0, shift=(0.0, 0.0)):
    """Affine map (2, 3) that turns and zooms about a pixel and then shifts."""
    A = cv2.getRotationMatrix2D(centre, -degrees, factor)
    A[:, 2] += shift
    return A


def stereo_pair(disparity, height=240, width=320, noise=1.0, seed=0):
    """Left and right photograph of a wall at one disparity [px], a multiple of a quarter."""
    big = texture(4 * height, 4 * (width + 64), seed, finest=5.0)
    shift = round(4 * disparity)
    assert shift == 4 * disparity
    size = (width, height)
    left = cv2.resize(big[:, : 4 * width], size, interpolation=cv2.INTER_AREA)
    right = cv2.resize(big[:, shift : shift + 4 * width], size, interpolation=cv2.INTER_AREA)
    return photograph(left, noise, seed + 1), photograph(right, noise, seed + 2)
