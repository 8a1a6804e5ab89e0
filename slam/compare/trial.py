"""One run of a comparison: it takes a `Trial`, and leaves a `Run` and its files in a folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare.plan import CLOSED_LOOP, SIMULATED, Trial
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures, StereoFrame
from slam.errors import SlamError, text_of
from slam.evaluation.association_truth import SurfacePoints
from slam.evaluation.summary import with_truth
from slam.files import read_object, remove_file
from slam.geometry.se3 import Array, nearest_rotation
from slam.geometry.stamps import frame_range, pair
from slam.run.options import RunOptions, versions
from slam.run.recording import load_recording
from slam.run.results import DOUBTED, figures
from slam.run.run_data import RunData
from slam.run.run_files import naming_folder, write_json
from slam.run.run_record import RunRecord
from slam.run.runner import run as run_sequence
from slam.run.runner import run_recording
from slam.sequences import Sequence as StereoSequence
from slam.sequences import open_sequence
from slam.worlds import WorldSequence

RESULT, RECORDING = "result.json", "recording.npz"
COMPLETED = "completed"

_RIGHT = 3.0  # a feature so near to its landmark's true place is rightly associated [px]
_SAME = 1e-6  # stamps of one frame, one of them from a file, differ by less [s]


@dataclass(frozen=True)
class Run:
    """A trial that has ended, as it is kept in its folder."""

    trial: Trial
    outcome: str  # `COMPLETED`, or ``"failed: …"`` with the reason
    metrics: dict[str, float]  # figures by key of `slam.run.results.METRICS`; none where it failed
    milliseconds: dict[str, float]  # median per stage
    folder: Path  # its files
    said: tuple[str, ...] = ()  # likely cause of lost frames, doubt, warnings
    versions: dict[str, str] = field(default_factory=versions)  # by which it was run

    @property
    def completed(self) -> bool:
        """Whether it came to its end."""
        return self.outcome == COMPLETED

    @property
    def trusted(self) -> bool:
        """Whether it came to its end, and its path is not doubted."""
        return self.completed and not self.metrics.get(DOUBTED)

    @classmethod
    def failed(cls, trial: Trial, folder: Path, error: BaseException) -> Run:
        """One that an exception ended."""
        return cls(trial, f"failed: {type(error).__name__}: {' '.join(text_of(error).split())}", {}, {}, folder)

    def keep(self) -> None:
        """Write `RESULT`; a figure that is no number is none."""
        known = {key: value for key, value in self.metrics.items() if np.isfinite(value)}
        with naming_folder(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        found = asdict(self) | {"metrics": {"completed": float(self.completed), **known}}
        write_json(self.folder / RESULT, {name: value for name, value in found.items() if name != "folder"})

    @classmethod
    def read(cls, trial: Trial, folder: Path) -> Run:
        """What `keep` wrote; raises SlamError where it is not there, cannot be read, or is of another trial."""
        found = read_object(folder / RESULT)
        if found.get("trial") != json.loads(json.dumps(asdict(trial))):  # of other settings or frames
            raise SlamError(f"{folder / RESULT}: of another trial")
        try:
            metrics, milliseconds = (
                {name: float(value) for name, value in found[key].items()} for key in ("metrics", "milliseconds")
            )
            said, by = tuple(map(str, found["said"])), dict(found["versions"])
            return cls(trial, str(found["outcome"]), metrics, milliseconds, folder, said, by)
        except (KeyError, AttributeError, TypeError, ValueError, OverflowError) as error:
            raise SlamError(f"{folder / RESULT}: does not say how the run ended: {error!r}") from error


def run_trial(trial: Trial, folder: Path, recording: Path | None = None) -> None:
    """Run a trial; its files are left in `folder`, `RESULT` last: what is there then is whole.

    Bad input, failures of the estimator and defects of a program are an outcome, kept with the frames done so far. A
    replay takes the measurements of `recording`; a closed loop leaves its own there, if it is to.
    """
    own = recording if trial.mode == CLOSED_LOOP else None
    for path in filter(None, (folder / RESULT, own)):
        remove_file(path)
    try:
        run = _run(trial, recording, folder)
    except Exception as error:  # noqa: BLE001 (not every exception gets from a worker to the parent)
        if own is not None:
            remove_file(own)  # of half a run
        run = Run.failed(trial, folder, error)
    run.keep()


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


def _run(trial: Trial, recording: Path | None, out: Path) -> Run:
    """The whole system on the sequence, or a back end alone on recorded measurements."""
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
        summary = run_sequence(
            sequence if simulated is None else simulated, options, collected.add, simulated, record=record
        )
    if not summary["frames"]:
        raise SlamError("the run has no frame")
    times = summary.get("milliseconds", {"median": {}})
    milliseconds = {stage: value for stage, value in times["median"].items() if value}
    milliseconds |= {"total": times["median_total"]} if milliseconds else {}
    said = [text for text in (summary["tracking"], summary["doubt"]) if text]
    said += [text for text in summary["warnings"] if text not in opening]
    alone = tuple(text for at, text in enumerate(said) if not any(text in before for before in said[:at]))
    metrics = figures(summary) | collected.figures(record, out)
    return Run(trial, COMPLETED, metrics, milliseconds, out, alone)


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
