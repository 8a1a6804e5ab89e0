"""``slam plot`` and the picture of a run: path, map, errors and times, of one run or of several of one sequence.

Drawn without pyplot: there is no state to share, and it is loaded faster.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from slam.errors import SlamError
from slam.evaluation.consistency import verdict
from slam.files import whole_file
from slam.naming import unknown
from slam.run.panels import colours, error_panels, map_panel, path_panel, time_panel, unit_of, wrapped
from slam.run.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The picture that a run leaves.
PICTURE = "summary.png"

_MOST_MAPS = 3  # side by side in the summary
_PAGE = 8.0  # [in] below which text is small, as in a paper
_LEAST_HEIGHT = 9.4  # [in] of the summary, below which legends take the place of the panels
_COLUMN = 5.0  # [in] below which panels do not stand side by side
_STYLE: dict[str, Any] = {
    "font.size": 9, "axes.titlesize": 10, "figure.titlesize": 11, "legend.fontsize": 8, "svg.hashsalt": "slam",
    "pdf.fonttype": 42, "text.parse_math": False,
}  # fmt: skip
_SMALL_STYLE = {"font.size": 8, "axes.titlesize": 8, "figure.titlesize": 8, "legend.fontsize": 7}

#: Widths that a picture may be given [mm].
NARROWEST, WIDEST = 50.0, 1000.0

#: What a file of a format says of itself: nothing that changes from run to run.
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Date": None},
}


def read_runs(folders: Sequence[Path]) -> list[list[RunData]]:
    """Finished runs by sequence, in the order given; each has the shortest name that tells it from the others.

    Raises:
        SlamError: a folder does not hold a finished run.
    """
    found: dict[str, list[RunData]] = {}
    for folder in folders:
        run = RunData.read(folder, folder.resolve().name)
        found.setdefault(run.sequence, []).append(run)
    for runs in found.values():
        if len({run.backend for run in runs}) == len(runs):
            runs[:] = [replace(run, name=run.backend) for run in runs]
        elif len({run.name for run in runs}) < len(runs):
            runs[:] = [replace(run, name=f"{run.name} ({i})") for i, run in enumerate(runs, start=1)]
    return list(found.values())


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
    if path.suffix.lower() not in _METADATA:
        raise SlamError(f"{path}: a picture is a file .png, .pdf or .svg")
    if kind not in KINDS:
        raise SlamError(unknown("figure", kind, KINDS))
    if width is not None and not NARROWEST <= width <= WIDEST:
        raise SlamError(f"the width of a picture is {NARROWEST:g} to {WIDEST:g} mm, got {width:g}")
    figure, caption = _drawn(runs, kind, width, titles=path.suffix.lower() == ".png" and width is None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        metadata = {"Title": _title(runs), **_METADATA[path.suffix.lower()]}
        with whole_file(path) as file, _style(width):
            figure.savefig(file, format=path.suffix[1:], dpi=110 if width is None else 300, metadata=metadata)
    except OSError as error:
        raise SlamError(f"cannot write to {path}: {error.strerror or error}") from error
    return caption


def drawn(runs: Sequence[RunData], kind: str, width: float) -> Figure:
    """A picture without titles, as for a paper, so wide [mm]."""
    return _drawn(runs, kind, width, titles=False)[0]


def _drawn(runs: Sequence[RunData], kind: str, width: float | None, titles: bool) -> tuple[Figure, str]:
    """A picture, and its titles in one text; maps side by side keep the names of their runs in any case."""
    with _style(width):
        figure = KINDS[kind](runs, None if width is None else width / 25.4)
        texts = [" ".join(axis.get_title().split()) for axis in figure.axes]
        if not titles:
            figure.suptitle("")
        for axis, run in zip(figure.axes, (*runs, *[None] * len(figure.axes))):
            if not titles and kind != "summary":
                axis.set_title(run.name if kind == "map" and len(runs) > 1 and run is not None else "")
    return figure, ". ".join([_title(runs), *filter(None, texts)]) + "."


def _style(width: float | None) -> AbstractContextManager[None]:
    """Sizes of the letters: small ones where a picture is, as in a paper."""
    from matplotlib import rc_context

    return rc_context(_STYLE | (_SMALL_STYLE if width is not None and width / 25.4 < _PAGE else {}))


def _summary(runs: Sequence[RunData], width: float | None) -> Figure:
    """All at a glance: path and maps above, errors and times below; in a column one below the other."""
    maps = runs[:_MOST_MAPS]
    parts = 1 + len(maps)
    if _is_column(width):
        heights = [*[0.9 * width] * parts, _errors_height(width), _time_height(runs)]
        figure = _figure(width, sum(heights))
        *parts_above, left, right = np.asarray(figure.subfigures(len(heights), 1, height_ratios=heights))
        first, *others = (part.subplots() for part in parts_above)
    else:
        width = width or 5.0 * parts
        figure = _figure(width, max(9.8 * (width / (5.0 * parts)), _LEAST_HEIGHT) + 0.25 * len(runs))
        above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(4.6, 5.2)))
        first, *others = above.subplots(1, parts)
        left, right = np.asarray(below.subfigures(1, 2))
    path_panel(first, runs)
    for axis, run, colour in zip(others, maps, colours(runs)):
        map_panel(axis, run, colour)
    error_panels(left.subplots(4, 1, sharex=True), runs)
    time_panel(right.subplots(), runs)
    lines = [_title(runs), *(f"{run.name}: {facts}" for run in runs if (facts := _facts(run.summary)))]
    figure.suptitle("\n".join(wrapped(line, figure.get_figwidth()) for line in lines))
    return figure


def _facts(summary: Mapping[str, Any]) -> str:
    """What a run found, also where there is no truth, and whether its covariances hold, in one line."""
    words = []
    if summary.get("speed_m_per_s") is not None:
        words.append(f"{summary['path_length_m']:.3g} m at {summary['speed_m_per_s']:.2g} m/s")
        factor, unit = unit_of(summary["final_sigma_m"])
        words.append(f"σ of the last position {factor * summary['final_sigma_m']:.2g} {unit}")
    if "loops" in summary:
        loops = summary["loops"]
        words.append(f"loops closed {loops['closed']}, refused {loops['refused']}")
        words.append(f"moving bodies {summary.get('bodies', 0)}")
    return "; ".join([*words, *filter(None, [verdict(summary.get("consistency", {}))])])


def _path(runs: Sequence[RunData], width: float | None) -> Figure:
    figure = _figure(width or 5.0, 0.92 * (width or 5.0))
    path_panel(figure.subplots(), runs)
    return figure


def _map(runs: Sequence[RunData], width: float | None) -> Figure:
    rows, columns = (len(runs), 1) if _is_column(width) else (1, len(runs))
    width = width or 5.0 * columns
    figure = _figure(width, 0.96 * width / columns * rows)
    for axis, run, colour in zip(figure.subplots(rows, columns, squeeze=False).ravel(), runs, colours(runs)):
        map_panel(axis, run, colour)
    return figure


def _errors(runs: Sequence[RunData], width: float | None) -> Figure:
    figure = _figure(width or 6.0, _errors_height(width) if width else 5.6)
    error_panels(figure.subplots(4, 1, sharex=True), runs)
    return figure


def _time(runs: Sequence[RunData], width: float | None) -> Figure:
    figure = _figure(width or 6.0, _time_height(runs))
    time_panel(figure.subplots(), runs)
    return figure


#: Figures by name.
KINDS: dict[str, Callable[[Sequence[RunData], float | None], Figure]] = {
    "summary": _summary, "path": _path, "map": _map, "errors": _errors, "time": _time,
}  # fmt: skip


def _is_column(width: float | None) -> TypeGuard[float]:
    """Whether a width [in] is that of a column, in which panels stand one below the other."""
    return width is not None and width < _COLUMN


def _errors_height(width: float) -> float:
    return max(width, 4.8)  # below which the labels of the four axes overlap


def _time_height(runs: Sequence[RunData]) -> float:
    return 1.9 + 0.4 * len(runs)


def _title(runs: Sequence[RunData]) -> str:
    """Sequence, frames, and how many of these were not tracked; the first one never is."""
    lost = {run.name: sum(status != "tracked" for status in run.status[1:]) for run in runs}
    frames = ", ".join(dict.fromkeys(f"{len(run.status)} frames" for run in runs))
    frames += "".join(f"; {name}: {count} not tracked" for name, count in lost.items() if count)
    return f"{runs[0].sequence}: {frames}"


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
