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
from slam.calibration.correction import RigCorrection
from slam.calibration.evidence import RecordingEvidence
from slam.calibration.joint import Agreement, agreement, joint_calibration
from slam.calibration.saved import rig_difference, rig_numbers
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.errors import CalibrationError, ConfigurationError
from slam.files import write_text
from slam.geometry.se3 import Array
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

_AWAY = 50.0  # baselines at which the error of the depth is said

#: Shows the progress of a recording of so many frames: gives what is called after each.
Show = Callable[[StereoSequence, int], AbstractContextManager[Callable[[FrameResult], None]]]


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
    judgement: str  # how good the calibration was, in a line
    off: float  # RMS distance [px] of the corrected calibration's pixels from the corrected pixels
    warning: str  # why little can be expected of it; empty for none
    units: Sequence[tuple[float, str]]  # of each parameter, a factor for people, and the unit that it then has


@one_blas_thread
def calibrate(
    sequences: Sequence[StereoSequence],
    out: Path,
    show: Show,
    settings: Sequence[str] = (),
    frames: tuple[int, int | None] = (0, None),
    inputs: Sequence[Path] = (),
    opencv: Path | None = None,
    kalibr: Path | None = None,
    overwrite: bool = False,
) -> Calibrated:
    """Run a range of frames of recordings of one rig, and write what they say of it.

    Args:
        sequences: the recordings.
        out: file for what has been found, with its covariance.
        show: shows the progress.
        settings: as ``--set`` takes them.
        frames: range of frames of each.
        inputs: files and folders that must not be replaced.
        opencv: file for the corrected calibration in OpenCV's form.
        kalibr: the same in Kalibr's.
        overwrite: whether files that are there may be replaced.

    Raises:
        SlamError: bad input, before anything is run.
    """
    rig = sequences[0].rig
    for sequence in sequences:
        if is_live(sequence):
            raise ConfigurationError(f"{sequence.name}: a recording is needed, not a camera")
        difference = rig_difference(rig_numbers(rig), rig_numbers(sequence.rig))
        if difference:
            raise CalibrationError(f"{sequence.name}: not the rig of {sequences[0].name}: {difference}")
    if kalibr is not None:
        require_kalibr(kalibr, rig)
    files = ((out, "--out"), (opencv, "--opencv"), (kalibr, "--kalibr"))
    require_outputs([Output(file, option) for file, option in files if file is not None], inputs, overwrite)
    configs = [_config(sequence, settings) for sequence in sequences]
    found = [_run(sequence, config, frames, show) for sequence, config in zip(sequences, configs)]
    model, systematic = RigModel(rig), configs[0].self_calibration.systematic
    evidence = [one.evidence for one in found if one.evidence is not None]
    kept, agreed = joint_calibration(model, evidence, systematic), agreement(model, evidence, systematic)
    corrected = corrected_rig(model, kept.posterior.mean)
    warning = "" if any(one.pairs for one in found) else _NO_PAIRS
    judgement = _judged(model, kept.posterior.mean, configs[0].models.pixel_sigma)
    tree = kept.to_json() | {
        "recordings": [
            {"sequence": one.name, "frames": one.frames, "pairs": one.pairs, **one.posterior.to_json()} for one in found
        ],
        "agreement": None if agreed is None else agreed.words,
        "judgement": judgement,
        "warnings": [warning] if warning else [],
    }
    write_text(out, json.dumps(tree, indent=1) + "\n")
    if opencv is not None:
        write_opencv(opencv, corrected.rig)
    if kalibr is not None:
        write_kalibr(kalibr, corrected.rig)
    off = float(np.hypot(corrected.left_off, corrected.right_off))
    units = [_unit(name, unit, model.focal) for name, unit in zip(model.names, model.units)]
    return Calibrated(found, kept, agreed, judgement, off, warning, units)


def _judged(model: RigModel, parameters: Array, noise: float) -> str:
    """What the errors of a calibration do to pixels and depths, and whether that is much beside a pixel's noise."""
    camera = model.rig.rectified.rig.left
    across, down = (np.linspace(0.1, 0.9, 9) * size for size in (camera.width, camera.height))
    left = np.stack(np.meshgrid(across, down), axis=2).reshape(-1, 2)
    far = camera.fu / _AWAY  # disparity [px]
    right = left - [far, 0.0]
    changed = np.concatenate(RigCorrection(model, parameters).pixels(left, right), axis=1) - np.hstack([left, right])
    disparity = float(np.sqrt(np.mean((changed[:, 0] - changed[:, 2]) ** 2)))
    rows = float(np.sqrt(np.mean((changed[:, 1] - changed[:, 3]) ** 2)))
    share = max(disparity, rows) / noise
    word = "good" if share < 0.2 else "worth correcting, as runs do by default" if share < 1 else "bad: calibrate anew"
    return (
        f"By this the calibration is off by {disparity:.2f} px in disparity and {rows:.2f} px in rows (RMS over the "
        f"image), so that at {_AWAY:g} baselines depths are {100 * disparity / far:.1f} % wrong. This is {word}; "
        f"the noise of a feature is {noise:g} px, and a good calibration is off by less than a fifth of it."
    )


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
