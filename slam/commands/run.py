"""``slam run``: what the command line asks for, the folder of a run, and how it ends."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import typer

from slam.calibration import load_calibration
from slam.commands.display import print_summary
from slam.config import SystemConfig
from slam.errors import ConfigurationError, SlamError
from slam.files import note_input
from slam.outputs import Output
from slam.run.options import RunOptions, parse_frames
from slam.run.plots import leave_picture
from slam.run.recording import Recording
from slam.sequences import Sequence as StereoSequence
from slam.sequences import format_of, is_live, open_sequence
from slam.settings import require_settable

_BACKEND, _FRONTEND = "ekf", "surf"
RESULTS = Path("results")
_LONGEST = 60  # characters of a sequence's name in a folder's


def prepare(
    source: str, settings: Sequence[str] = (), frames: str | None = None, format: str | None = None, **choices: Any
) -> tuple[StereoSequence, RunOptions]:
    """The sequence, opened, and what to do with it; the folder is still to be chosen.

    `choices` are fields of `RunOptions`, None or False where the command line says nothing. Raises SlamError on bad
    input.
    """
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


def title(sequence: StereoSequence | Recording, backend: str) -> str:
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
    if (found := format_of(out)) is not None:
        raise SlamError(f"{out}: holds a recording (format {found}); give another --out")


def _short(text: str) -> str:
    """A name for a folder: of a world its name alone."""
    plain = re.sub(r"[^A-Za-z0-9._]+", "_", text.partition("?")[0]).strip("_.")
    return plain[-_LONGEST:] or "run"
