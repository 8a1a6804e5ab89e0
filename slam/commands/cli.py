"""The command ``slam``. What it does is in the other modules; they are imported when a command needs them."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.errors import ConfigurationError, SlamError, one_line
from slam.files import reason

if TYPE_CHECKING:
    from slam.data import FrameResult
    from slam.sequences import Sequence

app = typer.Typer(
    help="Stereo SLAM with modified SURF features and interchangeable back ends.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

SequenceArgument = Annotated[
    str, typer.Argument(metavar="SEQUENCE", help="A folder, or synthetic:NAME?key=value.", show_default=False)
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the files of the run.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting, e.g. map.max_landmarks=300.")
]


#: Signals that end a run with all its files: Ctrl-C, a request to end, a closed terminal.
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class _Stopped(BaseException):
    """Asked to end by a signal; no handler of errors catches it, and files are completed on the way out."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def main() -> None:
    """Entry point: bad input is one line on standard error and exit status 2; a signal's is 128 + its number."""
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
    for name in _SIGNALS:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` ignores a closed terminal
            signal.signal(number, _stop)
    try:
        app()
    except SlamError as error:
        _end(f"slam: {error}", 2)
    except BrokenPipeError:  # whoever read the output has gone
        _end("", 1)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _end(f"slam: {one_line(f'{place}{reason(error)}')}", 2)
    except MemoryError:
        _end("slam: there is not enough memory for this", 2)
    except _Stopped as stopped:
        _end(f"slam: stopped by {stopped}; frames done so far are kept", 128 + stopped.number)


def _end(line: str, status: int) -> None:
    """Say why, where there is still a terminal to say it on, and end."""
    with suppress(OSError):
        if line:
            print(line, file=sys.stderr, flush=True)
        else:
            sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 Python flushes it at the end
    sys.exit(status)


_pending: list[int] = []  # a signal that waits for the end of a frame
_in_frames = False


def _stop(number: int, frame: object) -> None:
    """Stop at once; while frames are worked on, after the present one, so that all files agree. Twice: at once."""
    if not _in_frames or _pending:
        raise _Stopped(number)
    _pending.append(number)


@contextmanager
def _whole_frames(after_frame: Callable[[FrameResult], None]) -> Iterator[Callable[[FrameResult], None]]:
    """A callback for the end of every frame, at which a signal that came meanwhile takes effect."""
    global _in_frames

    def end_of_frame(result: FrameResult) -> None:
        after_frame(result)
        if _pending:
            raise _Stopped(_pending.pop())

    _in_frames = True
    try:
        yield end_of_frame
    finally:
        _in_frames = False


@app.command("run")
def run_command(
    sequence: SequenceArgument,
    out: OutOption,
    backend: Annotated[str, typer.Option(help="Back end by name, see `slam list`.")] = "ekf",
    frontend: Annotated[str, typer.Option(help="Front end by name, see `slam list`.")] = "surf",
    settings: SetOption = None,
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="Range of frames.")] = None,
    kind: Annotated[str | None, typer.Option(help="handheld or driving; default: the sequence's own.")] = None,
    format: Annotated[str | None, typer.Option(help="Format; default: found out from the folder.")] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FILE.npz", help="Record what the back end is given, for `slam replay`.")
    ] = None,
    known_map: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="Start in the map of an earlier run.")
    ] = None,
    save_map: Annotated[Path | None, typer.Option("--save-map", metavar="FILE", help="Keep the map.")] = None,
    mono: Annotated[bool, typer.Option("--mono", help="Left images alone, in a known map.")] = False,
    viewer: Annotated[
        str | None, typer.Option(metavar="live|FILE.rrd", help="Show it in Rerun, or keep it for Rerun.")
    ] = None,
    draw: Annotated[
        Path | None, typer.Option(metavar="DIR|FILE.mp4", help="Draw landmarks and objects into the frames.")
    ] = None,
    overlap: Annotated[
        bool, typer.Option(help="Extract the next frame's features while this one is estimated; same results.")
    ] = True,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
) -> None:
    """Run one sequence through one back end."""
    from slam.commands.display import Progress, print_summary
    from slam.config import SystemConfig
    from slam.run.runner import RunOptions, parse_frames, run
    from slam.sequences import open_sequence

    opened = open_sequence(sequence, format=format)
    start, stop = parse_frames(frames)
    mono_settings = ["map.monocular=true"] if mono else []
    default = SystemConfig.for_kind(kind or opened.kind, frontend, backend)
    config = default.with_settings([*mono_settings, *(settings or [])])
    if mono and known_map is None:
        raise ConfigurationError("--mono needs --map FILE: left images alone do not tell how large the world is")
    options = RunOptions(backend, frontend, config, out, start, stop, record, known_map, save_map, mono, overlap)
    progress = Progress(_frame_count(opened, start, stop), f"{opened.name} · {backend}", quiet)
    with ExitStack() as stack:
        watches = []
        if viewer is not None:
            from slam.run.viewer import Viewer

            watches.append(stack.enter_context(Viewer(viewer, opened.rig, opened.ground_truth)).show)
        if draw is not None:
            from slam.run.drawing import FramePictures

            watches.append(stack.enter_context(FramePictures(draw)).show)
        end_of_frame = stack.enter_context(_whole_frames(stack.enter_context(progress).frame))
        summary = run(opened, options, end_of_frame, watches=watches)
    if not quiet:
        print_summary([summary], out)


@app.command("replay")
def replay_command(
    recording: Annotated[Path, typer.Argument(metavar="FILE.npz", help="Made by `slam run --record`.")],
    out: OutOption,
    backend: Annotated[str, typer.Option(help="Back end by name, see `slam list`.")] = "ekf",
    settings: SetOption = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
) -> None:
    """Give a back end the same measurements that another one was given."""
    from slam.commands.display import Progress, print_summary
    from slam.config import SystemConfig
    from slam.run.recording import load_recording
    from slam.run.runner import RunOptions, run_recording

    loaded = load_recording(recording)
    default = SystemConfig.for_kind(loaded.kind, None, backend)
    config = replace(default, models=loaded.models).with_settings(settings or [])
    progress = Progress(len(loaded), f"{loaded.name} · {backend}", quiet)
    with progress, _whole_frames(progress.frame) as end_of_frame:
        summary = run_recording(loaded, RunOptions(backend, "recording", config, out), end_of_frame)
    if not quiet:
        print_summary([summary], out)


@app.command("compare")
def compare_command(
    sequences: Annotated[
        list[str], typer.Argument(metavar="SEQUENCE…", help="Folders, or synthetic:NAME?key=value.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder; a comparison that was stopped in it goes on.")],
    backends: Annotated[str, typer.Option(help="Names with commas; the first is the reference.")] = "ekf,smoother",
    frontends: Annotated[str, typer.Option(help="Names; simulated: a world's own features, no images.")] = "",
    variant: Annotated[
        list[str] | None, typer.Option(metavar="NAME:FRONTEND:KEY=VALUE:…", help="A front end with settings.")
    ] = None,
    settings: SetOption = None,
    trials: Annotated[int, typer.Option(min=1, help="Seeds 0, 1, … of every synthetic world.")] = 1,
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="Range of frames.")] = None,
    replay: Annotated[bool, typer.Option(help="Also feed the first back end's measurements to all.")] = True,
    workers: Annotated[int | None, typer.Option(help="Processes; default: the number of cores.")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler to be used.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="30 frames, 2 trials: does it work?")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no conclusions.")] = False,
) -> None:
    """Compare back ends on the same recordings: tables, what is certain and what is not, and one HTML report."""
    from slam.commands import compare as command
    from slam.compare.plan import Plan
    from slam.run.runner import parse_frames

    names = [[word for word in text.split(",") if word] for text in (backends, frontends)]
    variants = command.variants_of(names[1], variant or [], settings or [])
    plan = Plan(tuple(sequences), tuple(names[0]), variants, trials, *parse_frames(frames), replay)
    command.compare(command.quick(plan) if quick else plan, out, workers, scheduler, quiet)


@app.command("render")
def render_command(
    sequence: SequenceArgument,
    out: OutOption,
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="Range of frames.")] = None,
    truth_images: Annotated[bool, typer.Option(help="Depth and object images as well.")] = True,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Write a built-in sequence as an EuRoC folder with its truth, for other programs."""
    from slam.commands.display import counting
    from slam.run.runner import parse_frames
    from slam.sequences import open_sequence
    from slam.worlds.export import require_world, write_euroc

    opened = require_world(open_sequence(sequence))
    start, stop = parse_frames(frames)
    with counting(_frame_count(opened, start, stop), f"{opened.name} · render", quiet) as progress:
        root = write_euroc(opened, out, start, stop, progress, truth_images)
    if not quiet:
        print(f"Files: {root}")


@app.command("view")
def view_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Left by `slam run`.", show_default=False)],
    target: Annotated[str, typer.Option("--to", metavar="live|FILE.rrd", help="A window, or a file.")] = "live",
) -> None:
    """Show a finished run in Rerun: path, objects and map; `slam run --viewer` shows its images, too."""
    from slam.run.viewer import view_run

    view_run(folder, target)


@app.command("list")
def list_command() -> None:
    """List back ends, front ends, built-in sequences and formats."""
    from slam.commands.display import print_listing

    print_listing()


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("slam_demo"),
    frames: Annotated[int, typer.Option(min=10, help="Number of frames.")] = 150,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
) -> None:
    """Run both back ends on a built-in scene, compare them, and draw pictures."""
    from slam.commands.demo import demo

    demo(out, frames, quiet)


def _frame_count(sequence: Sequence, start: int, stop: int | None) -> int:
    return len(range(start, len(sequence) if stop is None else min(stop, len(sequence))))
