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
from slam.calibration.posterior import RigEvidence, factory_prior
from slam.calibration.saved import CERTAIN, agreement, agreement_in_words, joint_calibration
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.errors import CalibrationError, ConfigurationError
from slam.files import write_text
from slam.geometry.rig_numbers import rig_difference, rig_numbers
from slam.geometry.se3 import Array
from slam.outputs import Output, require_outputs
from slam.runtime.threads import one_blas_thread
from slam.sequences import Sequence as StereoSequence
from slam.sequences import is_live
from slam.sequences.rigs import write_opencv
from slam.system import StereoSlam

_BACKEND, _FRONTEND = "ekf", "surf"  # poses are a first guess alone
_SETTINGS = ("objects.mode=off",)

#: What a parameter of each unit is multiplied by in the table, and its unit there; of pure numbers by name.
_SHOWN = {"rad": (1e3, "mrad"), "1": (1e3, "10⁻³")}
_SHARES = "f", "aspect", "down", "forward"  # shown in per cent

_NO_PAIRS = (
    "no two views far enough apart were compared: rows alone say next to nothing of disparities; "
    "take longer recordings in which the camera moves on"
)
_UNSOLVED = (
    "{unsolved} of {every} pairs of views agree on no motion: is the calibration of these cameras, and of images of "
    "this size?"
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
    unsolved: int  # pairs of views for which no motion was found
    matched: float  # number of landmarks found again in a frame, the median
    posterior: RigPosterior  # from this recording alone
    evidence: RigEvidence | None  # without any prior; None where no motion was seen


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What all recordings say."""

    found: Sequence[Found]  # by each
    kept: SavedCalibration  # by all together
    apart: Array | None  # how far two differ at most, see `agreement`; None where one alone shows motion
    agreed: str  # the same in a line; empty for None
    judgement: str  # how good the calibration was, in a line; empty where that cannot be said
    worth: bool  # whether correcting is expected to help
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
    overwrite: bool = False,
) -> Calibrated:
    """Run a range of frames of recordings of one rig, and write what they say of it to `out`, with its covariance.

    `opencv` is a file for the corrected calibration in that form; `inputs` are never replaced. Raises
    SlamError on bad input, before anything is run.
    """
    rig = sequences[0].rig
    for sequence in sequences:
        if is_live(sequence):
            raise ConfigurationError(f"{sequence.name}: a recording is needed, not a camera")
        difference = rig_difference(rig_numbers(rig), rig_numbers(sequence.rig))
        if difference:
            raise CalibrationError(f"{sequence.name}: not the rig of {sequences[0].name}: {difference}")
    files = ((out, "--out"), (opencv, "--opencv"))
    require_outputs([Output(file, option) for file, option in files if file is not None], inputs, overwrite)
    configs = [_config(sequence, settings) for sequence in sequences]
    found = [_run(sequence, config, frames, show) for sequence, config in zip(sequences, configs)]
    model = RigModel(rig)
    evidence = [one.evidence for one in found if one.evidence is not None]
    kept = joint_calibration(model, factory_prior(model), evidence)
    apart = agreement(model, evidence)
    agreed = "" if apart is None else agreement_in_words(apart)
    corrected = corrected_rig(model, kept.posterior.mean)
    pairs, unsolved = sum(one.pairs for one in found), sum(one.unsolved for one in found)
    warning = "" if pairs else _NO_PAIRS
    if unsolved > pairs:
        warning = _UNSOLVED.format(unsolved=unsolved, every=pairs + unsolved)
    matched = float(np.median([one.matched for one in found]))
    noise = configs[0].models.pixel_sigma
    judgement, worth = ("", False) if unsolved > pairs else _judged(model, kept.posterior, noise, matched, apart)
    tree = kept.to_json() | {
        "recordings": [
            {"sequence": one.name, "frames": one.frames, "pairs": one.pairs, **one.posterior.to_json()} for one in found
        ],
        "agreement": agreed or None,
        "judgement": judgement,
        "warnings": [warning] if warning else [],
    }
    write_text(out, json.dumps(tree, indent=1) + "\n")
    if opencv is not None:
        write_opencv(opencv, corrected.rig)
    off = float(np.hypot(corrected.left_off, corrected.right_off))
    units = [_unit(name, unit, model.focal) for name, unit in zip(model.names, model.units)]
    return Calibrated(found, kept, apart, agreed, judgement, worth, off, warning, units)


def _judged(
    model: RigModel, posterior: RigPosterior, noise: float, matched: float, apart: Array | None
) -> tuple[str, bool]:
    """What the errors of a calibration do to pixels and depths, in words, and whether correcting is expected to help.

    The noise [px] of a feature averages out over those of a frame, `matched` of them; the rig's error is in all alike.
    Recordings that are `apart`, see `agreement`, do not speak of one rig; a single one may speak of itself.
    """
    points = model.far() + np.array([0.0, 0.0, model.focal / _AWAY])
    fields = np.moveaxis(model.field(points)[:, 2:], 1, 0)  # of disparity and rows (2, N, n)
    off = np.sqrt(np.square(fields @ posterior.mean).mean(axis=1))
    sigma = np.sqrt((fields @ posterior.covariance * fields).sum(axis=2).mean(axis=1))
    left = noise / np.sqrt(max(matched, 1.0))
    worth, beside = False, f"the noise of a frame's {matched:.0f} features leaves {left:.2f} px"
    if max(off) < left:
        word = f"This is good: {beside}."
    elif off[0] <= CERTAIN * sigma[0]:
        word = (
            f"Of depths this is too uncertain to be worth correcting: a correction of less than {CERTAIN:g} standard "
            "deviations may make them worse as well as better; longer recordings, with turns, say more."
        )
    elif apart is None:
        word = (
            "One recording alone does not tell whether this is worth correcting: its own errors look like the rig's. "
            "Give others of the same rig, too: what they agree in is the rig's."
        )
    elif np.nanmax(apart, initial=0.0) > CERTAIN:
        word = "It is not worth correcting by these recordings, which do not agree."
    elif max(off) < noise:
        worth, word = True, f"This is worth correcting: {beside}."
    else:
        worth, word = True, f"This is bad: calibrate anew. The noise of one feature is {noise:g} px."
    text = (
        f"By this the calibration is off by {off[0]:.2f} ± {sigma[0]:.2f} px in disparity and {off[1]:.2f} ± "
        f"{sigma[1]:.2f} px in rows (RMS over the image), so that at {_AWAY:g} baselines depths are "
        f"{100 * off[0] * _AWAY / model.focal:.1f} % wrong. {word}"
    )
    return text, worth


def _unit(name: str, unit: str, focal: float) -> tuple[float, str]:
    """What a parameter is multiplied by to be shown, and the unit that it then has."""
    if unit == "focal lengths":
        return focal, "px"
    return (100.0, "%") if name.removeprefix("left_").removeprefix("right_") in _SHARES else _SHOWN[unit]


def _config(sequence: StereoSequence, settings: Sequence[str]) -> SystemConfig:
    """The settings for a recording."""
    config = SystemConfig.for_kind(sequence.kind, _FRONTEND).with_settings([*_SETTINGS, *settings])
    if not config.self_calibration.enabled:
        raise ConfigurationError("slam calibrate needs self_calibration.enabled=true")
    return config


def _run(sequence: StereoSequence, config: SystemConfig, frames: tuple[int, int | None], show: Show) -> Found:
    """What one recording says."""
    system = StereoSlam(sequence.rig, _FRONTEND, _BACKEND, config=config)
    matched = []
    with show(sequence, len(range(len(sequence))[slice(*frames)])) as on_frame:
        for _, result in system.run(sequence.frames(*frames)):
            on_frame(result)
            matched.append(len(result.matched))
    own = system.calibration
    middle = float(np.median(matched)) if matched else 0.0
    return Found(sequence.name, len(matched), own.pairs, own.unsolved, middle, own.kept().posterior, own.evidence())
