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
from slam.sequences.calibration_files import require_kalibr, write_kalibr, write_opencv
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
    """Files to write.

    Attributes:
        out: what has been found, with its covariance.
        opencv: the corrected calibration in OpenCV's form; None for none.
        kalibr: in Kalibr's.
        overwrite: whether files that are there may be replaced.
    """

    out: Path
    opencv: Path | None = None
    kalibr: Path | None = None
    overwrite: bool = False

    def require(self, rig: StereoRig, inputs: Sequence[Path]) -> None:
        """Raise where a file could not be written, before hours of work are done for it; `inputs` are not replaced."""
        if self.kalibr is not None:
            require_kalibr(self.kalibr, rig)
        files = ((self.out, "--out"), (self.opencv, "--opencv"), (self.kalibr, "--kalibr"))
        wanted = [Output(file, option) for file, option in files if file is not None]
        require_outputs(wanted, inputs, self.overwrite)


@dataclass(frozen=True, eq=False)
class Found:
    """What one recording says.

    Attributes:
        name: of the recording.
        frames: how many there were.
        pairs: of views that show motion.
        posterior: from this recording alone.
        evidence: without any prior; None where no motion was seen.
    """

    name: str
    frames: int
    pairs: int
    posterior: RigPosterior
    evidence: RecordingEvidence | None


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What all recordings say.

    Attributes:
        found: by each.
        kept: by all together.
        agreed: whether they agree; None where one alone shows motion.
        off: how far pixels of the corrected calibration are from the corrected pixels, root mean square [px].
        warning: a line on why little can be expected of it; empty for none.
        units: of each parameter, what it is multiplied by for people, and the unit that it then has.
    """

    found: Sequence[Found]
    kept: SavedCalibration
    agreed: Agreement | None
    off: float
    warning: str
    units: Sequence[tuple[float, str]]


@one_blas_thread
def calibrate(
    sequences: Sequence[StereoSequence],
    targets: Targets,
    show: Show,
    settings: Sequence[str] = (),
    frames: tuple[int, int | None] = (0, None),
    inputs: Sequence[Path] = (),
) -> Calibrated:
    """Run recordings of one rig, and write what they say of it.

    Args:
        sequences: the recordings.
        targets: files to write.
        show: the progress of each.
        settings: as ``--set`` takes them.
        frames: the first of each, and the one after the last; None for all.
        inputs: files and folders that must not be replaced.

    Raises:
        SlamError: bad input; one line says what and where.
    """
    _require_one_rig(sequences)
    rig = sequences[0].rig
    targets.require(rig, inputs)
    found = [_run(sequence, settings, frames, show) for sequence in sequences]
    model = RigModel(rig)
    evidence = [one.evidence for one in found if one.evidence is not None]
    systematic = _config(sequences[0], settings).self_calibration.systematic
    kept = joint_calibration(model, evidence, systematic)
    agreed = agreement(model, evidence, systematic)
    corrected = corrected_rig(model, kept.posterior.mean)
    every = [
        {"sequence": one.name, "frames": one.frames, "pairs": one.pairs, **one.posterior.to_json()} for one in found
    ]
    warning = "" if any(one.pairs for one in found) else _NO_PAIRS
    tree = {**kept.to_json(), "recordings": every, "agreement": None if agreed is None else agreed.words}
    tree["warnings"] = [warning] if warning else []
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


def _require_one_rig(sequences: Sequence[StereoSequence]) -> None:
    """Raise where recordings are of several rigs, or have no end."""
    for sequence in sequences:
        if is_live(sequence):
            raise ConfigurationError(f"{sequence.name}: a recording is needed, not a camera")
        difference = rig_difference(rig_numbers(sequences[0].rig), rig_numbers(sequence.rig))
        if difference:
            raise CalibrationError(f"{sequence.name}: not the rig of {sequences[0].name}: {difference}")


def _config(sequence: StereoSequence, settings: Sequence[str]) -> SystemConfig:
    """The settings for a recording."""
    config = SystemConfig.for_kind(sequence.kind, _FRONTEND, _BACKEND).with_settings([*_SETTINGS, *settings])
    if not config.self_calibration.enabled:
        raise ConfigurationError("slam calibrate needs self_calibration.enabled=true")
    return config


def _run(sequence: StereoSequence, settings: Sequence[str], frames: tuple[int, int | None], show: Show) -> Found:
    """What one recording says."""
    system = StereoSlam(sequence.rig, _FRONTEND, _BACKEND, config=_config(sequence, settings))
    last = len(sequence) if frames[1] is None else min(frames[1], len(sequence))
    count = 0
    with show(sequence, max(last - frames[0], 0)) as on_frame:
        for _, result in system.run(sequence.frames(*frames)):
            on_frame(result)
            count += 1
    own = system.calibration
    return Found(sequence.name, count, own.pairs, own.posterior, own.evidence())
