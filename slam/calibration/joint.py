"""Several recordings of one rig: what they say together, and whether they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.calibration.evidence import Evidence
from slam.calibration.kept import KeptCalibration, RigNumbers
from slam.calibration.model import RigModel
from slam.calibration.posterior import RigPosterior, solve
from slam.calibration.prior import as_delivered, residual_variance, systematic_variance
from slam.errors import CalibrationError
from slam.geometry.se3 import Array

#: Recordings agree in a parameter where they differ by less than so many standard deviations of their difference.
AGREES = 2.0
_DIFFERS = 3.0  # and do not where by more than so many; between the two, chance may do it in one of 21 parameters


def joint_calibration(model: RigModel, evidence: Sequence[Evidence], systematic: float) -> KeptCalibration:
    """What recordings say of the rig that they share.

    Each recording has a systematic error of its own, that does not average out within it but does over recordings: what
    it says is off by that. One alone has its error added in the end, as in its own run.

    Args:
        model: the parameters' meaning.
        evidence: of each recording, without any prior.
        systematic: error of rows and disparities that all frames of a recording may share [px].

    Raises:
        CalibrationError: there is no evidence at all.
    """
    if not evidence:
        raise CalibrationError("calibration: in no recording was there a motion that shows the rig's errors")
    variance, alone = systematic_variance(model, systematic), len(evidence) == 1
    known = None if alone else [part.with_error(variance) for part in evidence]
    solution = solve(as_delivered(model), residual_variance(), evidence, known)
    covariance = solution.covariance + (np.diag(variance) if alone else 0.0)
    posterior = RigPosterior(model.names, model.units, solution.mean, 0.5 * (covariance + covariance.T))
    return KeptCalibration(posterior, RigNumbers.of(model.rig), solution.residual)


@dataclass(frozen=True)
class Agreement:
    """How far recordings are from each other.

    Attributes:
        names: of the parameters (n,).
        largest: the largest difference of two recordings in each parameter (n,) [standard deviations].
        pairs: the recordings (n, 2) that differ so much.
    """

    names: tuple[str, ...]
    largest: Array
    pairs: np.ndarray

    @property
    def words(self) -> str:
        """The result in a line."""
        worst = int(np.argmax(self.largest))
        least = f"the largest difference is {self.largest[worst]:.1f} sigma, in {self.names[worst]}"
        if self.largest[worst] <= AGREES:
            return f"The recordings agree in every parameter: {least}."
        differing = [name for name, z in zip(self.names, self.largest) if z > AGREES]
        if self.largest[worst] <= _DIFFERS:
            return f"The recordings agree, but for {', '.join(differing)}, where chance may do it: {least}."
        return f"The recordings do not agree in {', '.join(differing)}: {least}. Is it one rig, and has it not changed?"


def agreement(posteriors: Sequence[RigPosterior]) -> Agreement | None:
    """Differences of each two recordings (what each alone makes of the calibration as delivered); None of one alone.

    Where a recording says little both are near the calibration as delivered: that is no evidence of agreement, and wide
    standard deviations show it.
    """
    if len(posteriors) < 2:
        return None
    mean, variance = (np.array([getattr(p, name) for p in posteriors]) for name in ("mean", "sigma"))
    first, second = np.triu_indices(len(posteriors), 1)
    z = np.abs(mean[first] - mean[second]) / np.hypot(variance[first], variance[second])
    rows = np.argmax(z, axis=0)
    return Agreement(posteriors[0].names, z.max(axis=0), np.column_stack([first[rows], second[rows]]))
