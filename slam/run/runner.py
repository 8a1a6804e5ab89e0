"""Run a sequence through the system and write the files of `slam.run.run_files`; the algorithm is in `slam.system`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from slam import registry
from slam.atlas.map_io import load_map, save_map
from slam.calibration import load_calibration
from slam.data import FrameResult, FrameStatus, StereoFrame
from slam.errors import SlamError, one_line, text_of
from slam.evaluation.objects import labels_in_images, score_for
from slam.evaluation.summary import with_truth
from slam.files import remove_file
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.input.features import Rectification
from slam.interfaces import Frontend
from slam.outputs import require_outputs
from slam.run.options import RunOptions, origin, versions
from slam.run.outcome import median_depth, motion_doubt, outcome, scale_doubt
from slam.run.recording import RecordedFrame, Recording, save_recording
from slam.run.replay import Replay
from slam.run.run_files import RunFiles, write_json
from slam.run.run_record import RunRecord, live_frames, results_of
from slam.run.schema import schema
from slam.run.until import Until
from slam.run.warm_up import warm_up
from slam.runtime.threads import one_blas_thread
from slam.sequences import Sequence, is_live
from slam.sequences.live import LiveFrames
from slam.system import StereoSlam

logger = logging.getLogger("slam.run")

#: Is shown each step: its images, what came of it, and the system after it.
Watch = Callable[[StereoFrame, FrameResult, StereoSlam], None]


@one_blas_thread
def run(
    sequence: Sequence,
    options: RunOptions,
    on_frame: Callable[[FrameResult], None] | None = None,
    frontend: Frontend | None = None,
    watches: Iterable[Watch] = (),
    until: Until | None = None,
    record: RunRecord | None = None,
) -> dict[str, Any]:
    """Run a sequence; returns the summary that is also written to ``summary.json``.

    The files are completed however the run ends: on an error or an interrupt the frames done so far are kept, the
    summary says how it ended, recording and map are written, and the exception goes on; before the first frame is done
    it leaves no file. Where a file cannot be written the others are; of several errors the first one is raised. Files
    of an earlier run in the folder are replaced. A run in which a new back end took over leaves no recording.

    Args:
        sequence: what to run.
        options: names, settings, folder, range of frames.
        on_frame: called after every frame, for a progress display.
        frontend: used in place of the one that the options name.
        watches: called after every step with its images, its result and the system, to show or to draw it.
        until: ends the run when it is set.
        record: gathers what the run gives, for whom the files are not enough.

    Raises:
        SlamError: bad input; one line says what and where.
    """
    require_outputs(options.outputs, overwrite=True)
    if options.record is not None:
        if options.record.suffix.lower() != ".npz":
            raise SlamError(f"{options.record}: a recording is a file of NumPy's: --record FILE.npz")
        if options.prior_map is not None:
            raise SlamError("a run that starts in a prior map cannot be recorded: the recording would lack the map")
        if options.config.map.monocular:
            raise SlamError("a run with map.monocular cannot be recorded: a recording holds stereo observations alone")
        config = replace(options.config, map=replace(options.config.map, monocular=False))
        options = replace(options, config=config)
    frames, live = sequence.frames(options.start, options.stop), None
    if options.live or is_live(sequence):
        live = LiveFrames(frames, not is_live(sequence), until)
        frames = iter(live)
    if options.mono:
        frames = (replace(frame, right=None) for frame in frames)
    system = StereoSlam(
        sequence.rig,
        frontend or options.frontend,
        options.backend,
        config=options.config,
        prior_map=None if options.prior_map is None else load_map(options.prior_map),
        rig_prior=None if options.calibration is None else load_calibration(options.calibration),
    )
    if live is not None:  # before its clock starts, with its first frame
        warm_up(options.backend if options.backend in registry.ONLINE else registry.ONLINE[0], until=until)
    way = _Run(sequence, options, system, record or RunRecord(), until or Until(), live)
    return way.drive(way.processed(frames, tuple(watches)), on_frame)


@one_blas_thread
def run_recording(
    recording: Recording,
    options: RunOptions,
    on_frame: Callable[[FrameResult], None] | None = None,
    record: RunRecord | None = None,
    until: Until | None = None,
) -> dict[str, Any]:
    """Replay a recording through a back end; leaves the files of a run and returns its summary.

    As `run`, but the `options` need no front end and no range of frames. Raises SlamError on bad input.
    """
    config, inside = options.config, Rectification(recording.rig)
    models = inside.models(config.models)
    backend = registry.create("backends", options.backend, inside.rig, models=models, **config.backend)
    system = Replay(recording, backend, config.association)
    way = _Run(recording, options, system, record or RunRecord(), until or Until())
    return way.drive(system.run(), on_frame)


@dataclass(eq=False)
class _Run:
    """A run on its way: everything that its files are made of."""

    sequence: Sequence | Recording
    options: RunOptions
    system: StereoSlam | Replay
    record: RunRecord
    until: Until
    live: LiveFrames | None = None
    tape: list[RecordedFrame] = field(default_factory=list)
    failures: list[Exception] = field(default_factory=list)  # of the last files

    def processed(self, frames: Iterator[StereoFrame], watches: tuple[Watch, ...]) -> Iterator[tuple[int, FrameResult]]:
        """Each frame's number and what the system did with it.

        A live run's time of reading is one of waiting, and 0.
        """
        system, record, reading = self.system, self.record, dict[int, float]()  # [ms] by number of the frame
        assert isinstance(system, StereoSlam)

        def timed() -> Iterator[StereoFrame]:
            while True:
                start = time.perf_counter()
                frame = next(frames, None)
                if frame is None:
                    return
                reading[frame.index] = 1e3 * (time.perf_counter() - start) if self.live is None else 0.0
                yield frame

        for frame, result in system.run(timed()):
            result.milliseconds["read"] = reading.pop(frame.index)  # type: ignore[index]
            if self.live is not None:
                record.ages.append(self.live.age(frame))
            if frame.right is None:
                record.without_right.append(len(record.statuses))
            record.depths.append(median_depth(result.features, system.rig))
            yield frame.index, result
            for watch in watches:
                watch(frame, result, system)

    def drive(
        self, results: Iterable[tuple[int, FrameResult]], on_frame: Callable[[FrameResult], None] | None
    ) -> dict[str, Any]:
        """Write what each frame gives, and in the end the rest, however it ends; returns the summary.

        Raises:
            SlamError: a file cannot be written; all others are. What stopped the run goes on instead, after warnings.
            Exception: a defect of the program, as it is.
        """
        record, options, score = self.record, self.options, score_for(self.sequence)
        names = {"sequence": self.sequence.name, "format": self.sequence.format}
        names |= {"frontend": options.frontend, "backend": options.backend}
        ended, stopped_by = "completed", None
        every = iter(results)
        first = list(islice(every, 1))  # an error before it is done leaves no file
        with RunFiles(options.out) as files:
            write_json(options.out / "config.json", origin(options) | names)
            self._attempt(write_json, options.out / "schema.json", schema())
            try:
                for number, result in chain(first, every):
                    record.add(number, result)
                    files.write_frame(number, result, self._place(result.loop), self._place(result.refused_loop))
                    if score is not None:
                        score.add(number, result, labels_in_images(self.sequence, number, result.features))
                    if options.record is not None:
                        given = RecordedFrame.of(result, number)
                        if result.status is FrameStatus.STARTED:  # another back end has begun with these landmarks
                            self.tape.clear()
                            given = replace(given, removed=np.intersect1d(given.removed, given.added.ids))
                        self.tape.append(given)
                    if on_frame is not None:
                        on_frame(result)
                    if self.until.is_set():
                        break
            except BaseException as error:
                ended, stopped_by = f"stopped: {_said(error)}", error
                raise
            finally:
                if self.until.is_set() and stopped_by is None and not self._whole():
                    ended = self.until.ended
                summary = names | {"ended": ended} | self._tracking()
                self._write_last(files, summary, score)
                lines = list(dict.fromkeys(map(_said, self.failures)))
                if stopped_by is not None:  # it goes on
                    for line in lines:
                        logger.warning("%s", line)
                elif lines:
                    defects = (error for error in self.failures if not isinstance(error, SlamError))
                    raise next(defects, SlamError("; ".join(lines)))
        return summary

    def _whole(self) -> bool:
        """Whether the last frame was done; a camera has none."""
        sequence, options, numbers = self.sequence, self.options, self.record.numbers
        if is_live(sequence) or not numbers:
            return False
        if isinstance(sequence, Recording):
            return numbers[-1] == sequence.frames[-1].number
        return numbers[-1] == range(len(sequence))[options.start : options.stop][-1]

    def _place(self, step: int | None) -> int | str:
        """The frame whose place was seen again, ``map`` for one of the map that the run started in; empty for none."""
        return "" if step is None else self.record.numbers[step] if step >= 0 else "map"

    def _attempt(self, write: Callable[..., Any], *given: Any) -> Any:
        """What a function gives; where it fails the other files are written all the same."""
        try:
            return write(*given)
        except Exception as error:  # noqa: BLE001 `drive` raises it
            self.failures.append(error)

    def _write_last(self, files: RunFiles, summary: dict[str, Any], score: Any) -> None:
        """Write the files that are made at the end; the summary says how good the run was."""
        system, record, sequence, options = self.system, self.record, self.sequence, self.options
        out, attempt, whole = options.out, self._attempt, isinstance(system, StereoSlam)
        if record.stamps:
            final = attempt(system.trajectory)
            if final is not None:
                attempt(final.write_tum, out / "trajectory_final.txt")
            if pairs := attempt(with_truth, record.trajectory, sequence):
                attempt(pairs[1].write_tum, out / "truth.txt")
            if (estimate := attempt(system.estimate)) is not None:
                attempt(files.write_landmarks, estimate, record.seen, record.last_seen, getattr(system, "atlas", None))
            found = attempt(results_of, sequence, system, record, final or Trajectory.empty(), score)
            summary |= found or {}
            summary["warnings"] += filter(None, [summary.get("truth_doubt")])
        summary["seed"] = getattr(sequence, "values", {}).get("seed", 0)  # nothing else is random
        summary["versions"] = versions()
        attempt(write_json, out / "summary.json", summary)
        if options.record is not None:
            attempt(self._save_recording, options.record)
        if options.save_map is not None and record.stamps and whole:
            attempt(save_map, options.save_map, system)
        if self.failures:
            summary["failures"] = list(map(_said, self.failures))
            attempt(write_json, out / "summary.json", summary)

    def _save_recording(self, path: Path) -> None:
        """Write what was given to the back end of a run; where it was given to more than one, warn instead."""
        sequence, models = self.sequence, self.options.config.models
        if isinstance(self.system, StereoSlam) and self.system.restarted:
            took_over = f"the camera was lost, and a new back end took over in frame {self.system.restarted[0]}"
            logger.warning("%s: not written: %s; what is recorded is for one", path, took_over)
            remove_file(path)  # of an earlier run
            return
        truth, noise = sequence.ground_truth, getattr(sequence, "truth_noise", TruthNoise())
        given = sequence.name, sequence.rig, models, tuple(self.tape), truth, noise
        save_recording(Recording(*given, kind=sequence.kind), path)

    def _tracking(self) -> dict[str, Any]:
        """The part of the summary on the tracking, which is known of every run."""
        options, record, rig = self.options, self.record, self.sequence.rig
        warnings, driving = getattr(self.system, "warnings", ()), options.kind == "driving"
        no_path = scale_doubt(record, rig, driving)
        doubt = no_path or motion_doubt(record, options.config.models.motion, driving)
        dropped, recorded = self.live.dropped if self.live else 0, isinstance(self.sequence, Recording)
        certain = getattr(self.system, "doubt", "")
        causes = [certain, *warnings] if certain else warnings
        tracking = outcome(record, rig, options, causes, dropped, doubt, recorded)
        if doubt and not tracking:
            logger.warning("%s", doubt)
        if isinstance(self.system, StereoSlam) and not self.system.doubt and self.system.calibration.warning:
            logger.warning("%s", self.system.calibration.warning)
        return {
            "frames": len(record.numbers),
            "status": {name: record.statuses.count(name) for name in sorted(set(record.statuses))},
            "tracking": tracking,
            "doubt": certain or no_path,
            "warnings": [*self.sequence.warnings, *warnings, *([doubt] if doubt else [])],
            **({} if self.live is None else {"live": live_frames(self.live, record)}),
        }


def _said(error: BaseException) -> str:
    return one_line(text_of(error)) or type(error).__name__
