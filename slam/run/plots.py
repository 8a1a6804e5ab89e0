"""``slam plot`` and the picture of a run: path, map, errors and times, of one run or of several of one sequence.

Drawn without pyplot: there is no state to share, and it is loaded faster.
"""

from __future__ import annotations

import logging
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slam.errors import ConfigurationError, SlamError
from slam.files import noting_inputs, whole_file
from slam.naming import unknown
from slam.outputs import Output, require_outputs
from slam.run.panels import draw_errors, draw_maps, draw_paths, draw_times
from slam.run.results import facts
from slam.run.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Pictures by name.
KINDS = ("summary", "path", "map", "errors", "time")

#: The picture that a run leaves.
PICTURE = "summary.png"

_MOST_MAPS = 3  # side by side in the summary
_LETTERS = 13  # an inch of the head holds
_STYLE: dict[str, Any] = {
    "font.size": 9, "axes.titlesize": 10, "figure.titlesize": 10, "legend.fontsize": 8, "legend.edgecolor": "none",
    "svg.hashsalt": "slam", "pdf.fonttype": 42, "text.parse_math": False,
}  # fmt: skip

#: What a file of a format says of itself: nothing that changes from run to run.
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Date": None},
}


def plot_folders(folders: Sequence[Path], out: Path | None, kind: str, overwrite: bool = False) -> Path:
    """Draw finished runs of one sequence in one picture, as `plot` does; returns the file.

    Without `out`, a PNG goes to the first folder. Raises SlamError where a folder is none of a finished run, where runs
    are of several sequences, or where a file cannot be written.
    """
    with noting_inputs() as inputs:
        runs = _read(folders)
    sequences = list(dict.fromkeys(run.sequence for run in runs))
    if len(sequences) > 1:
        raise ConfigurationError(
            f"runs of {len(sequences)} sequences ({', '.join(sequences)}): draw those of one at a time"
        )
    file = out or runs[0].folder / (PICTURE if kind == "summary" else f"{kind}.png")
    require_outputs([Output(file, "--out", makes_folder=True)], inputs, overwrite)
    plot(runs, file, kind)
    return file


def leave_picture(folder: Path) -> None:
    """The picture of a run that has just ended; where there is nothing to draw a warning says so."""
    try:
        plot(_read([folder]), folder / PICTURE)
    except SlamError as error:
        logging.getLogger(__name__).warning("no picture: %s", error)


def _read(folders: Sequence[Path]) -> list[RunData]:
    """Finished runs, in the order given; each has the shortest name that tells it from the others."""
    runs = [RunData.read(folder, folder.resolve().name) for folder in folders]
    if len({run.backend for run in runs}) == len(runs):
        return [replace(run, name=run.backend) for run in runs]
    if len({run.name for run in runs}) == len(runs):
        return runs
    return [replace(run, name=f"{run.name} ({i})") for i, run in enumerate(runs, start=1)]


def plot(runs: Sequence[RunData], path: Path, kind: str = "summary") -> None:
    """Draw runs of one sequence into a file; another picture there is overwritten.

    Args:
        runs: of the same sequence.
        path: PNG, PDF or SVG by its suffix.
        kind: one of `KINDS`.

    Raises:
        SlamError: the format or the kind is not known, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in _METADATA:
        raise SlamError(f"{path}: a picture is a file .png, .pdf or .svg")
    if kind not in KINDS:
        raise SlamError(unknown("figure", kind, KINDS))
    from matplotlib import rc_context

    figure = drawn(runs, kind)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file, rc_context(_STYLE):
            metadata = {"Title": _title(runs), **_METADATA[suffix]}
            figure.savefig(file, format=suffix[1:], dpi=110, metadata=metadata)
    except OSError as error:
        raise SlamError(f"cannot write to {path}: {error.strerror or error}") from error


def drawn(runs: Sequence[RunData], kind: str) -> Figure:
    """A picture."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    maps = [f"map {k}" for k in range(len(runs[:_MOST_MAPS] if kind == "summary" else runs))]
    wide, rows, heights = _layout(kind, maps)
    lines = [_title(runs), *(f"{run.name}: {text}" for run in runs if (text := facts(run.summary)))]
    head = "\n".join(textwrap.fill(line, int(_LETTERS * wide)) for line in lines) if kind == "summary" else ""
    with rc_context(_STYLE):
        figure = Figure(figsize=(wide, sum(heights) + (0.17 * head.count("\n") + 0.3 if head else 0.0)))
        figure.set_layout_engine("constrained", w_pad=0.08)
        panels: dict[str, Axes] = figure.subplot_mosaic(rows, height_ratios=heights)
        if "path" in panels:
            draw_paths(panels["path"], runs)
        if "key" in panels:
            draw_maps([panels[name] for name in maps], runs, panels["key"])
        if "position" in panels:
            draw_errors([panels["position"], panels["rotation"]], runs)
        if "time" in panels:
            draw_times(panels["time"], runs)
        if head:
            figure.suptitle(head, x=0.01, ha="left")
    return figure


def _layout(kind: str, maps: list[str]) -> tuple[float, list[list[Any]], list[float]]:
    """Width of a picture [in], names of its panels in rows, and heights of the rows [in].

    Nested rows have margins of their own.
    """
    if kind == "summary":
        wide, below = max(10.0, 4.4 * (1 + len(maps))), [["position", "time"], ["rotation", "time"]]
        return wide, [[[["path", *maps]]], ["key"], [below]], [wide / (1 + len(maps)), 0.5, 4.2]
    if kind == "map":
        return 5.0 * len(maps), [maps, ["key"] * len(maps)], [5.0, 0.5]
    if kind == "path":
        return 5.2, [["path"]], [4.8]
    return 5.2, *(([["position"], ["rotation"]], [1.8, 1.8]) if kind == "errors" else ([["time"]], [2.6]))


def _title(runs: Sequence[RunData]) -> str:
    """Sequence, frames, and how many of these were not tracked; the first one never is."""
    lost = {run.name: sum(status != "tracked" for status in run.status[1:]) for run in runs}
    frames = ", ".join(dict.fromkeys(f"{len(run.status)} frames" for run in runs))
    frames += "".join(f"; {name}: {count} not tracked" for name, count in lost.items() if count)
    return f"{runs[0].sequence}: {frames}"
