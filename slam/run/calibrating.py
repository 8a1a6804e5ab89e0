"""Calibrate a rig from several of its recordings: run them, add up what they say, and write it down."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.calibration import RigModel, RigPosterior, SavedCalibration
from slam.calibration.corrected import corrected_rig
from slam.calibration.evidence import RecordingEvidence
from slam.calibration.joint import Agreement, agreement, joint_calibration
from slam.calibration.saved import rig_difference, rig_numbers
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.errors import CalibrationError, ConfigurationError
from slam.files import write_text
from slam.geometry.rig import StereoRig
from slam.outputs import Output, require_outputs
from slam.runtime.blas import one_blas_thread
from slam.sequences import Sequence as StereoSequence
from slam.sequences import is_live
from slam.sequences.rigs import require_kalibr, write_kalibr, write_opencv
from slam.system import StereoSlam

_BACKEND, _FRONTEND = "ekf", "surf"  # poses are a first guess alone
_SETTINGS = ("objects.mode=off",)

#: What a parameter of each unit is multiplied by in the table, and its unit there; of pure numbers by name.
_SHOWN = {"rad": (1e3, "mrad"), "1": (1e3, "10⁻³")}
_SHARES = {"f": "%", "aspect": "%", "down": "% of baseline", "forward": "% of baseline"}

_NO_PAIRS = (
    "no two views far enough apart were compared: rows alone say next to nothing of disparities; "
    "take longer recordings in which the camera moves on"
)

#: Shows the progress of a recording of so many frames: gives what is called after each.
Show = Callable[[StereoSequence, int], AbstractContextManager[Callable[[FrameResult], None]]]


@dataclass(frozen=True)
class Targets:
    """Files to write."""

    out: Path  # what has been found, with its covariance
    opencv: Path | None = None  # the corrected calibration in OpenCV's form
    kalibr: Path | None = None  # the same in Kalibr's
    overwrite: bool = False  # whether files that are there may be replaced

    def require(self, rig: StereoRig, inputs: Sequence[Path]) -> None:
        """Raise where a file could not be written, before hours of work are done for it; `inputs` are not replaced."""
        if self.kalibr is not None:
            require_kalibr(self.kalibr, rig)
        files = ((self.out, "--out"), (self.opencv, "--opencv"), (self.kalibr, "--kalibr"))
        wanted = [Output(file, option) for file, option in files if file is not None]
        require_outputs(wanted, inputs, self.overwrite)


@dataclass(frozen=True, eq=False)
class Found:
    """What one recording says."""

    name: str
    frames: int  # how many there were
    pairs: int  # of views that show motion
    posterior: RigPosterior  # from this recording alone
    evidence: RecordingEvidence | None  # without any prior; None where no motion was seen


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What all recordings say."""

    found: Sequence[Found]  # by each
    kept: SavedCalibration  # by all together
    agreed: Agreement | None  # whether they agree; None where one alone shows motion
    off: float  # RMS distance [px] of the corrected calibration's pixels from the corrected pixels
    warning: str  # why little can be expected of it; empty for none
    units: Sequence[tuple[float, str]]  # of each parameter, a factor for people, and the unit that it then has


@one_blas_thread
def calibrate(
    sequences: Sequence[StereoSequence],
    targets: Targets,
    show: Show,
    settings: Sequence[str] = (),
    frames: tuple[int, int | None] = (0, None),
    inputs: Sequence[Path] = (),
) -> Calibrated:
    """Run a range of frames of recordings of one rig, and write what they say of it.

    `settings` are as ``--set`` takes them; `inputs` are files and folders that must not be replaced. Raises SlamError
    on bad input, before anything is run.
    """
    rig = sequences[0].rig
    for sequence in sequences:
        if is_live(sequence):
            raise ConfigurationError(f"{sequence.name}: a recording is needed, not a camera")
        difference = rig_difference(rig_numbers(rig), rig_numbers(sequence.rig))
        if difference:
            raise CalibrationError(f"{sequence.name}: not the rig of {sequences[0].name}: {difference}")
    targets.require(rig, inputs)
    configs = [_config(sequence, settings) for sequence in sequences]
    found = [_run(sequence, config, frames, show) for sequence, config in zip(sequences, configs)]
    model, systematic = RigModel(rig), configs[0].self_calibration.systematic
    evidence = [one.evidence for one in found if one.evidence is not None]
    kept, agreed = joint_calibration(model, evidence, systematic), agreement(model, evidence, systematic)
    corrected = corrected_rig(model, kept.posterior.mean)
    warning = "" if any(one.pairs for one in found) else _NO_PAIRS
    tree = kept.to_json() | {
        "recordings": [
            {"sequence": one.name, "frames": one.frames, "pairs": one.pairs, **one.posterior.to_json()} for one in found
        ],
        "agreement": None if agreed is None else agreed.words,
        "warnings": [warning] if warning else [],
    }
    write_text(targets.out, json.dumps(tree, indent=1) + "\n")
    if targets.opencv is not None:
        write_opencv(targets.opencv, corrected.rig)
    if targets.kalibr is not None:
        write_kalibr(targets.kalibr, corrected.rig)
    units = [_unit(name, unit, model.focal) for name, unit in zip(model.names, model.units)]
    return Calibrated(found, kept, agreed, float(np.hypot(corrected.left_off, corrected.right_off)), warning, units)


def _unit(name: str, unit: str, focal: float) -> tuple[float, str]:
    """What a parameter is multiplied by to be shown, and the unit that it then has."""
    if unit == "focal lengths":
        return focal, "px"
    share = _SHARES.get(name.removeprefix("left_").removeprefix("right_"))
    return (100.0, share) if share else _SHOWN[unit]


def _config(sequence: StereoSequence, settings: Sequence[str]) -> SystemConfig:
    """The settings for a recording."""
    config = SystemConfig.for_kind(sequence.kind, _FRONTEND, _BACKEND).with_settings([*_SETTINGS, *settings])
    if not config.self_calibration.enabled:
        raise ConfigurationError("slam calibrate needs self_calibration.enabled=true")
    return config


def _run(sequence: StereoSequence, config: SystemConfig, frames: tuple[int, int | None], show: Show) -> Found:
    """What one recording says."""
    system = StereoSlam(sequence.rig, _FRONTEND, _BACKEND, config=config)
    count = 0
    with show(sequence, len(range(len(sequence))[slice(*frames)])) as on_frame:
        for _, result in system.run(sequence.frames(*frames)):
            on_frame(result)
            count += 1
    own = system.calibration
    return Found(sequence.name, count, own.pairs, own.posterior, own.evidence())
