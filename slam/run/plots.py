"""``slam plot`` and the picture of a run: path, map, errors and times, of one run or of several of one sequence.

Drawn without pyplot: there is no state to share, and it is loaded faster.
"""

from __future__ import annotations

import logging
import textwrap
from collections.abc import Sequence
from contextlib import AbstractContextManager
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

#: Widths that a picture may be given [mm]; names of stages leave no room for their times in a narrower one.
NARROWEST, WIDEST = 80.0, 1000.0

_MOST_MAPS = 3  # side by side in the summary
_PAGE = 8.0  # [in] below which text is small, as in a paper
_LETTERS = 13  # an inch of the head holds
_COLUMN = 5.0  # [in] below which panels do not stand side by side
_STYLE: dict[str, Any] = {
    "font.size": 9, "axes.titlesize": 10, "figure.titlesize": 10, "legend.fontsize": 8, "legend.edgecolor": "none",
    "svg.hashsalt": "slam", "pdf.fonttype": 42, "text.parse_math": False,
}  # fmt: skip
_SMALL_STYLE = {"font.size": 8, "axes.titlesize": 8, "figure.titlesize": 8, "legend.fontsize": 7}

#: What a file of a format says of itself: nothing that changes from run to run.
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Date": None},
}


def plot_folders(
    folders: Sequence[Path], out: Path | None, kind: str, width: float | None = None, overwrite: bool = False
) -> tuple[Path, str]:
    """Draw finished runs of one sequence in one picture, as `plot` does; returns the file and its caption.

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
    return file, plot(runs, file, kind, width)


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


def plot(runs: Sequence[RunData], path: Path, kind: str = "summary", width: float | None = None) -> str:
    """Draw runs of one sequence into a file; returns a caption.

    A picture for a screen has its caption inside, as titles. One for a paper, which is a PDF, an SVG, or any with a
    width, has none inside but what tells its panels apart.

    Args:
        runs: of the same sequence.
        path: PNG, PDF or SVG by its suffix; another picture there is overwritten.
        kind: one of `KINDS`.
        width: of the picture [mm], such as 88 for a column of many journals; None for one that suits a screen.

    Raises:
        SlamError: the format or the kind is not known, the width is out of range, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in _METADATA:
        raise SlamError(f"{path}: a picture is a file .png, .pdf or .svg")
    if kind not in KINDS:
        raise SlamError(unknown("figure", kind, KINDS))
    if width is not None and not NARROWEST <= width <= WIDEST:
        raise SlamError(f"the width of a picture is {NARROWEST:g} to {WIDEST:g} mm, got {width:g}")
    figure, caption = drawn(runs, kind, width, titles=suffix == ".png" and width is None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file, _style(width):
            metadata = {"Title": _title(runs), **_METADATA[suffix]}
            figure.savefig(file, format=suffix[1:], dpi=110 if width is None else 300, metadata=metadata)
    except OSError as error:
        raise SlamError(f"cannot write to {path}: {error.strerror or error}") from error
    return caption


def drawn(runs: Sequence[RunData], kind: str, width: float | None, titles: bool = False) -> tuple[Figure, str]:
    """A picture, so wide [mm], and its titles in one text; maps side by side keep the names of their runs anyway."""
    with _style(width):
        figure = _draw(kind, runs, None if width is None else width / 25.4)
        texts = [" ".join(axis.get_title().split()) for axis in figure.axes]
        if not titles:
            figure.suptitle("")
            names = [run.name for run in runs] if kind == "map" and len(runs) > 1 else []
            for i, axis in enumerate(figure.axes if kind != "summary" else ()):
                axis.set_title(names[i] if i < len(names) else "")
    return figure, ". ".join([_title(runs), *filter(None, texts)]) + "."


def _style(width: float | None) -> AbstractContextManager[None]:
    """Sizes of the letters: small ones where a picture is, as in a paper."""
    from matplotlib import rc_context

    return rc_context(_STYLE | (_SMALL_STYLE if width is not None and width / 25.4 < _PAGE else {}))


def _layout(kind: str, maps: list[str], width: float | None) -> tuple[float, list[list[Any]], list[float]]:
    """Width of a picture [in], names of its panels in rows, and heights of the rows [in].

    Nested rows have margins of their own. In a narrow column panels stand one below the other.
    """
    column, count = width is not None and width < _COLUMN, len(maps)
    if kind == "summary":
        wide = width or max(10.0, 4.4 * (1 + count))
        if column:
            rows = [[[[name]]] for name in ("path", *maps, "key")] + [[[["position"], ["rotation"]]], [[["time"]]]]
            return wide, rows, [0.9 * wide, *[0.95 * wide] * count, 1.0, 3.2, 2.6]
        below = [["position", "time"], ["rotation", "time"]]
        return wide, [[[["path", *maps]]], ["key"], [below]], [wide / (1 + count), 0.5, 4.2]
    if kind == "map":
        wide = width or 5.0 * count
        if column:
            return wide, [*([name] for name in maps), ["key"]], [*[wide] * count, 0.9]
        return wide, [maps, ["key"] * count], [wide / count, 0.5]
    if kind == "path":
        return width or 5.0, [["path"]], [0.92 * (width or 5.0)]
    if kind == "errors":
        return width or 6.0, [["position"], ["rotation"]], [1.8, 1.8]
    return width or 6.0, [["time"]], [2.6]


def _draw(kind: str, runs: Sequence[RunData], width: float | None) -> Figure:
    """The panels of a picture with all that is in them."""
    from matplotlib.figure import Figure

    maps = [f"map {k}" for k in range(len(runs[:_MOST_MAPS] if kind == "summary" else runs))]
    wide, rows, heights = _layout(kind, maps, width)
    lines = [_title(runs), *(f"{run.name}: {text}" for run in runs if (text := facts(run.summary)))]
    head = "\n".join(textwrap.fill(line, int(_LETTERS * wide)) for line in lines) if kind == "summary" else ""
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
        for axis in panels.values():
            axis.set_title(textwrap.fill(axis.get_title(), int(_LETTERS * min(wide, 5.0))))
        figure.suptitle(head, x=0.01, ha="left")
    return figure


def _title(runs: Sequence[RunData]) -> str:
    """Sequence, frames, and how many of these were not tracked; the first one never is."""
    lost = {run.name: sum(status != "tracked" for status in run.status[1:]) for run in runs}
    frames = ", ".join(dict.fromkeys(f"{len(run.status)} frames" for run in runs))
    frames += "".join(f"; {name}: {count} not tracked" for name, count in lost.items() if count)
    return f"{runs[0].sequence}: {frames}"
