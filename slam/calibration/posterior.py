"""The posterior of a rig's parameters, given evidence and a prior whose scales are not known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from slam.calibration.evidence import Evidence
from slam.calibration.model import RigModel
from slam.calibration.prior import RESIDUAL_SCALES, Prior, field_variance
from slam.geometry.se3 import Array


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
    unchanged instead of following the noise.

    Args:
        prior: of the parameters.
        evidence: of the data, from which the prior's scales follow.
        known: evidence of which the parameters' posterior is computed; None if it is `evidence`.
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
