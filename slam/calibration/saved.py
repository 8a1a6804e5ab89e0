"""What recordings say of a rig together, whether they agree, and its files: a prior for further recordings."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from slam.calibration.model import RigModel
from slam.calibration.posterior import Prior, RigEvidence, RigPosterior, factory_prior, solve
from slam.errors import CalibrationError
from slam.files import expanded, read_text, write_text
from slam.geometry.rig import NUMBERS, rig_numbers
from slam.geometry.se3 import Array

_LIMIT = 2**24  # bytes of a file: the summary of a run with all its settings is far smaller
_NOT_KEPT = (
    "neither a file of `slam calibrate` nor the summary.json of a run; the calibration file of a rig belongs to the "
    "sequence: 'FOLDER?calibration=FILE'"
)


@dataclass(frozen=True, eq=False)
class SavedCalibration:
    """The errors of a rig's calibration as self-calibration has estimated them, with covariance.

    Attributes:
        posterior: estimated corrections of the rig as calibrated.
        rig: numbers of the rig as calibrated, to recognise it, see `rig_numbers`.
        evidence: of the recordings that it is of, to which that of later ones is added; None where none showed motion.
    """

    posterior: RigPosterior
    rig: Mapping[str, float]
    evidence: RigEvidence | None = field(default=None, repr=False)

    def to_json(self) -> dict[str, Any]:
        """As plain types."""
        evidence = None if self.evidence is None else self.evidence.to_text()
        return {"rig": dict(self.rig), **self.posterior.to_json(), "evidence": evidence}

    @classmethod
    def from_json(cls, tree: Mapping[str, Any]) -> SavedCalibration:
        """The inverse of `to_json`.

        Raises:
            CalibrationError: a key is missing, a value is of the wrong type, or the parameters are of another version.
        """
        try:
            rows = tree["parameters"]
            names = tuple(str(row["name"]) for row in rows)
            mean = np.array([row["mean"] for row in rows], float)
            covariance = np.array(tree["covariance"], float).reshape(len(rows), len(rows))
            text = tree.get("evidence")
            evidence = None if text is None else RigEvidence.from_text(text, len(rows))
            rig = {name: float(tree["rig"][name]) for name in NUMBERS}
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CalibrationError(f"calibration: cannot be read: {' '.join(str(error).split())}") from error
        if not all(np.isfinite(numbers).all() for numbers in (mean, covariance, list(rig.values()))):
            raise CalibrationError("calibration: all its numbers must be finite")
        if names != RigModel.names:
            raise CalibrationError("calibration: its parameters are not those of this version")
        # 1.0: correction [rad, focal lengths, 1] and variance that a file may hold
        if max(np.abs(mean).max(), np.diag(covariance).max()) > 1.0:
            raise CalibrationError("calibration: a correction or its deviation is larger than the rig itself")
        symmetric = np.allclose(covariance, covariance.T, rtol=1e-6, atol=0)
        if not symmetric or np.linalg.eigvalsh(covariance).min() <= 0:
            raise CalibrationError("calibration: its covariance is none")
        return cls(RigPosterior(mean, covariance), rig, evidence)


#: Recordings agree in a parameter if they differ by less than this many standard deviations of the difference, and
#: disagree if by more than the second number; differences between the two limits may be chance.
_AGREES, CERTAIN = 2.0, 3.0


def joint_calibration(model: RigModel, prior: Prior, evidence: Sequence[RigEvidence]) -> SavedCalibration:
    """The calibration of a rig from the evidence of several recordings, or of what saved calibrations hold.

    The residual fields are the rig's: all recordings share them, so they are marginalised after the recordings have
    been added up, and before the prior comes in. Left out until then, they would make recordings contradict each other
    in combinations that each of them hardly shows, such as a focal length that both cameras share.

    Raises:
        CalibrationError: there is no evidence at all.
    """
    if not evidence:
        raise CalibrationError("calibration: in no recording was there a motion that shows the rig's errors")
    total = reduce(add, evidence)
    # The scales of the prior follow from the evidence as it is: the systematic errors would excuse a bad calibration.
    together, known = (part.with_error(np.zeros(len(part.e)), total.fields) for part in (total.plain, total.apart))
    return SavedCalibration(solve(prior, together, known), rig_numbers(model.rig), total)


def agreement(model: RigModel, evidence: Sequence[RigEvidence]) -> Array | None:
    """The largest difference of two recordings in each parameter (n,) [standard deviations], by their own evidence.

    NaN where fewer than two determine the parameter; None for a single recording.

    The prior, which they share, is no evidence of agreement. So each parameter's marginal posterior is divided by the
    prior, which gives that parameter's likelihood by the recording alone, with the others marginalised. A recording
    with less information on a parameter than the prior is left out.
    """
    if len(evidence) < 2:
        return None
    prior = factory_prior(model).covariances[-1]
    before = 1 / np.diag(prior)
    means, informations = [], []
    for recording in evidence:
        part = recording.apart.with_error(np.zeros(len(before)), recording.fields)
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
    if largest[worst] <= CERTAIN:
        return f"The recordings agree, but for {differing}, where chance may do it: {least}."
    return f"The recordings do not agree in {differing}: {least}. Is it one rig, and has it not changed?"


def load_calibration(path: str | Path) -> SavedCalibration:
    """Read the errors of a rig as self-calibration has estimated them.

    Args:
        path: file of `slam calibrate`, ``summary.json`` of a run, or the folder of a run.

    Raises:
        CalibrationError: the file cannot be read, or is something else.
    """
    file = expanded(path, CalibrationError)
    file = file / "summary.json" if os.path.isdir(file) else file  # noqa: PTH112 unlike Path's, without errors
    text = read_text(file, _LIMIT, CalibrationError)
    tree = None
    with suppress(ValueError, RecursionError, AttributeError):  # AttributeError: of what is no mapping
        tree = json.loads(text)
        tree = tree.get("self_calibration", tree)
    if not isinstance(tree, Mapping) or "parameters" not in tree:
        raise CalibrationError(f"{file}: {_NOT_KEPT}")
    try:
        return SavedCalibration.from_json(tree)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error


def save_calibration(path: str | Path, kept: SavedCalibration) -> None:
    """Write a file that `load_calibration` reads.

    Raises:
        SlamError: it cannot be written; an old one is kept.
    """
    write_text(path, json.dumps(kept.to_json(), indent=1) + "\n")
