"""One run of a comparison, anywhere: it takes a `Trial` and gives back files, and touches nothing else."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from slam.compare.collect import SERIES_COLUMNS, Collector, Measured
from slam.compare.plan import CLOSED_LOOP, SIMULATED, Trial
from slam.compare.simulated import SimulatedFrontend, WithoutImages
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Frontend
from slam.run.options import RunOptions
from slam.run.recording import load_recording
from slam.run.runner import run, run_recording
from slam.sequences import Sequence, open_sequence
from slam.sequences.faults import said_before
from slam.worlds import WorldSequence

#: Files of a run by name.
Files = dict[str, bytes]

RESULT, TIMING, SERIES, RECORDING = "result.json", "timing.json", "series.csv", "recording.npz"
COMPLETED = "completed"

#: Settings under which a front end has one thread; what it finds does not depend on it.
_ONE_THREAD = {"surf": ["frontend.threads=1"]}

#: Settings without which a run could not be recorded: landmarks that return are no observations.
_RECORDED = ["atlas.give_back=false"]


def run_trial(trial: Trial, recording: bytes | None = None) -> Files:
    """Run a trial on one thread; its files come back, `RESULT` among them.

    Bad input and failures of the estimator that the package knows are an outcome, kept with the frames done so far;
    anything else is a defect of a program and is raised.

    Args:
        trial: what to run.
        recording: for a replay, the measurements of the run that is replayed; a closed loop leaves them as `RECORDING`.
    """
    with TemporaryDirectory(prefix="slam_trial_") as folder, one_thread():
        out = Path(folder)
        measured, outcome = None, COMPLETED
        try:
            measured = _closed_loop(trial, out) if trial.mode == CLOSED_LOOP else _replay(trial, recording, out)
        except SlamError as error:
            outcome = failure(error)
        files = {path.name: path.read_bytes() for path in sorted(out.iterdir()) if path.is_file()}
    return {**files, **result_files(trial, outcome, measured)}


def failure(error: BaseException) -> str:
    """The outcome of a run that an exception ended."""
    return f"failed: {type(error).__name__}: {' '.join(str(error).split())}"


def result_files(trial: Trial, outcome: str, measured: Measured | None = None) -> Files:
    """What the tables are made of; a run that failed has its outcome and no figures."""
    result = {"trial": asdict(trial), "outcome": outcome, "metrics": {} if measured is None else measured.metrics}
    files = {RESULT: _json(result)}
    if measured is not None:
        files[TIMING] = _json(measured.milliseconds)
        files[SERIES] = _table(measured.series)
    return files


def config_of(trial: Trial, sequence: Sequence) -> SystemConfig:
    """All settings of a trial.

    Raises:
        ConfigurationError: a setting is unknown or out of range.
    """
    name = trial.variant.frontend
    first = _ONE_THREAD.get(name, [])
    if name == SIMULATED and isinstance(sequence, WorldSequence):  # the noise of these features is known
        first = [f"models.pixel_sigma={sequence.values['sigma']}"] if sequence.values["sigma"] else []
    settings = [*_RECORDED, *first, *trial.variant.settings]
    return SystemConfig.for_kind(sequence.kind, name, trial.backend).with_settings(settings)


def frontend_of(trial: Trial, sequence: Sequence) -> Frontend | None:
    """The front end as an object where it has no name in the registry; None where it has."""
    if trial.variant.frontend != SIMULATED:
        return None
    if not isinstance(sequence, WorldSequence):
        raise SlamError(f"{sequence.name}: front end {SIMULATED!r} is for synthetic worlds alone")
    return SimulatedFrontend(sequence)


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for linear algebra and images: trials in parallel must not compete, and sums keep their order."""
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))
        cv2.setNumThreads(1)
        stack.callback(cv2.setNumThreads, before)
        yield


def _closed_loop(trial: Trial, out: Path) -> Measured:
    """The system on the sequence; what it gave its back end is recorded."""
    with said_before():
        sequence = open_sequence(trial.source)
    config, frontend = config_of(trial, sequence), frontend_of(trial, sequence)
    record = out / RECORDING
    options = RunOptions(trial.backend, trial.variant.frontend, config, out, trial.start, trial.stop, record)
    collector = Collector(sequence, trial.start)
    shown: Any = sequence if frontend is None else WithoutImages(cast(WorldSequence, sequence))
    summary = run(shown, options, collector.add, frontend=frontend)
    return _measured(collector, out, summary)


def _replay(trial: Trial, recording: bytes | None, out: Path) -> Measured:
    """A back end alone on recorded measurements; raises SlamError where the run to be replayed has left none."""
    if recording is None:
        raise SlamError(f"{trial.source}: the run to be replayed has failed, there are no measurements")
    path = out / RECORDING
    path.write_bytes(recording)
    loaded = load_recording(path)
    path.unlink()
    with said_before():
        sequence = open_sequence(trial.source)
    options = RunOptions(trial.backend, trial.variant.frontend, config_of(trial, sequence), out)
    collector = Collector(sequence, trial.start, score=False)
    return _measured(collector, out, run_recording(loaded, options, collector.add))


def _measured(collector: Collector, out: Path, summary: dict[str, Any]) -> Measured:
    """The figures of a run that has left its files in `out`."""
    if not summary["frames"]:
        raise SlamError("the run has no frame")
    final = Trajectory.read_tum(out / "trajectory_final.txt")
    with (out / "landmarks.csv").open(encoding="utf-8", newline="") as file:
        rows = [(int(row["id"]), float(row["x"]), float(row["y"]), float(row["z"])) for row in csv.DictReader(file)]
    ids, positions = np.array([row[0] for row in rows], np.int64), np.array([row[1:] for row in rows], float)
    return collector.finish(final, ids, positions.reshape(-1, 3), summary)


def _json(tree: Any) -> bytes:
    return (json.dumps(tree, indent=2) + "\n").encode()


def _table(rows: np.ndarray) -> bytes:
    text = io.StringIO()
    np.savetxt(text, rows, "%.9g", ",", header=",".join(SERIES_COLUMNS), comments="")
    return text.getvalue().encode()
