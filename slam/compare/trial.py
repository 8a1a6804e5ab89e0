"""One run of a comparison: it takes a `Trial` and leaves files in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare.plan import CLOSED_LOOP, SIMULATED, Trial
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures, StereoFrame
from slam.errors import SlamError, text_of
from slam.evaluation.association_truth import SurfacePoints
from slam.evaluation.summary import with_truth
from slam.files import remove_file
from slam.geometry.se3 import Array, nearest_rotation
from slam.geometry.stamps import frame_range, pair
from slam.run.options import RunOptions, versions
from slam.run.outputs import naming_folder, write_json
from slam.run.recording import load_recording
from slam.run.results import figures
from slam.run.run_data import RunData
from slam.run.runner import run, run_recording
from slam.run.summary import RunRecord
from slam.sequences import Sequence as StereoSequence
from slam.sequences import open_sequence
from slam.worlds import WorldSequence

RESULT, RECORDING = "result.json", "recording.npz"
COMPLETED = "completed"

_RIGHT = 3.0  # a feature so near to its landmark's true place is rightly associated [px]
_SAME = 1e-6  # stamps of one frame, one of them from a file, differ by less [s]


# ---------------------------------------------------------------------------------------------------- running it


def run_trial(trial: Trial, folder: Path, recording: Path | None = None) -> None:
    """Run a trial; its files are left in `folder`, `RESULT` last: what is there then is whole.

    Bad input, failures of the estimator and defects of a program are an outcome, kept with the frames done so far. A
    replay takes the measurements of `recording`; a closed loop leaves its own there, if it is to.
    """
    own = recording if trial.mode == CLOSED_LOOP else None
    for path in filter(None, (folder / RESULT, own)):
        remove_file(path)
    try:
        keep_result(trial, folder, COMPLETED, *_run(trial, recording, folder))
    except Exception as error:  # noqa: BLE001 (not every exception gets from a worker to the parent)
        if own is not None:
            remove_file(own)  # of half a run
        keep_result(trial, folder, error)


def keep_result(
    trial: Trial,
    folder: Path,
    outcome: str | BaseException,
    metrics: Mapping[str, float] | None = None,
    milliseconds: Mapping[str, float] | None = None,
    said: Sequence[str] = (),
) -> None:
    """Write how a trial ended, also where an exception ended it, and its figures; one that is no number is none."""
    if isinstance(outcome, BaseException):
        outcome = f"failed: {type(outcome).__name__}: {' '.join(text_of(outcome).split())}"
    known = {key: value for key, value in (metrics or {}).items() if np.isfinite(value)}
    found = {"completed": float(outcome == COMPLETED), **known}
    with naming_folder(folder):
        folder.mkdir(parents=True, exist_ok=True)
    result = {"trial": asdict(trial), "versions": versions(), "outcome": outcome, "metrics": found}
    write_json(folder / RESULT, result | {"milliseconds": milliseconds or {}, "said": list(said)})


def config_of(trial: Trial, sequence: StereoSequence) -> SystemConfig:
    """All settings of a trial; raises ConfigurationError: a setting is unknown or out of range."""
    name, first = trial.frontend, list[str]()
    if name == "surf":
        first = ["frontend.threads=1"]  # what it finds does not depend on it
    if name == SIMULATED and isinstance(sequence, WorldSequence) and sequence.values["sigma"]:
        # the noise of these features is known
        first = [f"models.pixel_sigma={sequence.values['sigma']}", "models.slide.density=0"]
    return SystemConfig.for_kind(sequence.kind, name).with_settings([*first, *trial.settings])


class _Simulated:
    """A world's recording without images, and the front end that takes features straight from the world's landmarks.

    They have the world's noise, misses and outliers. All else is that of the recording.
    """

    def __init__(self, world: WorldSequence) -> None:
        self._world = world

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def __len__(self) -> int:
        return len(self._world)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Numbers and stamps of frames; their images are one black pixel."""
        for k in range(*frame_range(start, stop, len(self))):
            yield StereoFrame(k, float(self._world.stamps[k]), np.zeros((1, 1), np.uint8), None)

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """Features of the frame of this number; its images are not looked at."""
        return self._world.observations(frame.index)


def _run(trial: Trial, recording: Path | None, out: Path) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """The whole system on the sequence, or a back end alone on recorded measurements.

    Returns figures, median times of stages [ms], and what is said of the run: likely cause, doubt and warnings.
    """
    closed, record = trial.mode == CLOSED_LOOP, RunRecord()
    if not closed and (recording is None or not recording.is_file()):
        why = "the run to be replayed failed, or lost its camera and began again"
        raise SlamError(f"{trial.source}: {why}: there are no measurements of one back end")
    sequence = open_sequence(trial.source, quiet=True)  # `slam.compare.sweep.check` has said what it says
    opening = list(sequence.warnings)
    collected = MapRecord(sequence, trial.start, closed)
    config = config_of(trial, sequence)
    options = RunOptions(trial.backend, trial.frontend, config, out, kind=sequence.kind)
    if not closed and recording is not None:
        summary = run_recording(load_recording(recording), options, collected.add, record)
    else:
        simulated = _Simulated(sequence) if trial.frontend == SIMULATED else None  # type: ignore[arg-type]
        options = replace(options, start=trial.start, stop=trial.stop, record=recording)
        summary = run(sequence if simulated is None else simulated, options, collected.add, simulated, record=record)
    if not summary["frames"]:
        raise SlamError("the run has no frame")
    times = summary.get("milliseconds", {"median": {}})
    milliseconds = {stage: value for stage, value in times["median"].items() if value}
    milliseconds |= {"total": times["median_total"]} if milliseconds else {}
    said = [text for text in (summary["tracking"], summary["doubt"]) if text]
    said += [text for text in summary["warnings"] if text not in opening]
    alone = [text for at, text in enumerate(said) if not any(text in before for before in said[:at])]
    return figures(summary) | collected.figures(record, out), milliseconds, alone


# --------------------------------------------------------------------------------- what only a comparison measures


class MapRecord:
    """Associations and landmarks against a world's surfaces, and the size of the map.

    `start` is the number of the first frame. Associations of a replay are the same for all, and need no check.
    """

    def __init__(self, sequence: StereoSequence, start: int = 0, associations: bool = True) -> None:
        self._sequence, self._start, self._associations = sequence, start, associations
        self._truth = SurfacePoints(sequence) if sequence.format == "synthetic" else None
        self._sizes: list[int] = []
        self._right: list[bool] = []

    def add(self, result: FrameResult) -> None:
        """One more frame."""
        if self._truth is not None:
            right = self._truth.of_matches(self._start + result.index, result) < _RIGHT
            self._right += right.tolist() if self._associations else []
        self._sizes.append(result.map_size)

    def figures(self, record: RunRecord, out: Path) -> dict[str, float]:
        """The figures of a run that is finished and has left its files in `out`."""
        found = {"map_size": np.mean(self._sizes)}
        if self._right:
            found["association_precision"] = np.mean(self._right)
        if self._truth is not None and len(errors := self._landmark_errors(self._truth, record, out)):
            found["landmark_error_m"] = np.median(errors)
        return {key: float(value) for key, value in found.items()}

    def _landmark_errors(self, truth: SurfacePoints, record: RunRecord, out: Path) -> Array:
        """Distances of the map's landmarks from the surface points they are, after the alignment of the poses.

        They are turned by the poses' orientations: positions of a camera that hardly moves leave the turn open, which
        moves what is far away.
        """
        run, tracked = RunData.read(out, ""), record.trajectory.select(np.array(record.measured, bool))
        pairs = with_truth(run.final.select(pair(run.final.stamps, tracked.stamps, _SAME) >= 0), self._sequence)
        if pairs is None:
            return np.zeros(0)
        own, true = pairs
        R = nearest_rotation((true.poses[:, :3, :3] @ np.swapaxes(own.poses[:, :3, :3], 1, 2)).mean(axis=0))
        t = (true.positions - own.positions @ R.T).mean(axis=0)
        errors = np.linalg.norm(run.positions @ R.T + t - truth.positions(run.ids), axis=1)
        return np.asarray(errors[np.isfinite(errors)])
