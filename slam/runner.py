"""Run a sequence through the system and leave the files of `slam.outputs`; the algorithm itself is in `slam.system`."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from slam.config import SystemConfig
from slam.data import FrameResult, StereoFrame
from slam.errors import SlamError
from slam.evaluation import consistency, evaluate
from slam.outputs import STAGES, RunFiles
from slam.se3 import Array
from slam.sequences import Sequence
from slam.system import StereoSlam
from slam.trajectory import Trajectory

_PACKAGES = ("surf-stereo-slam", "numpy", "scipy", "numba", "gtsam", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to leave the files.

    Attributes:
        backend, frontend: names.
        config: all settings.
        out: folder for the files.
        start, stop: range of frames; `stop` None for all.
    """

    backend: str
    frontend: str
    config: SystemConfig
    out: Path
    start: int = 0
    stop: int | None = None


@dataclass
class RunRecord:
    """What a run has gathered so far: the online path, frame by frame."""

    numbers: list[int] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    milliseconds: list[dict[str, float]] = field(default_factory=list)
    rejected: int = 0
    used: int = 0
    nis: float = 0.0
    nis_dof: int = 0

    def add(self, number: int, result: FrameResult) -> None:
        """Take in one frame, `number` in its sequence."""
        self.numbers.append(number)
        self.stamps.append(result.estimate.stamp)
        self.poses.append(result.estimate.T_world_left)
        self.covariances.append(result.estimate.covariance)
        self.statuses.append(result.status.value)
        self.milliseconds.append(dict(result.milliseconds))
        self.rejected += len(result.report.rejected)
        self.used += len(result.report.used)
        if result.report.dof:
            self.nis += result.report.nis
            self.nis_dof += result.report.dof

    @property
    def trajectory(self) -> Trajectory:
        """The online path."""
        return Trajectory(np.array(self.stamps), np.array(self.poses).reshape(-1, 4, 4))


def run(
    sequence: Sequence, options: RunOptions, on_frame: Callable[[FrameResult], None] | None = None
) -> dict[str, Any]:
    """Run a sequence; returns the summary that is also written to ``summary.json``.

    The files are completed however the run ends: on an error or an interrupt the frames done so far are kept, the
    summary says how it ended, and the exception goes on.

    Args:
        sequence: what to run.
        options: names, settings, folder, range of frames.
        on_frame: called after every frame, for a progress display.

    Raises:
        SlamError: bad input; one line says what and where.
    """
    frames = sequence.frames(options.start, options.stop)
    system = StereoSlam(sequence.rig, options.frontend, options.backend, config=options.config)
    record = RunRecord()
    ended = "completed"
    with RunFiles(options.out) as files:
        files.write_json("config.json", _config_tree(sequence, options))
        began = time.perf_counter()
        try:
            for frame, elapsed in _timed(frames):
                result = system.process(frame)
                result.milliseconds["read"] = elapsed  # type: ignore[index]
                record.add(frame.index, result)
                files.write_frame(frame.index, result)
                if on_frame is not None:
                    on_frame(result)
        except BaseException as error:
            ended = f"stopped: {error or type(error).__name__}"
            raise
        finally:
            seconds = time.perf_counter() - began
            summary = _finish(sequence, options, system, record, files, ended, seconds)
    return summary


def _timed(frames: Iterator[StereoFrame]) -> Iterator[tuple[StereoFrame, float]]:
    """Frames with the wall time that reading each took [ms]."""
    while True:
        start = time.perf_counter()
        frame = next(frames, None)
        if frame is None:
            return
        yield frame, 1e3 * (time.perf_counter() - start)


def _finish(
    sequence: Sequence,
    options: RunOptions,
    system: StereoSlam,
    record: RunRecord,
    files: RunFiles,
    ended: str,
    seconds: float,
) -> dict[str, Any]:
    """Write the last files and return the summary."""
    summary: dict[str, Any] = {
        "sequence": sequence.name,
        "format": sequence.format,
        "frontend": options.frontend,
        "backend": options.backend,
        "ended": ended,
        "frames": len(record.stamps),
        "status": {name: record.statuses.count(name) for name in sorted(set(record.statuses))},
        "warnings": list(sequence.warnings),
    }
    if record.stamps:
        final = system.trajectory()
        files.write_final(final, system.estimate(), system.landmarks, record.numbers)
        summary["path_length_m"] = record.trajectory.length
        summary["landmarks"] = 0 if system.landmarks is None else len(system.landmarks)
        summary["observations"] = {"used": record.used, "rejected": record.rejected}
        summary["accuracy"] = {
            "online": evaluate(record.trajectory, sequence),
            "final": evaluate(final, sequence),
        }
        summary["consistency"] = {
            "NIS per degree of freedom": record.nis / record.nis_dof if record.nis_dof else None,
            **consistency(record.trajectory, np.array(record.covariances), sequence),
        }
        summary["disparity_offset_px"] = {"mean": system.calibration.offset, "sigma": system.calibration.sigma}
        summary["milliseconds"] = _timings(record)
        summary["frames_per_second"] = len(record.stamps) / seconds if seconds > 0 else None
    summary["seed"] = getattr(sequence, "values", {}).get("seed", 0)  # a world's; nothing else is random
    summary["configuration"] = options.config.to_json()
    summary["versions"] = versions()
    files.write_json("summary.json", summary)
    return summary


def _timings(record: RunRecord) -> dict[str, Any]:
    """Median per stage over all frames but the first, and the first frame's total [ms]."""
    totals = [sum(m.values()) for m in record.milliseconds]
    later = record.milliseconds[1:] or record.milliseconds
    median = {stage: float(np.median([m.get(stage, 0.0) for m in later])) for stage in STAGES}
    return {"median": median, "median_total": float(np.median(totals[1:] or totals)), "first_frame": totals[0]}


def _config_tree(sequence: Sequence, options: RunOptions) -> dict[str, Any]:
    return {
        "sequence": sequence.name,
        "format": sequence.format,
        "frontend": options.frontend,
        "backend": options.backend,
        "frames": [options.start, options.stop],
        "settings": options.config.to_json(),
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that shape a result."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def parse_frames(text: str | None) -> tuple[int, int | None]:
    """``A:B`` (either may be left out) as a range of frames.

    Raises:
        SlamError: not of that form.
    """
    if text is None:
        return 0, None
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return int(first or 0), int(last) if last else None
    except ValueError:
        raise SlamError(f"frames {text!r} is not of the form A:B") from None
