"""Likelihood, prior and posterior of a calibration's errors: Gaussians, whose prior has scales that are not known.

The likelihood is that by rows, summed in blocks so that errors shared by neighbours count once.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np

from slam.calibration.model import RESIDUAL, RigModel
from slam.chi_square import chi_square_limit
from slam.geometry.arrays import median
from slam.geometry.se3 import Array
from slam.naming import of_shapes

#: Possible scales of a rig's residual fields, see `field_variance`, equally probable a priori: from none to a pixel at
#: 1000 px. Rows tell which it is, so the range matters only where it is too narrow.
RESIDUAL_SCALES = np.geomspace(0.05, 5.0, 10)

_MEDIAN = chi_square_limit(1, 0.5)  # derived: of χ² with one degree of freedom

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

#: Offset of all disparities [focal lengths]: even after the best calibration, shocks and warming turn the cameras by
#: less than a milliradian.
OFFSET = 7e-4

#: Error of the focal length common to both cameras, as the board's distance or curvature may compensate it [share].
FOCAL = 0.005

#: The parameters that such an error changes.
FOCALS = "left_f", "right_f"

_MEAN_DISPARITY = 7e-4  # of far points over the image, as a chess board leaves it [focal lengths]
_MEAN_ROW = 1.4e-3  # the same of their rows
#: Root mean square over the image of either [focal lengths]: about a pixel at a focal length of 700 px, as reprojection
#: errors would show larger ones.
_FIELD = 1.4e-3
_FIELD_VALUES = 10  # independent ones of such errors, which change smoothly over the image

_OFFSETS = (0.03, 0.3, 1.0)  # scales of an offset of the disparity alone, equally probable a priori


class Evidence(NamedTuple):
    """A Gaussian likelihood in information form: ``log p = eᵀ θ - θᵀ S θ / 2``."""

    S: Array  # information (n, n)
    e: Array  # information times mean (n,)
    cross: Array  # information that the parameters share with the residual fields (n, m)

    def scaled(self, factor: float) -> Evidence:
        """The same with `factor` times the information."""
        return Evidence(factor * self.S, factor * self.e, factor * self.cross)

    def with_error(self, variance: Array, fields: float = 0.0) -> Evidence:
        """The same with further errors: of the parameters, and by residual fields, which are then marginalised.

        The estimate ``S⁻¹ e`` gets the covariance ``S⁻¹ + V + φ S⁻¹ C Cᵀ S⁻¹``, with V the `variance` (n,) of the
        parameters and φ that of each coefficient of the fields. The information is ``S₁ = G S`` with
        ``G = (1 + S V)⁻¹``, and then ``S₁ (S₁ + φ C₁ C₁ᵀ)⁻¹ S₁`` with ``C₁ = G C``: no inverse of S, nor of its square.
        """
        gain = np.linalg.inv(np.eye(len(self.S)) + self.S * variance)
        S, e, cross = gain @ self.S, gain @ self.e, gain @ self.cross
        S = 0.5 * (S + S.T)
        if not fields:
            return Evidence(S, e, cross)
        total = S + fields * cross @ cross.T
        # 1e-12: numerics, of what nothing shows
        total[np.diag_indices(len(total))] += 1e-12 * np.diag(S) + np.finfo(float).tiny
        gain = np.linalg.solve(total, S).T
        return Evidence(gain @ S, gain @ e, 0.0 * cross)

    def __add__(self, other: Evidence) -> Evidence:  # type: ignore[override]
        """The product of both likelihoods."""
        return Evidence(self.S + other.S, self.e + other.e, self.cross + other.cross)


class RigEvidence(NamedTuple):
    """The evidence of recordings of one rig, without any prior; the residual fields are still in it."""

    plain: Evidence  # of rows and motion, as it is
    apart: Evidence  # each recording with a systematic error of its own, which averages out over recordings
    scales: Array  # log-likelihoods (K,) of the scales of the residual fields, by the rows

    @property
    def fields(self) -> float:
        """Variance of each coefficient of the residual fields [focal lengths²]."""
        weights = np.exp(self.scales - self.scales.max())
        return field_variance(float(np.sqrt(weights @ np.square(RESIDUAL_SCALES) / weights.sum())))

    def __add__(self, other: RigEvidence) -> RigEvidence:  # type: ignore[override]
        """Of the recordings of both."""
        return RigEvidence(self.plain + other.plain, self.apart + other.apart, self.scales + other.scales)

    def to_text(self) -> str:
        """All numbers as one word."""
        arrays = (*self.plain, *self.apart, self.scales)
        return b64encode(np.concatenate([a.ravel() for a in arrays]).astype("<f8").tobytes()).decode("ascii")

    @classmethod
    def from_text(cls, text: str, n: int) -> RigEvidence:
        """The inverse of `to_text`, for n parameters; ValueError where it is none."""
        numbers = np.frombuffer(b64decode(text, validate=True), "<f8").astype(float)
        m, rest = divmod(len(numbers) - len(RESIDUAL_SCALES) - 2 * n * (n + 1), 2 * n)
        if m < 0 or rest or not np.isfinite(numbers).all():
            raise ValueError("its evidence is incomplete")
        sizes = 2 * [n * n, n, n * m]
        S, e, cross, S2, e2, cross2, scales = np.split(numbers, np.cumsum(sizes))
        halves = ((S, e, cross), (S2, e2, cross2))
        plain, apart = (Evidence(s.reshape(n, n), v, c.reshape(n, m)) for s, v, c in halves)
        if not all(
            np.abs(s - s.T).max() <= 1e-6 * np.trace(s) and np.linalg.eigvalsh(s)[0] >= -1e-6 * np.trace(s)
            for s in (plain.S, apart.S)  # 1e-6: rounding
        ):
            raise ValueError("its evidence is none")
        return cls(plain, apart, scales)


def field_variance(scale: float = 1.0) -> float:
    """Variance of each coefficient of the residual fields [focal lengths²], at their scale."""
    # 2e-4: root mean square over the image at a scale of 1 [focal lengths]: a fifth of a pixel at 1000 px
    return (scale * 2e-4) ** 2 / len(RESIDUAL)


class Accumulator:
    """The sum of many likelihoods whose errors may be correlated over time.

    They are summed in blocks in the order in which they come. If all errors were independent, the blocks' gradients at
    the common solution would scatter with covariances equal to their information; the information is divided by the
    factor by which they scatter more (a block version of the sandwich covariance). When there are too many blocks,
    neighbours are merged, so that the blocks, and with them the time over which correlations count, grow with the run.
    Until the scatter has been measured, that factor is `inflation`; a block has `length` likelihoods at first.
    """

    def __init__(self, inflation: float, length: int) -> None:
        self._prior = inflation
        self._blocks: list[Evidence] = []
        self._sum: Evidence | None = None
        self._length = length
        self._in_last = 0
        self.count = 0
        self.inflation = inflation

    def add(self, evidence: Evidence) -> None:
        """Take in a likelihood."""
        self._sum = evidence if self._sum is None else self._sum + evidence
        if not self._blocks or self._in_last == self._length:
            self._blocks.append(evidence)
            self._in_last = 0
        else:
            self._blocks[-1] += evidence
        self._in_last += 1
        self.count += 1
        if len(self._blocks) > 32:  # 32: blocks of evidence kept separately, for their scatter
            even, odd = self._blocks[::2], self._blocks[1::2]
            if len(even) == len(odd):
                self._in_last += self._length
            self._blocks = [a + b for a, b in zip(even, odd)] + even[len(odd) :]
            self._length *= 2

    def total(self) -> Evidence | None:
        """The sum, with its information divided by the inflation; None if there is no likelihood."""
        return None if self._sum is None else self._sum.scaled(1 / self.inflation)

    def update_inflation(self, mean: Array, covariance: Array) -> None:
        """Estimate the inflation from the scatter of the blocks' gradients about the solution of the blocks alone.

        About a solution that the prior holds elsewhere all gradients point the same way, which is no scatter.

        `mean` (n,) is near that solution or not; `covariance` (n, n) is what weighs the parameters.
        """
        count = len(self._blocks)
        if self._sum is None or count < 2 or self._in_last < self._length:  # it changes slowly: once a block is enough
            return
        # 1e-12: least eigenvalue of an information that counts, as a share of the largest
        own = mean + np.linalg.lstsq(self._sum.S, self._sum.e - self._sum.S @ mean, rcond=1e-12)[0]
        scatter = terms = 0.0
        for S, e, _ in self._blocks:
            gradient = e - S @ own
            scatter += float(gradient @ covariance @ gradient)
            terms += float(np.vdot(S, covariance))
        if terms > 0:
            ratio = scatter / (terms * (1 - 1 / count))
            weight = terms / self.inflation * (count - 1)  # parameters that the data determine, for each block
            # 20: degrees of freedom that the configured inflation counts for
            self.inflation = max(1.0, (20.0 * self._prior + weight * ratio) / (20.0 + weight))


def row_evidence(model: RigModel, points: Array, vertical: Array, parameters: Array) -> tuple[Evidence, Evidence]:
    """Likelihood of the parameters by one frame's vertical disparities, which an ideal rectified pair does not have.

    `points` ``(x, y, d)`` (N, 3) [px] of the matches and `vertical`, right row less left row (N,) [px], are as
    measured; outliers are identified at `parameters` (n,). Returns the evidence of the parameters (n), and of them
    followed by the right camera's residual fields of y (n + k): the left camera's have the same effect with opposite
    sign.
    """
    A, fields = model.field(points)[:, 3], model.residual_field(points)[:, 3]
    squared = np.square(vertical + A @ parameters)
    # Weights by Student's t distribution of four degrees of freedom, with tails like those of matches.
    # 0.03: standard deviation of a row [px], the least that is believed
    scale = max(median(squared) / _MEDIAN, 0.03**2)
    weights = (5.0 / (4.0 + squared / scale) / scale)[:, None]
    both = np.column_stack([A, fields[:, -len(RESIDUAL) :]])
    weighted, n = both * weights, A.shape[1]
    S, e = weighted.T @ both, -(weighted.T @ vertical)
    return Evidence(S[:n, :n], e[:n], weighted[:, :n].T @ fields), Evidence(S, e, np.zeros((len(e), 0)))


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of the parameters: a mixture of Gaussians with one mean and several covariances."""

    mean: Array  # (n,)
    covariances: Array  # equally probable ones (K, n, n)

    @cached_property
    def information(self) -> Array:
        """Inverses of the covariances (K, n, n)."""
        return np.linalg.inv(self.covariances)


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
    for change, sigma in ((field[:, 2], _MEAN_DISPARITY), (field[:, 3], _MEAN_ROW)):
        mean = change.mean(axis=0)
        information += np.outer(mean, mean) / sigma**2
        information += change.T @ change * (_FIELD_VALUES / (len(far) * _FIELD**2))
    return np.asarray(information)


def along(model: RigModel, *names: str) -> Array:
    """A change of some parameters alone, by one each (n,)."""
    return np.array([float(name in names) for name in model.names])


def mean_variance(changes: Array, covariance: Array) -> float:
    """Mean variance of changes (N, n) by the parameters, with their covariance (n, n)."""
    return float((changes @ covariance * changes).sum(axis=1).mean())


def systematic_variance(model: RigModel, error: float) -> Array:
    """Variances (n,) of the parameters due to a matching bias that all frames of a recording share.

    Each parameter's standard deviation is what moves rows and disparities by `error` [px] (root mean square over the
    image, of far points and of points with a disparity of a twentieth of the focal length). Repeated structure, slanted
    surfaces and moving shadows are matched with such a bias; it does not average out.
    """
    far = model.far()
    points = np.concatenate([far, far + np.array([0.0, 0.0, 0.05 * model.focal])])
    effect = np.square(model.field(points)[:, 2:]).sum(axis=1)
    return np.asarray(error**2 / effect.mean(axis=0))


@dataclass(frozen=True, eq=False)
class RigPosterior:
    """Gaussian belief about the parameters of `slam.calibration.model`."""

    mean: Array  # (n,)
    covariance: Array  # (n, n)

    names: ClassVar = RigModel.names  # of the parameters (n,)
    units: ClassVar = RigModel.units

    __repr__ = of_shapes

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
    before, after = (np.linalg.slogdet(matrices)[1] for matrices in (prior.information, information))
    logs = 0.5 * (before - after + fits)
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
