"""The prior of a calibration's errors: standard deviations, with reasons."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from slam.calibration.model import RESIDUAL, RigModel
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


#: Possible scales of a rig's residual fields, see `field_variance`, equally probable a priori: from none to a pixel at
#: 1000 px. Rows tell which it is, so the range matters only where it is too narrow.
RESIDUAL_SCALES = np.geomspace(0.05, 5.0, 10)

#: Errors that a chess board does bound: the mean over the image of the disparity of far points, and of the vertical
#: disparity [focal lengths].
MEAN_DISPARITY = 7e-4
MEAN_VERTICAL = 1.4e-3  # the same of the vertical disparity [focal lengths]

#: Offset of all disparities [focal lengths]: even after the best calibration, shocks and warming turn the cameras by
#: less than a milliradian.
OFFSET = 7e-4

#: Root mean square over the image of the errors of far points' disparities and rows [focal lengths]: about a pixel at a
#: focal length of 700 px, as reprojection errors would show larger ones. Such fields are smooth, so they have some ten
#: independent values.
FIELD = 1.4e-3

#: Error of the focal length common to both cameras, as the board's distance or curvature may compensate it [share].
FOCAL = 0.005

#: The parameters that such an error changes.
FOCALS = "left_f", "right_f"

_OFFSETS = (0.03, 0.3, 1.0)  # scales of an offset of the disparity alone, equally probable a priori


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of the parameters: a mixture of Gaussians with one mean and several covariances."""

    mean: Array  # (n,)
    covariances: Array  # equally probable ones (K, n, n)

    @cached_property
    def information(self) -> Array:
        """Inverses of the covariances (K, n, n)."""
        return np.linalg.inv(self.covariances)

    @cached_property
    def log_determinants(self) -> Array:
        """Of the information (K,)."""
        return np.asarray(np.linalg.slogdet(self.information)[1])


def factory_prior(model: RigModel) -> Prior:
    """Prior of a calibration as delivered, by how calibrations are usually made."""
    spread = np.linalg.inv(prior_information(model))
    drift, zoom = (
        np.outer(sigma, sigma) for sigma in (OFFSET * along(model, "right_cx"), FOCAL * along(model, *FOCALS))
    )
    # (0.02, 0.1, 0.3, 1.0): Scales of the prior, equally probable a priori: of all errors of a calibration, from none
    # to as large as allowed.
    # (0.1, 1.0): the same of a common error of the focal lengths
    scales = np.array(list(product((0.02, 0.1, 0.3, 1.0), _OFFSETS, (0.1, 1.0))))
    return Prior(np.zeros(len(model.names)), np.tensordot(scales**2, np.stack([spread, drift, zoom]), axes=1))


def resumed_prior(model: RigModel, mean: Array, covariance: Array) -> Prior:
    """Prior of a rig calibrated by earlier recordings; its cameras may have rotated since.

    `mean` (n,) of the parameters and its `covariance` (n, n) are by those recordings.
    """
    sigma, turned = OFFSET * along(model, "right_cx"), np.array(_OFFSETS)
    return Prior(mean, covariance + turned[:, None, None] ** 2 * np.outer(sigma, sigma))


def prior_information(model: RigModel) -> Array:
    """Information (n, n) of the prior; its mean is zero, the calibration as delivered."""
    sigmas = np.array([SIGMAS[name.removeprefix("left_").removeprefix("right_")] for name in model.names])
    information = np.diag(sigmas**-2)
    far = model.far()
    for changes, sigma in ((model.field(far)[:, 2], MEAN_DISPARITY), (model.vertical(far), MEAN_VERTICAL)):
        change = changes / model.focal
        mean = change.mean(axis=0)
        information += np.outer(mean, mean) / sigma**2
        information += change.T @ change * (10 / (len(far) * FIELD**2))  # 10: independent values of such a field
    return np.asarray(information)


def along(model: RigModel, *names: str) -> Array:
    """A change of some parameters alone, by one each (n,)."""
    return np.array([float(name in names) for name in model.names])


def field_variance(scale: float = 1.0) -> float:
    """Variance of each coefficient of the residual fields [focal lengths²], at their scale."""
    # 2e-4: root mean square over the image at a scale of 1 [focal lengths]: a fifth of a pixel at 1000 px
    return (scale * 2e-4) ** 2 / len(RESIDUAL)


def systematic_variance(model: RigModel, error: float) -> Array:
    """Variances (n,) of the parameters due to a matching bias that all frames of a recording share.

    Each parameter's standard deviation is what moves rows and disparities by `error` [px] (root mean square over the
    image, of far points and of points with a disparity of a twentieth of the focal length). Repeated structure, slanted
    surfaces and moving shadows are matched with such a bias; it does not average out.
    """
    far = model.far()
    near = far + np.array([0.0, 0.0, 0.05 * model.focal])
    points = np.concatenate([far, near])
    effect = np.square(model.field(points)[:, 2]) + np.square(model.vertical(points))
    return np.asarray(error**2 / effect.mean(axis=0))
