"""How far off a stereo calibration may be before anything is seen: standard deviations, and why."""

from __future__ import annotations

import numpy as np

from slam.calibration.model import LENS, POSE, RigModel
from slam.geometry.se3 import Array

#: Standard deviations of the corrections, dimensionless [rad, focal lengths, 1]. A chess board fixes combinations of
#: parameters far better than each one: a shift of the principal point looks like a turn of the camera, and moves the
#: centre of the distortion, which is a tangential one. Repeated calibrations therefore scatter by about a hundredth of
#: the focal length in the principal point, by as much times the angle in the turn that makes up for it, by as much
#: times k1 (0.3 to 0.4 for wide lenses) in the tangential terms; by some thousandths in focal length and aspect; and by
#: a hundredth in k1 and k2, whose errors nearly cancel where the board was held, and do not outside.
SIGMAS = {
    "cx": 0.014, "cy": 0.014, "f": 0.003, "aspect": 0.0015, "k1": 0.01, "k2": 0.01, "p1": 0.005, "p2": 0.005,
    "pitch": 0.014, "yaw": 0.02, "roll": 0.004, "down": 0.007, "forward": 0.02,
}  # fmt: skip

#: Root mean square over the image of what no lens model holds [focal lengths]: a fifth of a pixel at 1000 px.
RESIDUAL = 2e-4

#: What a chess board does fix: the mean over the image of the disparity of far points, and of the vertical disparity
#: [focal lengths]. Cameras that are knocked or warmed up turn by less than a milliradian.
MEAN_DISPARITY = 7e-4
MEAN_VERTICAL = 1.4e-3


def prior_information(model: RigModel, scale: float = 1.0) -> Array:
    """Information (n, n) of the prior; its mean is zero, the calibration as delivered.

    Args:
        model: the parameters.
        scale: factor on all standard deviations.
    """
    residual = (len(model.names) - 2 * len(LENS) - len(POSE)) // 4
    each = RESIDUAL / np.sqrt(residual)
    sigmas = np.array([SIGMAS.get(_bare(name), each) for name in model.names])
    information = np.diag(sigmas**-2)
    far = np.column_stack([model.focal * model.grid(), np.zeros(len(model.grid()))])
    for means, sigma in ((model.field(far)[:, 2], MEAN_DISPARITY), (model.vertical(far), MEAN_VERTICAL)):
        mean = means.mean(axis=0) / model.focal
        information += np.outer(mean, mean) / sigma**2
    return np.asarray(information / scale**2)


def _bare(name: str) -> str:
    """A parameter's name without its camera."""
    return name.removeprefix("left_").removeprefix("right_")
