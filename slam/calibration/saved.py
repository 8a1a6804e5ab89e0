"""Files with a rig's estimated errors: the result of self-calibration, as a prior for further recordings."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.calibration.evidence import RigEvidence
from slam.calibration.model import RigModel
from slam.calibration.posterior import RigPosterior
from slam.calibration.prior import RESIDUAL_SCALES
from slam.errors import CalibrationError
from slam.files import expanded, read_text, write_text
from slam.geometry.rig import StereoRig

_LIMIT = 2**24  # bytes of a file: the summary of a run with all its settings is far smaller
_NOT_KEPT = (
    "neither a file of `slam calibrate` nor the summary.json of a run; the calibration file of a rig belongs to the "
    "sequence: 'FOLDER?calibration=FILE'"
)
_NUMBERS = ("width", "height", "focal", "u0", "v0", "right_u0", "baseline")


def rig_numbers(rig: StereoRig) -> dict[str, float]:
    """The rectified cameras as delivered, to which all corrections refer: they identify a rig in a calibration file.

    Size of the images, focal length, principal point of the left camera and that of the right one along the rows [px],
    distance of the cameras [m].
    """
    r = rig.rectified.rig
    values = r.width, r.height, r.left.fu, r.left.u0, r.left.v0, r.right.u0, r.baseline
    return dict(zip(_NUMBERS, map(float, values)))


def rig_difference(there: Mapping[str, float], here: Mapping[str, float]) -> str:
    """The first number of two rigs, see `rig_numbers`, that differs, in words; empty if none does."""
    for name in _NUMBERS:
        # 1e-5: relative difference of numbers of the same calibration, written and read
        if abs(there[name] - here[name]) > 1e-5 * max(abs(there[name]), abs(here[name])):
            return f"{name} {there[name]:g} there, {here[name]:g} here"
    return ""


@dataclass(frozen=True, eq=False)
class SavedCalibration:
    """The errors of a rig's calibration as self-calibration has estimated them, with covariance.

    Attributes:
        posterior: estimated corrections of the rig as calibrated.
        rig: numbers of the rig as calibrated, to recognise it, see `rig_numbers`.
        residual: scale of the errors that no parameter describes (see `slam.calibration.prior`).
        evidence: of the recordings that it is of, to which that of later ones is added; None where none showed motion.
    """

    posterior: RigPosterior
    rig: Mapping[str, float]
    residual: float = 1.0
    evidence: RigEvidence | None = None

    def __repr__(self) -> str:
        r = self.rig
        rig = f"{r['width']:.0f}x{r['height']:.0f}, focal length {r['focal']:.1f} px, baseline {r['baseline']:.4f} m"
        return f"SavedCalibration({rig}; {self.posterior!r})"

    def require_fits(self, rig: StereoRig) -> None:
        """Raise if it is for another rig.

        Raises:
            CalibrationError: a number of the rig as calibrated differs.
        """
        if found := rig_difference(self.rig, rig_numbers(rig)):
            raise CalibrationError(f"the kept calibration is of another rig: {found}")

    def to_json(self) -> dict[str, Any]:
        """As plain types."""
        evidence = None if self.evidence is None else self.evidence.to_text()
        return {
            "rig": dict(self.rig),
            "residual_scale": self.residual,
            **self.posterior.to_json(),
            "evidence": evidence,
        }

    @classmethod
    def from_json(cls, tree: Mapping[str, Any]) -> SavedCalibration:
        """The inverse of `to_json`.

        Raises:
            CalibrationError: a key is missing, a value is of the wrong type, or the parameters are of another version.
        """
        try:
            rows, residual = tree["parameters"], tree.get("residual_scale")
            names = tuple(str(row["name"]) for row in rows)
            mean = np.array([row["mean"] for row in rows], float)
            covariance = np.array(tree["covariance"], float).reshape(len(rows), len(rows))
            text = tree.get("evidence")
            evidence = None if text is None else RigEvidence.from_text(text, len(rows))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CalibrationError(f"calibration: cannot be read: {' '.join(str(error).split())}") from error
        try:
            rig = {name: float(tree["rig"][name]) for name in _NUMBERS}
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CalibrationError("calibration: it does not say of which rig it is") from error
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
        if not isinstance(residual, (int, float)) or not 0 <= residual <= float(RESIDUAL_SCALES[-1]):
            raise CalibrationError(f"calibration: residual_scale must lie in 0..{RESIDUAL_SCALES[-1]:g}")
        return cls(RigPosterior(mean, covariance), rig, float(residual), evidence)


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
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{file}: {_NOT_KEPT}") from error
    if isinstance(tree, Mapping):
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
