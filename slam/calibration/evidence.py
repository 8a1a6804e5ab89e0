"""The likelihood of the parameters, by rows and summed in blocks so that errors shared by neighbours count once."""

from __future__ import annotations

from base64 import b64decode, b64encode
from typing import NamedTuple

import numpy as np

from slam.calibration.model import RESIDUAL, RigModel
from slam.chi_square import chi_square_limit
from slam.geometry.arrays import median
from slam.geometry.se3 import Array

#: Possible scales of a rig's residual fields, see `field_variance`, equally probable a priori: from none to a pixel at
#: 1000 px. Rows tell which it is, so the range matters only where it is too narrow.
RESIDUAL_SCALES = np.geomspace(0.05, 5.0, 10)

_MEDIAN = chi_square_limit(1, 0.5)  # derived: of χ² with one degree of freedom
_PRIOR_TERMS = 20.0  # degrees of freedom that the configured inflation counts for


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
        parameters and φ that of each coefficient of the fields, so the information is ``S (S + S V S + φ C Cᵀ)⁻¹ S``,
        which needs no inverse of S.
        """
        total = self.S + (self.S * variance) @ self.S + fields * self.cross @ self.cross.T
        # 1e-12: numerics, of what nothing shows
        total[np.diag_indices(len(total))] += 1e-12 * np.diag(self.S) + np.finfo(float).tiny
        gain = np.linalg.solve(0.5 * (total + total.T), self.S).T
        return Evidence(gain @ self.S, gain @ self.e, (0.0 if fields else 1.0) * gain @ self.cross)

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
            self.inflation = max(1.0, (_PRIOR_TERMS * self._prior + weight * ratio) / (_PRIOR_TERMS + weight))


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
