"""The command ``slam``. What it does is in the other modules; they are imported when a command needs them."""

from __future__ import annotations

import logging
import os
import sys
from io import TextIOWrapper
from pathlib import Path
from shutil import get_terminal_size
from typing import Annotated, Any, TypeAlias

import typer

from slam.commands.ending import catch_signals, one_line_errors
from slam.errors import ConfigurationError
from slam.registry import ONLINE

app = typer.Typer(
    help="Stereo SLAM with modified SURF features and interchangeable back ends.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # boxes clip what does not fit
    context_settings={"help_option_names": ["-h", "--help"]},
)


def option(help: str, metavar: str | None = None, *names: str, **more: Any) -> Any:
    """An option of a command; without names it is called as its parameter."""
    return typer.Option(*names, metavar=metavar, help=help, **more)


def argument(help: str, metavar: str) -> Any:
    """An argument of a command."""
    return typer.Argument(metavar=metavar, help=help, show_default=False)


_File: TypeAlias = Path | None
_Text: TypeAlias = str | None

#: Options that several commands share.
_Out = Annotated[Path, option("Folder for the files.", "DIR", "--out", "-o")]
_RunOut = Annotated[_File, option("Folder; default: results/SEQUENCE-BACKEND-N.", "DIR", "--out", "-o")]
_Overwrite = Annotated[bool, option("Replace files that are there; never an input.", None, "--overwrite")]
_Texts: TypeAlias = list[str] | None
_Set = Annotated[_Texts, option("A setting, e.g. map.max_landmarks=300; see `slam settings`.", "KEY=VALUE", "--set")]
_Backend = Annotated[str | None, option("Back end, see `slam list`; default: ekf.", "NAME")]
_Frames = Annotated[str | None, option("Range of frames, B left out.", "A:B")]
_Quiet = Annotated[bool, option("No progress, no table.", None, "--quiet", "-q")]
_Picture = Annotated[bool, option("Leave a picture of the run.", None, "--picture/--no-picture")]
_Format = Annotated[str | None, option("Format, or module:function; default: found out from the folder.", "FORMAT")]
_Mask = Annotated[_Text, option("Image that is black where a camera sees its own car; left, right.", "FILE[,FILE]")]


def main() -> None:
    """Entry point; errors end as `slam.commands.ending` says."""
    os.environ["MPLBACKEND"] = "agg"  # pictures are files here, whatever windows are to be drawn with elsewhere
    catch_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal that knows no sigma
            stream.reconfigure(errors="backslashreplace")
    with one_line_errors():
        for name in ("matplotlib", "PIL"):
            logging.getLogger(name).setLevel(logging.ERROR)  # what they warn of is ours to mend
        logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
        notes, handler = logging.getLogger("slam.runtime.compilation"), logging.StreamHandler()
        handler.setFormatter(logging.Formatter("slam: %(message)s"))
        notes.addHandler(handler)
        notes.propagate = False  # that kernels are compiled is no warning
        app(prog_name="slam")


def _print_version(wanted: bool) -> None:
    if wanted:
        from slam.version import __version__

        print(f"surf-stereo-slam {__version__}")
        raise typer.Exit


_Version = Annotated[
    bool, option("Show the version and exit.", None, "--version", callback=_print_version, is_eager=True)
]


@app.callback()
def common_options(version: _Version = False) -> None:
    """Options of the command itself."""


@app.command("demo", short_help="Try three back ends on a built-in scene.")
def demo_command(
    out: _Out = Path("slam_demo"),
    frames: Annotated[int, option("Number of frames.", "N")] = 150,
    overwrite: _Overwrite = False,
    quiet: _Quiet = False,
) -> None:
    """Run three back ends on a built-in scene, compare them, and draw pictures."""
    from slam.commands.demo import demo

    demo(out, frames, quiet, overwrite)


@app.command("run", short_help="Run one sequence through one back end.")
def run_command(
    sequence: Annotated[str, argument("A folder, a ROS recording, camera:0, or synthetic:NAME?key=value.", "SEQUENCE")],
    out: _RunOut = None,
    backend: _Backend = None,
    frontend: Annotated[_Text, option("Front end, see `slam list`; default: surf.", "NAME")] = None,
    settings: _Set = None,
    frames: _Frames = None,
    kind: Annotated[_Text, option("handheld or driving; default: the sequence's own.", "KIND")] = None,
    format: _Format = None,
    record: Annotated[_File, option("Record what the back end is given, for `slam replay`.", "FILE.npz")] = None,
    prior_map: Annotated[_File, option("Start in the map of an earlier run.", "FILE", "--map")] = None,
    save_map: Annotated[_File, option("Keep the map.", "FILE", "--save-map")] = None,
    mono: Annotated[bool, option("Left images alone, in a prior map.", None, "--mono")] = False,
    calibration: Annotated[_File, option("The rig's errors, from `slam calibrate` or a run.", "FILE")] = None,
    mask: _Mask = None,
    viewer: Annotated[_Text, option("Show it in Rerun, or keep it for Rerun.", "live|FILE.rrd")] = None,
    draw: Annotated[_File, option("Draw landmarks and objects, and the map that grows.", "DIR|FILE.mp4")] = None,
    live: Annotated[bool, option("Frames at their own rate; late ones are dropped.", None, "--live")] = False,
    picture: _Picture = True,
    overwrite: _Overwrite = False,
    quiet: _Quiet = False,
) -> None:
    """Run one sequence through one back end."""
    from slam.commands.run import run_sequence
    from slam.sequences import with_mask

    choices = {
        "backend": backend, "frontend": frontend, "kind": kind, "record": record, "prior_map": prior_map,
        "save_map": save_map, "mono": mono, "calibration": calibration, "live": live,
    }  # fmt: skip
    run_sequence(
        with_mask(sequence, mask), out, settings or [], frames, format, choices, viewer=viewer, draw=draw,
        picture=picture, overwrite=overwrite, quiet=quiet,
    )  # fmt: skip


@app.command("replay", short_help="Feed a back end recorded measurements.")
def replay_command(
    recording: Annotated[Path, argument("Made by `slam run --record`.", "FILE.npz")],
    out: _RunOut = None,
    backend: _Backend = None,
    settings: _Set = None,
    picture: _Picture = True,
    overwrite: _Overwrite = False,
    quiet: _Quiet = False,
) -> None:
    """Give a back end the same measurements that another one was given."""
    from slam.commands.run import run_recorded

    run_recorded(recording, out, backend, settings or [], picture, overwrite, quiet)


@app.command("plot", short_help="Draw finished runs.")
def plot_command(
    folders: Annotated[list[Path], argument("Left by `slam run`.", "DIR")],
    out: Annotated[_File, option("PNG, PDF or SVG; default: a PNG in the first folder.", "FILE", "--out", "-o")] = None,
    figure: Annotated[str, option("summary, path, map, errors or time.", "NAME")] = "summary",
    overwrite: _Overwrite = False,
) -> None:
    """Draw finished runs, those of one sequence in one picture: path, map, errors, time per stage."""
    from slam.run.plots import plot_folders

    print(f"Files: {plot_folders(folders, out, figure, overwrite)}")


@app.command("settings", short_help="List all settings.")
def settings_command(
    section: Annotated[str | None, argument("A section, a setting, or a front end or back end.", "SECTION")] = None,
) -> None:
    """List all settings with default per kind of motion, unit and meaning."""
    from slam.run.settings_reference import listing

    print("\n".join(listing(section, min(get_terminal_size().columns, 100))))


@app.command("compare", short_help="Compare back ends on the same recordings.")
def compare_command(
    sequences: Annotated[list[str], argument("Folders, or synthetic:NAME?key=value.", "SEQUENCE")],
    out: Annotated[_File, option("Folder; a comparison that was stopped in it goes on.", "DIR", "--out", "-o")] = None,
    backends: Annotated[str, option("Back ends; the first is the reference.", "A,B,...")] = ",".join(ONLINE),
    frontend: Annotated[str, option("Front end; simulated: a world's own features, no images.", "NAME")] = "surf",
    settings: _Set = None,
    mask: _Mask = None,
    trials: Annotated[int, option("Seeds 0 to N - 1 of every synthetic world.", "N")] = 12,
    frames: _Frames = None,
    replay: Annotated[bool, option("Also feed the first back end's measurements to all.", None, "--replay")] = False,
    workers: Annotated[int | None, option("Processes; default: the number of cores.", "N")] = None,
    overwrite: _Overwrite = False,
    quiet: Annotated[bool, option("No progress, no conclusions.", None, "--quiet", "-q")] = False,
) -> None:
    """Compare back ends on the same recordings: tables, what can be told from chance, and one HTML report."""
    from slam.commands import compare as command
    from slam.commands.run import command_line
    from slam.compare.plan import Plan
    from slam.run.options import parse_frames
    from slam.sequences import with_mask

    masked, names = (with_mask(text, mask) for text in sequences), filter(None, backends.split(","))
    start, stop = parse_frames(frames)
    if out is None:
        raise ConfigurationError("slam compare needs --out DIR, a folder for its report, tables and runs")
    plan = Plan(tuple(masked), tuple(names), frontend, tuple(settings or ()), trials, start, stop, replay)
    runs = command.compare(plan, out, workers, quiet, overwrite, command_line())
    if not any(run.trusted for run in runs):
        print("slam: no run can be trusted: each failed, or its path is doubted", file=sys.stderr)
        raise typer.Exit(1)


@app.command("calibrate", short_help="Find a stereo rig's error from its recordings.")
def calibrate_command(
    sequences: Annotated[list[str], argument("Recordings of one rig.", "SEQUENCE")],
    out: Annotated[Path, option("For `slam run --calibration`.", "FILE", "--out", "-o")] = Path("rig_errors.json"),
    settings: _Set = None,
    frames: _Frames = None,
    format: _Format = None,
    mask: _Mask = None,
    overwrite: _Overwrite = False,
    quiet: _Quiet = False,
) -> None:
    """Find what a rig's calibration is off by, from all its recordings together, and whether they agree."""
    from slam.commands.calibrate import calibrate
    from slam.run.options import parse_frames
    from slam.sequences import with_mask

    texts = [with_mask(text, mask) for text in sequences]
    calibrate(texts, out, settings or [], parse_frames(frames), format, quiet, overwrite)


@app.command("render", short_help="Write a built-in sequence as a folder.")
def render_command(
    sequence: Annotated[str, argument("A folder, or synthetic:NAME?key=value.", "SEQUENCE")],
    out: _Out,
    frames: _Frames = None,
    quiet: Annotated[bool, option("No progress.", None, "--quiet", "-q")] = False,
) -> None:
    """Write a built-in sequence as an EuRoC folder with its truth, for other programs."""
    from slam.commands.display import counting
    from slam.commands.run import frame_count
    from slam.files import noting_inputs
    from slam.outputs import Output, require_outputs
    from slam.run.options import parse_frames
    from slam.sequences import open_sequence
    from slam.worlds.export import FOLDER, require_world, write_euroc

    with noting_inputs() as inputs:
        opened = require_world(open_sequence(sequence))
    require_outputs([Output(out, "--out", [f"{FOLDER}/"])], inputs, overwrite=None)
    start, stop = parse_frames(frames)
    with counting(frame_count(opened, start, stop), f"{opened.name} · render", quiet) as tell:
        root = write_euroc(opened, out, start, stop, tell)
    if not quiet:
        print(f"Files: {root}")


@app.command("view", short_help="Show a finished run in Rerun.")
def view_command(
    folder: Annotated[Path, argument("Left by `slam run`.", "DIR")],
    target: Annotated[str, option("A window, or a file.", "live|FILE.rrd", "--to")] = "live",
    overwrite: _Overwrite = False,
) -> None:
    """Show a finished run in Rerun: path, objects and map; `slam run --viewer` shows its images, too."""
    from slam.run.viewer import view_run

    view_run(folder, target, overwrite)


@app.command("list", short_help="List back ends, sequences and formats.")
def list_command(
    options: Annotated[bool, option("Also the options of the built-in sequences.", None, "--options")] = False,
) -> None:
    """List back ends, front ends, built-in sequences and formats."""
    from slam.commands.display import print_listing

    print_listing(options)


@app.command("warm-up", short_help="Compile all kernels beforehand.")
def warm_up_command(quiet: _Quiet = False) -> None:
    """Compile all kernels, so that no run has to: for images of containers, and after an update."""
    from slam.commands.display import progress
    from slam.run.warm_up import compile_kernels, warm_up
    from slam.runtime.compilation import compile_clock

    with progress(None, "kernels", quiet):
        compile_kernels(ONLINE[-1])
        warm_up()
    seconds = compile_clock.seconds()
    if not quiet:
        print(f"kernels compiled in {seconds:.0f} s" if seconds else "all kernels were compiled already")
