"""``slam compare``: run the plan, write tables and report, and say what follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from slam import registry
from slam.commands.run import require_no_recording
from slam.compare.plan import CLOSED_LOOP, Plan, Trial, is_world
from slam.compare.report import write_report
from slam.compare.sweep import check, is_done, run_jobs, sweep
from slam.compare.tables import caution, groups, write_tables
from slam.compare.trial import Run
from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.naming import count as count_of
from slam.runtime.threads import available_cores
from slam.settings import require_settable

_NAMED = 5  # lines on failed and doubted runs, and their warnings, that are printed; the report has all
_TRIED = 15  # frames by which the time of a comparison is told


def compare(
    plan: Plan, out: Path, workers: int | None = None, quiet: bool = False, overwrite: bool = False, command: str = ""
) -> list[Run]:
    """Run a comparison to its end and leave ``report.html``, tables and figures in `out`.

    Args:
        plan: what to run.
        out: folder; a sweep that was stopped in it goes on.
        workers: processes on this machine; None for as many as there are cores.
        quiet: show nothing.
        overwrite: run all again, and replace files that are there.
        command: what was typed, for the report.

    Raises:
        SlamError: bad input; nothing has been run then.
    """
    from slam.commands.display import counting, print_conclusions

    for text in plan.sequences:
        if text in registry.names("backends") and not Path(text).exists():
            names = ",".join([*plan.backends, text])
            hint = f"a back end, no sequence; several are joined by commas: --backends {names}"
            raise ConfigurationError(f"{text}: {hint}")
    require_settable(plan.settings, SystemConfig().to_json(), plan.frontend)
    count = available_cores() if workers is None else workers
    if count < 1:
        raise ConfigurationError(f"comparison: workers must be 1 or more, got {count}")
    require_no_recording(out)
    frames = check(plan, out, overwrite)  # before there is a progress bar
    total, done = sum(frames[trial.sequence] for trial in plan.every), 0
    limits = caution(plan, plan.trials if any(map(is_world, plan.sequences)) else 1)
    if not quiet:
        left = [trial for trial in plan.every if overwrite or not is_done(plan, trial, out)]
        before = f", {len(plan.every) - len(left)} of them done before" if len(left) < len(plan.every) else ""
        seconds = _seconds(left, frames) if left else None
        about = "" if seconds is None else f": about {seconds / min(count, len(left)):.0f} s, by the first frames"
        print(f"{len(plan.every)} runs{before}, {total} frames in all, {count} at a time{about}\n{limits}", flush=True)
    with counting(total, "frames", quiet) as tell:

        def ended(trial: Trial) -> None:
            nonlocal done
            done += frames[trial.sequence]
            tell(done)

        runs = sweep(plan, out, count, ended, overwrite)
    every = groups(plan, runs)
    write_tables(every, runs, out)
    report = write_report(plan, every, runs, out, limits, command)
    if not quiet:
        print_conclusions(every)
        _print_doubts(runs)
        print(f"Runs: {len(runs)}, {sum(not run.completed for run in runs)} failed. Report: {report}")
    return runs


def _print_doubts(runs: Sequence[Run]) -> None:
    """Lines on runs that failed or are doubted, and on their warnings, each once with the runs that it holds for."""
    told: dict[str, list[Run]] = {}
    for run in runs:
        for text in run.said if run.completed else [run.outcome]:
            told.setdefault(f"{run.trial.sequence}: {text}", []).append(run)
    for text, own in list(told.items())[:_NAMED]:
        print(f"{text} ({', '.join(dict.fromkeys(run.trial.backend for run in own))}, {count_of(len(own), 'run')})")


def _seconds(left: Sequence[Trial], frames: Mapping[str, int]) -> float | None:
    """How long these runs take one after the other [s], by the first frames of each sequence; None if a run fails."""
    seconds, tried = 0.0, dict[str, dict[str, float]]()
    for trial in left:
        if trial.sequence not in tried:
            with TemporaryDirectory(prefix="slam_trial_") as folder:
                stop = trial.start + min(_TRIED, frames[trial.sequence])
                first = replace(trial, seed=0, mode=CLOSED_LOOP, stop=stop)
                run_jobs([(first, Path(folder), None)], 1, lambda trial: None)
                run = Run.read(first, Path(folder))
            if not run.completed:
                return None
            tried[trial.sequence] = run.milliseconds
        times = tried[trial.sequence]
        spared = () if trial.mode == CLOSED_LOOP else ("read", "extract")  # a replay has no images
        a_frame = times.get("total", 0.0) - sum(times.get(stage, 0.0) for stage in spared)
        seconds += 1e-3 * frames[trial.sequence] * a_frame
    return seconds
