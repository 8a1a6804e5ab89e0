"""Joint calibration from several recordings of one rig, and whether the recordings agree."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import add

import numpy as np

from slam.calibration.evidence import RecordingEvidence, RigEvidence, residual_scale
from slam.calibration.model import RigModel
from slam.calibration.posterior import solve
from slam.calibration.prior import Prior, factory_prior, field_variance, systematic_variance
from slam.calibration.saved import SavedCalibration, rig_numbers
from slam.errors import CalibrationError
from slam.geometry.se3 import Array

#: Recordings agree in a parameter if they differ by less than this many standard deviations of the difference, and
#: disagree if by more than the second number; differences between the two limits may be chance.
_AGREES, _DIFFERS = 2.0, 3.0


def joint_calibration(
    model: RigModel,
    prior: Prior,
    evidence: Sequence[RecordingEvidence],
    systematic: float,
    before: RigEvidence | None = None,
) -> SavedCalibration:
    """The calibration of a rig from several recordings.

    Each recording has a systematic error of its own, which is added to its evidence and averages out over recordings.
    The residual fields are the rig's: all recordings share them, so they are marginalised after the recordings have
    been added up, and before the prior comes in. Left out until then, they would make recordings contradict each other
    in combinations that each of them hardly shows, such as a focal length that both cameras share.

    Args:
        model: the parameters' meaning.
        prior: of the parameters.
        evidence: of each recording, without any prior.
        systematic: error of rows and disparities that all frames of a recording may share [px].
        before: of earlier recordings, as a saved calibration holds it.

    Raises:
        CalibrationError: there is no evidence at all.
    """
    variance = systematic_variance(model, systematic)
    parts = [*([] if before is None else [before]), *(RigEvidence.of(one, variance) for one in evidence)]
    if not parts:
        raise CalibrationError("calibration: in no recording was there a motion that shows the rig's errors")
    total = reduce(add, parts)
    residual = residual_scale(total.scales)
    # The scales of the prior follow from the evidence as it is: the systematic errors would excuse a bad calibration.
    together, known = (part.with_error(0.0 * variance, field_variance(residual)) for part in (total.plain, total.apart))
    return SavedCalibration(solve(prior, together, known), rig_numbers(model.rig), residual, total)


def agreement(model: RigModel, evidence: Sequence[RecordingEvidence], systematic: float) -> Array | None:
    """The largest difference of two recordings in each parameter (n,) [standard deviations], by their own evidence.

    NaN where fewer than two determine the parameter; None for a single recording. For the arguments see
    `joint_calibration`.

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
        part = recording.whole.with_error(variance, recording.fields)
        covariance = np.linalg.inv(np.linalg.inv(prior) + part.S)
        after = 1 / np.diag(covariance)
        said = np.where(after > 2 * before, after - before, np.nan)  # more than the prior does
        means.append(after * (covariance @ part.e) / said)
        informations.append(said)
    first, second = np.triu_indices(len(evidence), 1)
    mean, own = np.array(means), 1 / np.array(informations)
    return np.asarray(np.fmax.reduce(np.abs(mean[first] - mean[second]) / np.sqrt(own[first] + own[second]), axis=0))


def agreement_in_words(largest: Array) -> str:
    """The result of `agreement` in a line."""
    known = np.isfinite(largest)
    if not known.any():
        return "Nothing can be said of whether the recordings agree: no parameter is shown by two of them."
    worst = int(np.nanargmax(largest))
    least = f"the largest difference is {largest[worst]:.1f} sigma, in {RigModel.names[worst]}"
    differing = ", ".join(name for name, z in zip(RigModel.names, largest) if z > _AGREES)
    if not differing:
        return f"The recordings agree in all {known.sum()} of {len(known)} parameters that two of them show: {least}."
    if largest[worst] <= _DIFFERS:
        return f"The recordings agree, but for {differing}, where chance may do it: {least}."
    return f"The recordings do not agree in {differing}: {least}. Is it one rig, and has it not changed?"
