"""Joint calibration from several recordings of one rig, and whether the recordings agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.calibration.evidence import RecordingEvidence
from slam.calibration.model import RigModel
from slam.calibration.posterior import RigPosterior, solve
from slam.calibration.prior import factory_prior, residual_variance, systematic_variance
from slam.calibration.saved import SavedCalibration, rig_numbers
from slam.errors import CalibrationError
from slam.geometry.se3 import Array

#: Recordings agree in a parameter if they differ by less than this many standard deviations of the difference, and
#: disagree if by more than the second number; differences between the two limits may be chance.
_AGREES, _DIFFERS = 2.0, 3.0


def joint_calibration(model: RigModel, evidence: Sequence[RecordingEvidence], systematic: float) -> SavedCalibration:
    """The calibration of a rig from several recordings.

    Each recording has a systematic error of its own, which averages out over recordings but not within one, and is
    added to its evidence. For a single recording that error is added to the posterior instead, and the scale of the
    calibration's errors follows from its motion, as in its own run.

    Args:
        model: the parameters' meaning.
        evidence: of each recording, without any prior.
        systematic: error of rows and disparities that all frames of a recording may share [px].

    Raises:
        CalibrationError: there is no evidence at all.
    """
    if not evidence:
        raise CalibrationError("calibration: in no recording was there a motion that shows the rig's errors")
    first, variance, prior = evidence[0], systematic_variance(model, systematic), factory_prior(model)
    if len(evidence) == 1:
        solution = solve(prior, first.residual, first.motion, first.whole)
        covariance = solution.covariance + np.diag(variance)
    else:
        whole = [part.whole for part in evidence]
        known = [part.with_error(variance) for part in whole]
        residual = max(part.residual for part in evidence)
        solution = solve(prior, residual, sum(whole[1:], whole[0]), sum(known[1:], known[0]))
        covariance = solution.covariance
    posterior = RigPosterior(solution.mean, 0.5 * (covariance + covariance.T))
    return SavedCalibration(posterior, rig_numbers(model.rig), solution.residual)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Differences between recordings, each by its own evidence."""

    # the largest difference of two recordings in each parameter (n,) [standard deviations]; NaN if fewer than two
    # determine it
    largest: Array

    @property
    def words(self) -> str:
        """The result in a line."""
        known = np.isfinite(self.largest)
        if not known.any():
            return "Nothing can be said of whether the recordings agree: no parameter is shown by two of them."
        worst = int(np.nanargmax(self.largest))
        least = f"the largest difference is {self.largest[worst]:.1f} sigma, in {RigModel.names[worst]}"
        differing = ", ".join(name for name, z in zip(RigModel.names, self.largest) if z > _AGREES)
        if not differing:
            return (
                f"The recordings agree in all {known.sum()} of {len(known)} parameters that two of them show: {least}."
            )
        if self.largest[worst] <= _DIFFERS:
            return f"The recordings agree, but for {differing}, where chance may do it: {least}."
        return f"The recordings do not agree in {differing}: {least}. Is it one rig, and has it not changed?"


def agreement(model: RigModel, evidence: Sequence[RecordingEvidence], systematic: float) -> Agreement | None:
    """Compare recordings in pairs; None for a single recording. For the arguments see `joint_calibration`.

    The prior, which they share, is no evidence of agreement. So each parameter's marginal posterior is divided by the
    prior, which gives that parameter's likelihood by the recording alone, with the others marginalised. A recording
    with less information on a parameter than the prior is left out.
    """
    if len(evidence) < 2:
        return None
    prior, variance = factory_prior(model).covariances[-1], systematic_variance(model, systematic)
    before = 1 / np.diag(prior)
    means, informations = [], []
    for recording in evidence:
        part = recording.whole.with_error(variance)
        covariance = np.linalg.inv(np.linalg.inv(prior) + part.S)
        moved = recording.residual * covariance @ part.cross
        after = 1 / (np.diag(covariance) + residual_variance() * np.square(moved).sum(axis=1))
        said = np.where(after > 2 * before, after - before, np.nan)  # more than the prior does
        means.append(after * (covariance @ part.e) / said)
        informations.append(said)
    first, second = np.triu_indices(len(evidence), 1)
    mean, own = np.array(means), 1 / np.array(informations)
    z = np.abs(mean[first] - mean[second]) / np.sqrt(own[first] + own[second])
    return Agreement(np.fmax.reduce(z, axis=0))
