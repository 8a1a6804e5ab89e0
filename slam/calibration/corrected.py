"""The corrected rig: cameras and extrinsics of the usual form that reproduce the corrected pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from slam.calibration.kernels import field
from slam.calibration.model import LENS, RigModel
from slam.errors import CalibrationError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, so3_exp


class CorrectedRig(NamedTuple):
    """A rig corrected by its estimated error."""

    rig: StereoRig  # in the form of a calibration file
    left_off: float  # deviation of its pixels from the corrected ones, root mean square over the image [px]
    right_off: float


def corrected_rig(model: RigModel, parameters: Array) -> CorrectedRig:
    """The rig as calibrated, corrected by parameters (n,).

    Focal lengths, principal point and distortion of each camera are fitted to the pixels of the corrected rays. A
    camera without distortion gets k1, k2, p1 and p2. A fisheye model has no tangential distortion. The left camera's
    axes are kept: the rotation of the ideal rig in `RigModel.field` is left out.
    """
    rig, rectified = model.rig, model.rig.rectified
    side = len(LENS)
    left_theta, right_theta, (pitch, yaw, roll, down, forward) = np.split(parameters, [side, 2 * side])
    left, left_off = _camera(rig.left, rectified.rig.left, rectified.rectify_left, rectified.R_left, left_theta)
    right, right_off = _camera(rig.right, rectified.rig.right, rectified.rectify_right, rectified.R_right, right_theta)
    R = rectified.R_right.T @ so3_exp(-np.array([pitch, yaw, roll])) @ rectified.R_left
    centre = np.array([1.0, down, forward])
    b = -rig.baseline * (rectified.R_left.T @ centre) / np.linalg.norm(centre)
    return CorrectedRig(StereoRig(left, right, R, b, rig.turns), left_off, right_off)


def _camera(
    camera: PinholeCamera, ideal: PinholeCamera, rectify: Callable[[Array], Array], R: Array, theta: Array
) -> tuple[PinholeCamera, float]:
    """A camera fitted to the corrected rays, and the root mean square deviation [px].

    `rectify` maps its pixels (N, 2) to those of the `ideal` camera of the rectified rig, `R` (3, 3) its axes to that
    camera's; `theta` (8,) are the corrections of `LENS`.
    """
    # (25, 15): grid of pixels to which the cameras are fitted, columns and rows
    u, v = np.meshgrid(*(np.linspace(0, n - 1, k) for n, k in zip((camera.width, camera.height), (25, 15))))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    seen = ideal.normalise(rectify(pixels))
    good = np.isfinite(seen).all(axis=1)
    pixels, seen = pixels[good], seen[good]
    if 2 * len(pixels) < 4 + max(len(camera.distortion), 4):
        raise CalibrationError("the camera's pixels have no rays: its distortion cannot be undone")
    by_lens = field(np.column_stack([seen, np.zeros(len(seen))]), 1.0)[:, :2, : len(LENS)]
    true = seen + by_lens @ theta
    rays = np.column_stack([true, np.ones(len(true))]) @ R
    distortion = camera.distortion or (0.0,) * 4
    start = np.array([camera.fu, camera.fv, camera.u0, camera.v0, *distortion])
    scale = np.array([camera.fu, camera.fu, camera.fu, camera.fu, *np.ones(len(distortion))])

    def of(values: Array) -> PinholeCamera:
        fu, fv, u0, v0, *rest = (float(x) for x in values)
        model = "radtan" if camera.model == "none" else camera.model
        return replace(camera, fu=fu, fv=fv, u0=u0, v0=v0, model=model, distortion=tuple(rest))

    def off(values: Array) -> Array:
        return np.nan_to_num((of(values).project(rays) - pixels).ravel(), nan=1e3)

    found = least_squares(off, start, x_scale=scale, method="lm")
    return of(found.x), float(np.sqrt(2 * np.mean(found.fun**2)))
