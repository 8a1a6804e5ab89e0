"""``slam compare``: run the plan, write tables and report, and say what follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from slam import registry
from slam.compare.plan import CLOSED_LOOP, SIMULATED, Plan, Trial, Variant, is_world, parse_variant
from slam.compare.report import write_report
from slam.compare.sweep import Run, check, is_done, run_jobs, sweep
from slam.compare.tables import caution, groups, most_tests, write_tables
from slam.compare.trial import COMPLETED, RESULT
from slam.config import SystemConfig
from slam.errors import ConfigurationError, UnknownNameError
from slam.files import read_object
from slam.naming import unknown
from slam.runtime.threads import available_cores
from slam.sequences.base import said_before
from slam.settings import require_settable

_MOST_WORKERS = 1024
_TRIED = 15  # frames by which the time of a comparison is told


def variants_of(frontends: Sequence[str], variants: Sequence[str], settings: Sequence[str]) -> tuple[Variant, ...]:
    """Front ends by name and variants by their texts; `settings` hold for all.

    Raises:
        ConfigurationError: a variant is not of its form, or has a setting that users cannot set.
        UnknownNameError: there is no such front end.
    """
    every = [Variant(name, name, tuple(settings)) for name in frontends]
    every += [parse_variant(text, tuple(settings)) for text in variants]
    every = every or [Variant("surf", "surf", tuple(settings))]
    known = [*registry.names("frontends"), SIMULATED]
    for variant in every:
        if variant.frontend not in known and ":" not in variant.frontend:
            raise UnknownNameError(f"{unknown('front end', variant.frontend, known)}; or one of your own: module:Class")
        require_settable(variant.settings, SystemConfig().to_json(), variant.frontend)
    return tuple(every)


def compare(
    plan: Plan,
    out: Path,
    workers: int | None = None,
    quiet: bool = False,
    overwrite: bool = False,
    command: str = "",
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

    if workers is not None and not 1 <= workers <= _MOST_WORKERS:
        wanted = "at least one worker" if workers < 1 else f"at most {_MOST_WORKERS} workers"
        raise ConfigurationError(f"comparison: there must be {wanted}, got {workers}")
    for text in plan.sequences:
        if text in registry.names("backends") and not Path(text).exists():
            names = ",".join([*plan.backends, text])
            raise ConfigurationError(
                f"{text}: a back end, no sequence; several are joined by commas: --backends {names}"
            )
    count = workers or available_cores()
    where = f"{count} at a time on this machine"
    frames = check(plan, out, overwrite)  # before there is a progress bar
    total, done = sum(frames[trial.sequence] for trial in plan.every), 0
    limits = caution(plan.trials if any(map(is_world, plan.sequences)) else 1, most_tests(plan))
    if not quiet:
        left = [trial for trial in plan.every if overwrite or not is_done(trial, out)]
        before = f", {len(plan.every) - len(left)} of them done before" if len(left) < len(plan.every) else ""
        seconds = _seconds(left, frames) if left else None
        about = "" if seconds is None else f": about {seconds / min(count, len(left)):.0f} s, by the first frames"
        print(f"{len(plan.every)} runs{before}, {total} frames in all, {where}{about}")
        if most_tests(plan):
            print(limits or f"{plan.trials} trials are enough for certainty in all figures.", flush=True)
    with said_before(), counting(total, "frames", quiet) as tell:  # `check` has said what opening says

        def ended(trial: Trial) -> None:
            nonlocal done
            done += frames[trial.sequence]
            tell(done)

        runs = sweep(plan, out, count, ended, overwrite)
    every = groups(plan, runs)
    write_tables(every, runs, out)
    report = write_report(plan, every, runs, out, where, command)
    if not quiet:
        print_conclusions(every, limits)
        print(f"{len(runs)} runs, {sum(not run.completed for run in runs)} failed. Report: {report}")
    return runs


def _seconds(left: Sequence[Trial], frames: Mapping[str, int]) -> float | None:
    """How long these runs take one after the other [s], by the first frames of one of each kind; None if one fails."""
    seconds, tried = 0.0, dict[tuple[str, Variant], dict[str, float]]()
    for trial in left:
        kind = trial.sequence, trial.variant
        if kind not in tried:
            with said_before(), TemporaryDirectory(prefix="slam_trial_") as folder:
                stop = trial.start + min(_TRIED, frames[trial.sequence])
                first = replace(trial, seed=0, mode=CLOSED_LOOP, stop=stop)
                run_jobs([(first, Path(folder), None)], 1, lambda trial: None)
                result = read_object(Path(folder) / RESULT)
            if result["outcome"] != COMPLETED:
                return None
            tried[kind] = result["milliseconds"]
        times = tried[kind]
        spent = times.get("total", 0.0)
        if trial.mode != CLOSED_LOOP:  # a replay: without images
            spent -= times.get("read", 0.0) + times.get("extract", 0.0)
        seconds += 1e-3 * frames[trial.sequence] * spent
    return seconds
