"""The command ``slam``. What it does is in the other modules; they are imported when a command needs them."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.errors import SlamError

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


class _Stopped(BaseException):
    """Asked to end by a signal; no handler of errors catches it, and files are completed on the way out."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def main() -> None:
    """Entry point: bad input is one line on standard error and exit status 2; a signal's is 128 + its number."""
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    try:
        app()
    except SlamError as error:
        print(f"slam: {error}", file=sys.stderr)
        sys.exit(2)
    except _Stopped as stopped:
        print(f"slam: stopped by {stopped}; frames done so far are kept", file=sys.stderr)
        sys.exit(128 + stopped.number)


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
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
) -> None:
    """Run one sequence through one back end."""
    from slam.config import SystemConfig
    from slam.display import Progress, print_summary
    from slam.runner import RunOptions, parse_frames, run
    from slam.sequences import open_sequence

    opened = open_sequence(sequence, format=format)
    start, stop = parse_frames(frames)
    config = SystemConfig.for_kind(kind or opened.kind, frontend).with_settings(settings or [])
    options = RunOptions(backend, frontend, config, out, start, stop)
    progress = Progress(_frame_count(opened, start, stop), f"{opened.name} · {backend}", quiet)
    with progress, _whole_frames(progress.frame) as end_of_frame:
        summary = run(opened, options, end_of_frame)
    if not quiet:
        print_summary([summary], out)


@app.command("render")
def render_command(
    sequence: SequenceArgument,
    out: OutOption,
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="Range of frames.")] = None,
    truth_images: Annotated[bool, typer.Option(help="Depth and object images as well.")] = True,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Write a built-in sequence as an EuRoC folder with its truth, for other programs."""
    from slam.display import counting
    from slam.runner import parse_frames
    from slam.sequences import open_sequence
    from slam.worlds.export import write_euroc

    opened = open_sequence(sequence)
    start, stop = parse_frames(frames)
    with counting(_frame_count(opened, start, stop), f"{opened.name} · render", quiet) as progress:
        root = write_euroc(opened, out, start, stop, progress, truth_images)
    if not quiet:
        print(f"Files: {root}")


@app.command("list")
def list_command() -> None:
    """List back ends, front ends, built-in sequences and formats."""
    from slam.display import print_listing

    print_listing()


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("slam_demo"),
    frames: Annotated[int, typer.Option(min=10, help="Number of frames.")] = 150,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
) -> None:
    """Run both back ends on a built-in scene, compare them, and draw pictures."""
    from slam.demo import demo

    demo(out, frames, quiet)


def _frame_count(sequence: Sequence, start: int, stop: int | None) -> int:
    return len(range(start, len(sequence) if stop is None else min(stop, len(sequence))))
