"""Joint calibration from several recordings of one rig, and whether the recordings agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.calibration.evidence import RecordingEvidence
from slam.calibration.model import RigModel
from slam.calibration.posterior import RigPosterior, solve
from slam.calibration.prior import factory_prior, residual_variance, systematic_variance
from slam.calibration.saved import RigNumbers, SavedCalibration
from slam.errors import CalibrationError
from slam.geometry.se3 import Array

#: Recordings agree in a parameter if they differ by less than this many standard deviations of the difference.
AGREES = 2.0
_DIFFERS = 3.0  # and disagree if by more than this many; differences between the two limits may be chance


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
    variance, alone = systematic_variance(model, systematic), len(evidence) == 1
    known = [part.whole if alone else part.whole.with_error(variance) for part in evidence]
    scaled_by = [part.motion if alone else part.whole for part in evidence]
    residual = max(part.residual for part in evidence)
    solution = solve(factory_prior(model), residual, scaled_by, known)
    covariance = solution.covariance + (np.diag(variance) if alone else 0.0)
    posterior = RigPosterior(model.names, model.units, solution.mean, 0.5 * (covariance + covariance.T))
    return SavedCalibration(posterior, RigNumbers.of(model.rig), solution.residual)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Differences between recordings, each by its own evidence."""

    names: tuple[str, ...]  # of the parameters (n,)
    # the largest difference of two recordings in each parameter (n,) [standard deviations]; NaN if fewer than two
    # determine it
    largest: Array
    pairs: np.ndarray  # the recordings (n, 2) that differ most; meaningless where `largest` is NaN

    @property
    def words(self) -> str:
        """The result in a line."""
        known = np.isfinite(self.largest)
        if not known.any():
            return "Nothing can be said of whether the recordings agree: no parameter is shown by two of them."
        worst, total = int(np.nanargmax(self.largest)), len(known)
        every = "every parameter" if known.all() else f"all {known.sum()} of {total} parameters that two of them show"
        least = f"the largest difference is {self.largest[worst]:.1f} sigma, in {self.names[worst]}"
        if self.largest[worst] <= AGREES:
            return f"The recordings agree in {every}: {least}."
        differing = [name for name, z in zip(self.names, self.largest) if z > AGREES]
        if self.largest[worst] <= _DIFFERS:
            return f"The recordings agree, but for {', '.join(differing)}, where chance may do it: {least}."
        return f"The recordings do not agree in {', '.join(differing)}: {least}. Is it one rig, and has it not changed?"


def agreement(model: RigModel, evidence: Sequence[RecordingEvidence], systematic: float) -> Agreement | None:
    """Compare recordings in pairs; None for a single recording.

    The prior, which they share, is no evidence of agreement. So each parameter's marginal posterior is divided by the
    prior, which gives that parameter's likelihood by the recording alone, with the others marginalised. A recording
    with less information on a parameter than the prior is left out.

    Args:
        model: the parameters' meaning.
        evidence: of each recording, without any prior.
        systematic: see `joint_calibration` [px].
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
        # 1.0: least information of a recording on a parameter, in units of the prior's, for it to be compared
        said = np.where(after - before > 1.0 * before, after - before, np.nan)
        means.append(after * (covariance @ part.e) / said)
        informations.append(said)
    mean, own = np.array(means), 1 / np.array(informations)
    first, second = np.triu_indices(len(evidence), 1)
    z = np.abs(mean[first] - mean[second]) / np.sqrt(own[first] + own[second])
    rows = np.argmax(np.nan_to_num(z, nan=-1.0), axis=0)
    return Agreement(model.names, z[rows, np.arange(z.shape[1])], np.column_stack([first[rows], second[rows]]))
