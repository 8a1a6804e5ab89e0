"""``slam run`` and ``replay``: what the command line asks for, the folder of a run, and how it ends."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import typer

from slam.calibration import load_calibration
from slam.commands.display import print_summary, progress
from slam.commands.ending import ended_by_signals
from slam.config import SystemConfig
from slam.errors import ConfigurationError, SlamError
from slam.files import note_input, noting_inputs
from slam.outputs import Output, require_outputs
from slam.run import drawing
from slam.run import viewer as viewing
from slam.run.options import RunOptions, parse_frames
from slam.run.plots import leave_picture
from slam.run.recording import Recording, load_recording
from slam.run.run_record import RunRecord
from slam.run.runner import run, run_recording
from slam.run.warm_up import compile_kernels
from slam.sequences import Sequence as StereoSequence
from slam.sequences import format_of, is_live, open_sequence
from slam.sequences.folders import VIDEO_SUFFIXES
from slam.sequences.images import IMAGE_SUFFIXES
from slam.settings import require_settable

_BACKEND, _FRONTEND = "ekf", "surf"
RESULTS = Path("results")
_LONGEST = 60  # characters of a sequence's name in a folder's


def run_sequence(
    source: str, out: Path | None, settings: Sequence[str], frames: str | None, format: str | None,
    choices: Mapping[str, Any], *, viewer: str | None, draw: Path | None, picture: bool, overwrite: bool, quiet: bool,
) -> None:  # fmt: skip
    """Run a sequence as the command line asks; `choices` are fields of `RunOptions`, None or False where it is silent.

    Raises SlamError on bad input, and `typer.Exit` as `finish` does.
    """
    with noting_inputs() as inputs:
        opened, options = _prepared(source, settings, frames, format, choices)
    with ExitStack() as stack:
        folder = stack.enter_context(run_folder(out, opened.name, options.backend))
        options = replace(options, out=folder)
        written = [*options.outputs, *([drawing.output(draw)] if draw else []), *viewing.outputs(viewer, "--viewer")]
        require_outputs(written, inputs, overwrite)
        gathered = RunRecord()  # its time of compiling begins here
        total = frame_count(opened, options.start, options.stop)
        tell = stack.enter_context(progress(total, _title(opened, options.backend), quiet))
        if options.config.objects.mode != "off":
            compile_kernels(options.backend, options.frontend)
        watches = []
        if viewer is not None:
            watches.append(stack.enter_context(viewing.Viewer(viewer, opened.rig, opened.ground_truth)).show)
        if draw is not None:
            watches.append(stack.enter_context(drawing.FramePictures(draw)).show)
        live = options.live or is_live(opened)
        if live and not quiet:
            what = "are taken until" if is_live(opened) else "come at their own rate, to the last one or until"
            print(f"slam: loading; then frames {what} Ctrl-C ends the run", file=sys.stderr)
        until = stack.enter_context(ended_by_signals(folder, gathered, live))
        summary = run(opened, options, tell, watches=watches, until=until, record=gathered)
    finish(summary, written, picture, quiet)


def run_recorded(
    recording: Path, out: Path | None, backend: str | None, settings: Sequence[str], picture: bool, overwrite: bool,
    quiet: bool,
) -> None:  # fmt: skip
    """Give a back end what a run has recorded; raises as `run_sequence` does."""
    loaded, name = load_recording(recording), backend or _BACKEND
    default = SystemConfig.for_kind(loaded.kind, None)
    require_settable(settings, default.to_json(), "")
    config = replace(default, models=loaded.models).with_settings(settings)
    gathered = RunRecord()
    with run_folder(out, loaded.name, name) as folder:
        options = RunOptions(name, "recording", config, folder, kind=loaded.kind, command=command_line())
        require_outputs(options.outputs, [recording], overwrite)
        with progress(len(loaded), _title(loaded, name), quiet) as tell, ended_by_signals(folder, gathered) as until:
            summary = run_recording(loaded, options, tell, gathered, until)
    finish(summary, options.outputs, picture, quiet)


def _prepared(
    source: str, settings: Sequence[str], frames: str | None, format: str | None, choices: Mapping[str, Any]
) -> tuple[StereoSequence, RunOptions]:
    """The sequence, opened, and what to do with it; the folder is still to be chosen."""
    said = {name: value for name, value in choices.items() if value}
    options = replace(RunOptions(_BACKEND, _FRONTEND, SystemConfig()), **said)
    opened = open_sequence(source, format=format)
    if options.mono and options.prior_map is None:
        raise ConfigurationError("--mono needs --map FILE: left images alone do not tell how large the world is")
    kind = options.kind or opened.kind
    config = SystemConfig.for_kind(kind, options.frontend)
    require_settable(settings, config.to_json(), options.frontend)
    config = config.with_settings([*(["map.monocular=true"] if options.mono else []), *settings])
    if options.calibration is not None:
        load_calibration(options.calibration)  # what cannot be read is said before anything is written
    if options.prior_map is not None:
        note_input(options.prior_map)
    start, stop = parse_frames(frames)
    return opened, replace(options, config=config, start=start, stop=stop, kind=kind, command=command_line())


def _title(sequence: StereoSequence | Recording, backend: str) -> str:
    """A short name for a progress bar: of a world its name alone."""
    name = sequence.name.partition("?")[0]
    return f"{name if len(name) <= 12 else f'…{name[-11:]}'} · {backend}"


def frame_count(sequence: StereoSequence, start: int, stop: int | None) -> int | None:
    """Number of frames in a range; None for those of a camera without an end."""
    if is_live(sequence):
        return None if stop is None else stop - start
    return len(range(len(sequence))[start:stop])


def finish(summary: dict[str, Any], written: Sequence[Output], picture: bool, quiet: bool) -> None:
    """Leave the picture of a run and print its table, its files, and a line where many frames were not tracked.

    The first of `written` is its folder. The exit status is 1 where no frame was tracked, none was run, the path cannot
    be trusted, or no recording could be made, which the last line says.
    """
    folder, drawn = written[0].path, "path_length_m" in summary  # where a frame has a pose
    if not summary["frames"]:
        print(f"slam: the run ended before its first frame; files: {folder}", file=sys.stderr)
        raise typer.Exit(1)
    missing = [output for output in written if output.option == "--record" and not output.present]
    if picture and drawn:
        leave_picture(folder)
    if not quiet:
        print_summary([summary], [output.path for output in written if output not in missing])
    if summary["tracking"]:
        no_picture = "; no picture: no frame has a pose" if picture and not drawn else ""
        print(f"slam: {summary['tracking']}{no_picture}", file=sys.stderr)
    elif doubt := summary.get("doubt"):
        red = ("\x1b[31m", "\x1b[0m") if sys.stderr.isatty() else ("", "")
        print(f"{red[0]}slam: do not trust this path: {doubt}{red[1]}", file=sys.stderr)
    for output in missing:
        print(f"slam: {output.path}: not written, as the warning above says", file=sys.stderr)
    if summary.get("doubt") or missing or (summary["frames"] > 1 and not summary["status"].get("tracked")):
        raise typer.Exit(1)


def command_line() -> str:
    """The command that is running, as it can be typed again."""
    return shlex.join(["slam", *sys.argv[1:]])


@contextmanager
def run_folder(out: Path | None, sequence: str, backend: str) -> Iterator[Path]:
    """The folder for a run: `out`, or ``results/<sequence>-<backend>-<n>`` with the first number that is free.

    One that was made here, so that no other run can take it, is removed where nothing was written into it. Raises
    SlamError where none can be made.
    """
    if out is not None:
        require_no_recording(out)
        yield out
        return
    for number in count(1):
        folder = RESULTS / f"{_short(sequence)}-{_short(backend)}-{number}"
        try:
            folder.mkdir(parents=True)
            break
        except FileExistsError:
            if not RESULTS.is_dir():
                raise SlamError(f"{RESULTS}: a file where the folder of all results should be; give --out") from None
        except OSError as error:
            raise SlamError(f"cannot write to {folder}: {error.strerror or error}; give --out") from error
    try:
        yield folder
    finally:
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def require_no_recording(out: Path) -> None:
    """Raise SlamError where the folder of a run or a comparison is that of a recording."""
    found = format_of(out)
    if found == "folders":  # as is each with a folder called left or right, also of a run
        files = chain(out.glob("*"), out.glob("*/*"))
        shown = (path for path in files if path.suffix.lower() in IMAGE_SUFFIXES | VIDEO_SUFFIXES)
        if all((path.parent / "summary.json").exists() for path in shown):
            return
    if found is not None:
        raise SlamError(f"{out}: holds a recording (format {found}); give another --out")


def _short(text: str) -> str:
    """A name for a folder: of a world its name alone."""
    plain = re.sub(r"[^A-Za-z0-9._]+", "_", text.partition("?")[0]).strip("_.")
    return plain[-_LONGEST:] or "run"
