"""Prior and posterior of a calibration's errors: Gaussians, whose prior has scales that are not known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, ClassVar

import numpy as np

from slam.calibration.evidence import RESIDUAL_SCALES, Evidence, field_variance
from slam.calibration.model import RigModel
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
    field = model.field(far) / model.focal
    for change, sigma in ((field[:, 2], MEAN_DISPARITY), (field[:, 3], MEAN_VERTICAL)):
        mean = change.mean(axis=0)
        information += np.outer(mean, mean) / sigma**2
        information += change.T @ change * (10 / (len(far) * FIELD**2))  # 10: independent values of such a field
    return np.asarray(information)


def along(model: RigModel, *names: str) -> Array:
    """A change of some parameters alone, by one each (n,)."""
    return np.array([float(name in names) for name in model.names])


def systematic_variance(model: RigModel, error: float) -> Array:
    """Variances (n,) of the parameters due to a matching bias that all frames of a recording share.

    Each parameter's standard deviation is what moves rows and disparities by `error` [px] (root mean square over the
    image, of far points and of points with a disparity of a twentieth of the focal length). Repeated structure, slanted
    surfaces and moving shadows are matched with such a bias; it does not average out.
    """
    far = model.far()
    near = far + np.array([0.0, 0.0, 0.05 * model.focal])
    points = np.concatenate([far, near])
    effect = np.square(model.field(points)[:, 2:]).sum(axis=1)
    return np.asarray(error**2 / effect.mean(axis=0))


@dataclass(frozen=True, eq=False)
class RigPosterior:
    """Gaussian belief about the parameters of `slam.calibration.model`."""

    mean: Array  # (n,)
    covariance: Array  # (n, n)

    names: ClassVar = RigModel.names  # of the parameters (n,)
    units: ClassVar = RigModel.units

    def __repr__(self) -> str:
        most = int(np.argmax(np.abs(self.mean) / self.sigma))
        text = f"{self.names[most]} is {self.mean[most] / self.sigma[most]:+.1f} sigma"
        return f"RigPosterior({len(self.names)} parameters; {text})"

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def to_json(self) -> dict[str, Any]:
        """As plain types."""
        values = zip(self.names, self.units, self.mean.tolist(), self.sigma.tolist())
        parameters = [dict(zip(("name", "unit", "mean", "sigma"), row)) for row in values]
        return {"parameters": parameters, "covariance": self.covariance.tolist()}


def solve(prior: Prior, evidence: Evidence, known: Evidence | None = None) -> RigPosterior:
    """Posterior, averaged over the unknown scales of the calibration's errors.

    The scales are weighted by their marginal likelihood, so that a calibration without evidence against it is left
    unchanged instead of following the noise. They follow from `evidence`; the posterior is of `known`, where that is
    another.
    """
    e, information = evidence.e - evidence.S @ prior.mean, prior.information + evidence.S
    fits = np.linalg.solve(information, np.broadcast_to(e[:, None], (len(information), len(e), 1)))[..., 0] @ e
    logs = 0.5 * (prior.log_determinants - np.linalg.slogdet(information)[1] + fits)
    weights = np.exp(logs - logs.max())
    known = evidence if known is None else known
    likely = weights > 1e-12  # numerics: of a scale, beside the likeliest
    weights = weights[likely] / weights[likely].sum()
    covariances = np.linalg.inv(prior.information[likely] + known.S)
    steps = covariances @ (known.e - known.S @ prior.mean)
    step = weights @ steps
    off = steps - step
    covariance = np.tensordot(weights, covariances + off[:, :, None] * off[:, None], axes=1)
    return RigPosterior(prior.mean + step, 0.5 * (covariance + covariance.T))


def residual_likelihoods(prior: Prior, rows: Evidence) -> Array:
    """Log-likelihoods (K,) of `RESIDUAL_SCALES` by the vertical disparities that the parameters do not explain.

    Fields along the rows, which cannot be observed as directly, are taken to be as large as those across. Errors of
    neighbouring frames are taken to be independent; where they are not, the fields and so the uncertainty are
    overestimated.

    `rows` is the evidence of the parameters and of the fields across the rows (n + k).
    """
    n = len(prior.mean)
    known, shared = prior.information[-1] + rows.S[:n, :n], rows.S[:n, n:]
    gain = np.linalg.solve(known, shared)
    A = rows.S[n:, n:] - shared.T @ gain
    g = rows.e[n:] - gain.T @ rows.e[:n] - (rows.S[n:, :n] - gain.T @ rows.S[:n, :n]) @ prior.mean
    values, vectors = np.linalg.eigh(A)
    variances = 2 * field_variance() * np.square(RESIDUAL_SCALES)[:, None]  # of both cameras
    added = 1 + variances * np.maximum(values, 0)
    return np.asarray(0.5 * np.sum(np.square(vectors.T @ g) * variances / added - np.log(added), axis=1))
