"""All trials of a comparison, each once, in processes of this machine; a sweep that was stopped continues where it was.

A trial's folder is its own checkpoint: ``result.json`` is written last.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from slam import registry
from slam.compare.plan import CLOSED_LOOP, REPLAY, SIMULATED, Plan, Trial
from slam.compare.trial import COMPLETED, RECORDING, RESULT, config_of, keep_result, run_trial
from slam.errors import SlamError
from slam.files import noting_inputs, read_object
from slam.input.features import Rectification
from slam.outputs import Output, require_outputs
from slam.run.outputs import naming_folder, write_json
from slam.run.repeat import changed_versions, running_code
from slam.sequences import open_sequence
from slam.sequences.base import said_before

RUNS, SWEEP = "runs", "sweep.json"

#: What a comparison leaves in its folder.
NAMES = (SWEEP, f"{RUNS}/", "runs.csv", "differences.csv", "report.html")

#: Outcome of a trial whose process died, and died again where it was run alone.
KILLED = "failed: its process was killed: too little memory, perhaps"

_Job = tuple[Trial, Path, Path | None]  # arguments of `run_trial`


@dataclass(frozen=True)
class Run:
    """A trial that has ended."""

    trial: Trial
    outcome: str  # ``"completed"``, or ``"failed: …"`` with the reason
    metrics: dict[str, float]  # figures by key of `slam.run.results.METRICS`; none where it failed
    milliseconds: dict[str, float]  # median per stage
    folder: Path  # its files

    @property
    def completed(self) -> bool:
        """Whether it came to its end."""
        return self.outcome == COMPLETED


def sweep(
    plan: Plan, out: Path, workers: int, on_done: Callable[[Trial], None] | None = None, overwrite: bool = False
) -> list[Run]:
    """Run what is not done yet, and read all runs of the plan, in its order.

    Where a worker process dies, the trials in work are run once more, one by one, each in a process of its own; one
    whose process dies again has failed.

    Args:
        plan: what to run.
        out: folder; one of an earlier sweep with the same versions is gone on with.
        workers: processes on this machine, of one thread each.
        on_done: called for each trial that ends, or was done before.
        overwrite: whether to run all again, and to replace files that are there.

    Raises:
        SlamError: a sequence, name or setting is bad (nothing is run then), the folder holds something else, or no
            worker process can be started.
    """
    check(plan, out, overwrite)
    told = on_done or (lambda trial: None)
    with naming_folder(out):
        out.mkdir(parents=True, exist_ok=True)
    write_json(out / SWEEP, {"trials": [asdict(trial) for trial in plan.every], "versions": running_code()})
    for mode in plan.modes:  # a replay needs the closed loop
        left = []
        for trial in plan.trials_of(mode):
            if overwrite or not is_done(trial, out):
                left.append(trial)
            else:
                told(trial)
        _run_all(left, plan.backends[0], out, workers, told)
    return [read_run(trial, out) for trial in plan.every]


def _run_all(trials: Sequence[Trial], first: str, out: Path, workers: int, told: Callable[[Trial], None]) -> None:
    """Run trials in processes; `first` is the back end that is replayed."""

    def job(trial: Trial) -> _Job:
        recording = None
        if trial.mode == REPLAY:
            given = read_run(replace(trial, backend=first, mode=CLOSED_LOOP), out)
            recording = given.folder / RECORDING if given.completed else None
        return trial, out / RUNS / trial.folder, recording

    jobs = deque(map(job, trials))
    while jobs:
        for lost in _run_in_pool(jobs, workers, told):
            run_alone(*lost)
            told(lost[0])


def _run_in_pool(jobs: deque[_Job], workers: int, told: Callable[[Trial], None]) -> list[_Job]:
    """Run jobs, taken from `jobs`, until none is left or a process dies; returns those that were in work then."""
    running: dict[Future[None], _Job] = {}
    lost: list[_Job] = []
    with _processes(min(workers, len(jobs))) as pool:
        while running or (jobs and not lost):
            with suppress(BrokenProcessPool):  # those in work tell it
                while jobs and len(running) < workers:
                    running[pool.submit(run_trial, *jobs[0])] = jobs[0]
                    jobs.popleft()
            if not running:  # a process died that had no work
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, error = running.pop(future), future.exception()
                if isinstance(error, BrokenProcessPool):
                    lost.append(job)
                    continue
                if error is not None:
                    keep_result(job[0], job[1], error)
                told(job[0])
    return lost


def run_alone(trial: Trial, folder: Path, recording: Path | None = None) -> None:
    """`run_trial` in a process of its own; where that dies, the trial is kept as failed.

    Raises SlamError where no process can be started.
    """
    with _processes(1) as pool:
        try:
            pool.submit(int).result()
        except BrokenProcessPool as error:
            raise SlamError(
                'no worker process can be started: a script must call this below `if __name__ == "__main__":`'
            ) from error
        failure = pool.submit(run_trial, trial, folder, recording).exception()
    if failure is not None:
        keep_result(trial, folder, KILLED if isinstance(failure, BrokenProcessPool) else failure)


@contextmanager
def _processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """Worker processes, which end with this context however it ends."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _begin_worker)
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """Leave interrupts to the parent, end when it is gone, however it went, and do not compete with the others."""
    import cv2

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

    Returns the number of frames of a run, by sequence. Raises SlamError where something cannot work.
    """
    frames: dict[str, int] = {}
    with noting_inputs() as inputs:
        for trial in plan.trials_of(CLOSED_LOOP):
            if trial.seed:
                continue
            with said_before() if trial.sequence in frames else nullcontext():
                sequence = open_sequence(trial.source)
            frames[trial.sequence] = len(range(len(sequence))[trial.start : trial.stop])
            config = config_of(trial, sequence)
            if trial.variant.frontend != SIMULATED:
                registry.create("frontends", trial.variant.frontend, sequence.rig, **config.frontend)
            inside = Rectification(sequence.rig)
            models = inside.models(config.models)
            registry.create("backends", trial.backend, inside.rig, models=models, **config.backend)
    goes_on = not overwrite and (out / SWEEP).is_file()
    if goes_on:
        held = read_object(out / SWEEP)
        before, trials = held.get("versions"), held.get("trials")
        if not isinstance(before, dict) or not isinstance(trials, list):
            raise SlamError(f"{out / SWEEP}: not that of a comparison")
        changed = changed_versions(dict.fromkeys(running_code(), "unknown") | before, running_code())
        if changed:
            raise SlamError(f"{out}: begun with {changed[0]}: runs cannot be compared; give another --out")
        if not set(map(json.dumps, trials)) <= {json.dumps(asdict(trial)) for trial in plan.every}:
            raise SlamError(f"{out}: holds a comparison of more or other runs; give another --out, or --overwrite")
    require_outputs([Output(out, "--out", NAMES)], inputs, overwrite or goes_on)
    return frames


def read_run(trial: Trial, out: Path) -> Run:
    """A trial's outcome from its folder; raises SlamError where it is not there, or cannot be read."""
    folder = out / RUNS / trial.folder
    result = read_object(folder / RESULT)
    if not isinstance(result.get("outcome"), str):
        raise SlamError(f"{folder / RESULT}: does not say how the run ended")
    trees: list[Any] = [result.get("metrics"), result.get("milliseconds")]
    try:
        metrics, milliseconds = ({name: float(value) for name, value in tree.items()} for tree in trees)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise SlamError(f"{folder / RESULT}: its figures are no numbers by name") from error
    return Run(trial, result["outcome"], metrics, milliseconds, folder)


def is_done(trial: Trial, out: Path) -> bool:
    """Whether the trial has ended before; raises SlamError where its folder holds one with other settings."""
    path = out / RUNS / trial.folder / RESULT
    try:
        before = read_object(path).get("trial") if path.exists() else None
    except SlamError:
        return False
    if before is not None and before != json.loads(json.dumps(asdict(trial))):
        raise SlamError(f"{path.parent}: holds a run with other settings; give another --out")
    return before is not None
