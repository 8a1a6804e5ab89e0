"""All trials of a comparison, each once, in processes of this machine; a sweep that was stopped continues where it was.

A trial's folder is its own checkpoint: ``result.json`` is written last.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, replace
from pathlib import Path

from slam import registry
from slam.compare.plan import CLOSED_LOOP, REPLAY, SIMULATED, Plan, Trial
from slam.compare.trial import RECORDING, Run, config_of, run_trial
from slam.errors import SlamError
from slam.files import noting_inputs, read_object
from slam.geometry.stamps import frame_range
from slam.input.features import Rectification
from slam.outputs import Output, require_outputs
from slam.run.options import versions
from slam.run.run_files import naming_folder, write_json
from slam.sequences import open_sequence

RUNS, SWEEP = "runs", "sweep.json"

#: What a comparison leaves in its folder.
NAMES = (SWEEP, f"{RUNS}/", "runs.csv", "differences.csv", "report.html")

Job = tuple[Trial, Path, Path | None]  # arguments of `run_trial`


def sweep(
    plan: Plan, out: Path, workers: int, on_done: Callable[[Trial], None] | None = None, overwrite: bool = False
) -> list[Run]:
    """Run what is not done yet, and read all runs of the plan, in its order.

    Args:
        plan: what to run.
        out: folder; what an earlier sweep has done in it with the same versions is taken over.
        workers: processes on this machine, of one thread each.
        on_done: called for each trial that ends, or was done before.
        overwrite: whether to run all again, and to replace files that are there.

    Raises:
        SlamError: a worker process ended. What is wrong with the plan or the folder, `check` says before.
    """
    told = on_done or (lambda trial: None)
    with naming_folder(out):
        out.mkdir(parents=True, exist_ok=True)
    write_json(out / SWEEP, {"trials": [asdict(trial) for trial in plan.every]})
    for mode in plan.modes:  # a replay needs the closed loop
        jobs: list[Job] = []
        for trial in plan.trials_of(mode):
            if not overwrite and is_done(plan, trial, out):
                told(trial)
            else:
                jobs.append((trial, out / RUNS / trial.folder, _recording(plan, trial, out)))
        run_jobs(jobs, workers, told)
    return [Run.read(trial, out / RUNS / trial.folder) for trial in plan.every]


def run_jobs(jobs: Sequence[Job], workers: int, told: Callable[[Trial], None]) -> None:
    """`run_trial` on each of these arguments in processes of its own; `told` of each that has ended.

    Raises SlamError where a process dies or none can be started; the trials that have ended are kept.
    """
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(max(1, min(workers, len(jobs))), multiprocessing.get_context("spawn"), _begin_worker)
    try:
        trials = {pool.submit(run_trial, *job): job for job in jobs}
        for future in as_completed(trials):
            trial, folder, _ = trials[future]
            if (error := future.exception()) is not None:
                if isinstance(error, BrokenProcessPool):
                    raise error
                Run.failed(trial, folder, error).keep()
            told(trial)
    except BrokenProcessPool as error:
        raise SlamError(
            "a worker process ended: too little memory, perhaps (see --workers), or a script that lacks "
            '`if __name__ == "__main__":`; trials done so far are kept'
        ) from error
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """Leave interrupts to the parent, end when it is gone, however it went, and do not compete with the others.

    Warnings are kept in a `Run`: here they would name neither recording nor run.
    """
    import cv2

    logging.getLogger("slam").setLevel(logging.ERROR)
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def end_with_parent() -> None:
        if (parent := multiprocessing.parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def check(plan: Plan, out: Path, overwrite: bool = False) -> dict[str, int]:
    """Try every sequence, front end, back end and setting once, and whether the files can be written.

    Returns the number of frames of a run, by sequence. What is wrong with a recording is logged. Raises SlamError where
    something cannot work.
    """
    frames: dict[str, int] = {}
    with noting_inputs() as inputs:
        for trial in plan.trials_of(CLOSED_LOOP):
            if trial.seed:
                continue
            sequence = open_sequence(trial.source, quiet=trial.sequence in frames)
            first, last = frame_range(trial.start, trial.stop, len(sequence))
            frames[trial.sequence] = last - first
            config = config_of(trial, sequence)
            if plan.frontend != SIMULATED:
                registry.create("frontends", plan.frontend, sequence.rig, **config.frontend)
            inside = Rectification(sequence.rig)
            models = inside.models(config.models)
            registry.create("backends", trial.backend, inside.rig, models=models, **config.backend)
    held = read_object(out / SWEEP).get("trials") if (out / SWEEP).is_file() and not overwrite else None
    if isinstance(held, list) and not set(map(json.dumps, held)) <= {json.dumps(asdict(trial)) for trial in plan.every}:
        raise SlamError(f"{out}: holds a comparison of more or other runs; give another --out, or --overwrite")
    require_outputs([Output(out, "--out", NAMES)], inputs, overwrite or isinstance(held, list))
    return frames


def _recording(plan: Plan, trial: Trial, out: Path) -> Path | None:
    """The file that replays take, and the first back end's closed loop leaves for them; None for the other runs."""
    given = replace(trial, backend=plan.backends[0], mode=CLOSED_LOOP)
    needed = plan.replay and (trial.mode == REPLAY or trial == given)
    return out / RUNS / given.folder / RECORDING if needed else None


def is_done(plan: Plan, trial: Trial, out: Path) -> bool:
    """Whether the trial has ended before, with these settings, frames and versions, which no folder's name tells.

    A closed loop that a replay needs, and was run without one, is not done.
    """
    try:
        run = Run.read(trial, out / RUNS / trial.folder)
    except SlamError:
        return False
    recording = _recording(plan, trial, out) if run.completed and trial.mode == CLOSED_LOOP else None
    return run.versions == versions() and (recording is None or recording.is_file())
