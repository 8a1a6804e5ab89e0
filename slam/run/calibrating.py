"""Calibrate a rig from several of its recordings: run them, add up what they say, and write it down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.calibration import RigModel, RigPosterior
from slam.calibration.posterior import RigEvidence, factory_prior
from slam.calibration.saved import CERTAIN, agreement, agreement_in_words, joint_calibration
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.errors import CalibrationError, ConfigurationError
from slam.geometry.rig import rig_difference, rig_numbers
from slam.geometry.se3 import Array
from slam.outputs import Output, require_outputs
from slam.run.run_files import write_json
from slam.runtime.threads import one_blas_thread
from slam.sequences import Sequence as StereoSequence
from slam.sequences import is_live
from slam.system import StereoSlam

_BACKEND, _FRONTEND = "ekf", "surf"  # poses are a first guess alone

_NO_PAIRS = (
    "no two views far enough apart were compared: rows alone say next to nothing of disparities; "
    "take longer recordings in which the camera moves on"
)
_AWAY = 50.0  # baselines at which the error of the depth is said

OnFrame = Callable[[FrameResult], None]


@one_blas_thread
def calibrate(
    sequences: Sequence[StereoSequence],
    out: Path,
    settings: Sequence[str] = (),
    frames: tuple[int, int | None] = (0, None),
    inputs: Sequence[Path] = (),
    overwrite: bool = False,
    on_frame: OnFrame = lambda result: None,
) -> dict[str, Any]:
    """Run a range of frames of recordings of one rig; returns what they say of it, which is also written to `out`.

    Besides the keys of `slam.calibration.SavedCalibration` it has ``recordings``, what each says alone; ``apart``, by
    how many standard deviations two differ at most in each parameter (null for a single recording); ``usual``, how far
    good calibrations are off in each; ``agreement`` and ``judgement``, how good the calibration was, in words;
    ``worth_correcting``, whether correcting is expected to help; and ``warnings``. `inputs` are never replaced. Raises
    SlamError on bad input, before anything is run.
    """
    rig = sequences[0].rig
    for sequence in sequences:
        if is_live(sequence):
            raise ConfigurationError(f"{sequence.name}: a recording is needed, not a camera")
        if difference := rig_difference(rig_numbers(rig), rig_numbers(sequence.rig)):
            raise CalibrationError(f"{sequence.name}: not the rig of {sequences[0].name}: {difference}")
    require_outputs([Output(out, "--out")], inputs, overwrite)
    configs = [
        SystemConfig.for_kind(sequence.kind, _FRONTEND).with_settings(["objects.mode=off", *settings])
        for sequence in sequences
    ]
    if not all(config.self_calibration.enabled for config in configs):
        raise ConfigurationError("slam calibrate needs self_calibration.enabled=true")
    recordings, evidence = zip(*(_run(*each, frames, on_frame) for each in zip(sequences, configs)))
    model, known = RigModel(rig), [one for one in evidence if one is not None]
    prior = factory_prior(model)
    kept = joint_calibration(model, prior, known)
    apart = agreement(model, known)
    pairs, unsolved = (sum(one[key] for one in recordings) for key in ("pairs", "unsolved_pairs"))
    warning, judgement, worth = "", "", False
    doubt = next((f"{one['sequence']}: {one['doubt']}" for one in recordings if one["doubt"]), "")
    if unsolved > pairs:
        warning = (
            f"{unsolved} of {pairs + unsolved} pairs of views agree on no motion: is the calibration of these cameras, "
            "and of images of this size?"
        )
    elif not pairs:  # rows alone say little
        warning = _NO_PAIRS
    elif doubt:  # what is held back by what good calibrations are off by is no correction
        warning = doubt
    else:
        matched = float(np.median([one["matched"] for one in recordings]))
        judgement, worth = _judged(model, kept.posterior, configs[0].models.pixel_sigma, matched, apart)
    found = kept.to_json() | {
        "recordings": recordings,
        "usual": np.sqrt(np.diag(prior.covariances[-1])).tolist(),
        "apart": None if apart is None else apart.tolist(),
        "agreement": None if apart is None else agreement_in_words(apart),
        "judgement": judgement,
        "worth_correcting": worth,
        "warnings": [warning] if warning else [],
    }
    write_json(out, found)
    return found


def _run(
    sequence: StereoSequence, config: SystemConfig, frames: tuple[int, int | None], on_frame: OnFrame
) -> tuple[dict[str, Any], RigEvidence | None]:
    """What one recording says alone, and its evidence without any prior; None where no motion was seen."""
    system = StereoSlam(sequence.rig, _FRONTEND, _BACKEND, config=config)
    matched = []
    for _, result in system.run(sequence.frames(*frames)):
        on_frame(result)
        matched.append(len(result.matched))
    own, evidence = system.calibration, system.calibration.evidence()
    found = {
        "sequence": sequence.name,
        "frames": len(matched),
        "matched": float(np.median(matched)) if matched else 0.0,  # landmarks found again in a frame
        "left_out": evidence is None,
        "pairs": own.pairs,
        "unsolved_pairs": own.unsolved,
        "doubt": own.doubt,
    }
    return found | own.kept().posterior.to_json(), evidence


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
        f"The calibration is off by {off[0]:.2f} ± {sigma[0]:.2f} px in disparity and {off[1]:.2f} ± "
        f"{sigma[1]:.2f} px in rows (RMS over the image), so that at {_AWAY:g} baselines depths are "
        f"{100 * off[0] * _AWAY / model.focal:.1f} % wrong. {word}"
    )
    return text, worth
