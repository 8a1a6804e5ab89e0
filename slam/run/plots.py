"""``slam plot`` and the picture of a run: path, map, errors and times, of one run or of several of one sequence.

Drawn without pyplot: there is no state to share, and it is loaded faster.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from slam.errors import SlamError
from slam.evaluation.consistency import verdict
from slam.files import whole_file
from slam.geometry.se3 import inverse
from slam.geometry.trajectory import Trajectory
from slam.naming import unknown
from slam.run import figures
from slam.run.run_data import RunData
from slam.run.style import DASHES, backend_colours, repeated, stage_colour, stage_name, stages

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The picture that a run leaves.
PICTURE = "summary.png"

_LETTER = 0.6  # mean width of a letter in sizes of the font
_TRUTH = "0.25"
_AXES = ("right", "down", "forward")
_HEADROOM = 1.2  # height of a map over that of what it shows: room for the legend
_MOST_MAPS = 3  # side by side in the summary
_PAGE = 8.0  # [in] below which text is small, as in a paper
_LEAST_HEIGHT = 7.8  # [in] of the summary, below which legends take the place of the panels
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
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with rc_context(_style(width)):
        figure = KINDS[kind](runs, _inches(width))
        caption = _caption(figure, runs)
        if path.suffix.lower() != ".png" or width is not None:
            _without_titles(figure, runs, kind)
        FigureCanvasAgg(figure)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            metadata = {"Title": _title(runs), **_METADATA[path.suffix.lower()]}
            with whole_file(path) as file:
                figure.savefig(file, format=path.suffix[1:], dpi=110 if width is None else 300, metadata=metadata)
        except OSError as error:
            raise SlamError(f"cannot write to {path}: {error.strerror or error}") from error
    return caption


def drawn(runs: Sequence[RunData], kind: str, width: float) -> Figure:
    """A picture without titles, as for a paper, so wide [mm]."""
    from matplotlib import rc_context

    with rc_context(_style(width)):
        figure = KINDS[kind](runs, _inches(width))
        _without_titles(figure, runs, kind)
    return figure


def _inches(width: float | None) -> float | None:
    return None if width is None else width / 25.4


def _style(width: float | None) -> dict[str, Any]:
    """Sizes of the letters: small ones where a picture is, as in a paper."""
    return _STYLE | (_SMALL_STYLE if width is not None and width / 25.4 < _PAGE else {})


def _caption(figure: Figure, runs: Sequence[RunData]) -> str:
    """The titles in one text."""
    titles = [" ".join(axis.get_title().split()) for axis in figure.axes]
    return ". ".join([_title(runs), *(title for title in titles if title)]) + "."


def _without_titles(figure: Figure, runs: Sequence[RunData], kind: str) -> None:
    """Take the titles away; maps side by side keep the names of their runs."""
    figure.suptitle("")
    for axis in figure.axes if kind != "summary" else []:
        axis.set_title("")
    if kind == "map" and len(runs) > 1:
        for axis, run in zip(figure.axes, runs):
            axis.set_title(run.name)


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
        figure = _figure(width, max(8.2 * (width / (5.0 * parts)), _LEAST_HEIGHT) + 0.25 * len(runs))
        above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(4.6, 3.6)))
        first, *others = above.subplots(1, parts)
        left, right = np.asarray(below.subfigures(1, 2))
    _path_panel(first, runs)
    for axis, run, colour in zip(others, maps, _colours(runs)):
        _map_panel(axis, run, colour)
    _error_panels(left.subplots(3, 1, sharex=True), runs)
    _time_panel(right.subplots(), runs)
    lines = [_title(runs), *(f"{run.name}: {facts}" for run in runs if (facts := _facts(run.summary)))]
    figure.suptitle("\n".join(_wrapped(line, figure.get_figwidth()) for line in lines))
    return figure


def _facts(summary: Mapping[str, Any]) -> str:
    """What a run found, also where there is no truth, and whether its covariances hold, in one line."""
    words = []
    if summary.get("speed_m_per_s") is not None:
        words.append(f"{summary['path_length_m']:.3g} m at {summary['speed_m_per_s']:.2g} m/s")
        words.append(f"σ of the last position {_length(summary['final_sigma_m'])}")
    if "loops" in summary:
        loops = summary["loops"]
        words.append(f"loops closed {loops['closed']}, refused {loops['refused']}")
        words.append(f"moving bodies {summary.get('bodies', 0)}")
    return "; ".join([*words, *filter(None, [verdict(summary.get("consistency", {}))])])


def _length(metres: float) -> str:
    factor, unit = _unit(metres)
    return f"{factor * metres:.2g} {unit}"


def _path(runs: Sequence[RunData], width: float | None) -> Figure:
    figure = _figure(width or 5.0, 0.92 * (width or 5.0))
    _path_panel(figure.subplots(), runs)
    return figure


def _map(runs: Sequence[RunData], width: float | None) -> Figure:
    rows, columns = (len(runs), 1) if _is_column(width) else (1, len(runs))
    width = width or 5.0 * columns
    figure = _figure(width, 0.96 * width / columns * rows)
    for axis, run, colour in zip(figure.subplots(rows, columns, squeeze=False).ravel(), runs, _colours(runs)):
        _map_panel(axis, run, colour)
    return figure


def _errors(runs: Sequence[RunData], width: float | None) -> Figure:
    figure = _figure(width or 6.0, _errors_height(width) if width else 4.8)
    _error_panels(figure.subplots(3, 1, sharex=True), runs)
    return figure


def _time(runs: Sequence[RunData], width: float | None) -> Figure:
    figure = _figure(width or 6.0, _time_height(runs))
    _time_panel(figure.subplots(), runs)
    return figure


#: Figures by name.
KINDS: dict[str, Callable[[Sequence[RunData], float | None], Figure]] = {
    "summary": _summary, "path": _path, "map": _map, "errors": _errors, "time": _time,
}  # fmt: skip


def _is_column(width: float | None) -> TypeGuard[float]:
    """Whether a width [in] is that of a column, in which panels stand one below the other."""
    return width is not None and width < _COLUMN


def _errors_height(width: float) -> float:
    return max(0.8 * width, 3.8)  # below which the labels of the three axes overlap


def _time_height(runs: Sequence[RunData]) -> float:
    return 1.9 + 0.4 * len(runs)


def _path_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """The paths from above, in the world of the first run, and the true one."""
    paths, truth = _in_one_world(runs)
    if truth is not None:
        axis.plot(*truth.positions[:, [0, 2]].T, "--", color=_TRUTH, lw=1.0, label="true path", zorder=3)
    for colour, width, run, path in zip(_colours(runs), figures.widths(len(runs), 2.0), runs, paths):
        figures.draw_path(axis, run, path, run.name, color=colour, lw=width, alpha=0.75)
        axis.plot(*path.positions[:1, [0, 2]].T, "o", color=colour, ms=4)
        if figures.is_revised(run):
            final = path.poses[0] @ inverse(run.online.poses[0]) @ run.final.poses
            axis.plot(*final[:, [0, 2], 3].T, ":", color=colour, lw=0.7 * width, label=f"{run.name}, final")
    _set_title(axis, "Path from above, online unless said otherwise (dot: start)")
    axis.set(xlabel="right [m]", ylabel="forward [m]")
    shown = paths if truth is None else [*paths, truth]
    if not figures.stretch(axis, np.concatenate([path.positions[:, [0, 2]] for path in shown])):
        axis.set_aspect("equal", adjustable="datalim")
    axis.legend(frameon=False)
    axis.grid(color="0.9", lw=0.5)


def _colours(runs: Sequence[RunData]) -> list[str]:
    return backend_colours([run.backend for run in runs])


def _map_panel(axis: Axes, run: RunData, colour: str) -> None:
    """The map from above with ellipses."""
    figures.draw_map(axis, run, run.truth, colour)
    _widen(axis)
    axis.set_ylim(top=axis.get_ylim()[0] + _HEADROOM * float(np.ptp(axis.get_ylim())))
    known, every = len(figures.well_known(run)), len(run.positions)
    shown = "2σ ellipses" if known == every else f"2σ ellipses of the {known} that are well known"
    _set_title(axis, f"Map of {run.name}: {every} landmarks, {shown}")
    axis.legend(loc="upper left", ncols=2, fontsize="small", frameon=True, framealpha=0.8, edgecolor="none")


def _widen(axis: Axes, ratio: float = 1.15) -> None:
    """Widen the limits of one direction until width over height are about those of the panel."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    width, height = right - left, top - bottom
    wider, higher = max(0.0, ratio * height - width) / 2, max(0.0, width / ratio - height) / 2
    axis.set(xlim=(left - wider, right + wider), ylim=(bottom - higher, top + higher))


def _error_panels(axes: Sequence[Axes], runs: Sequence[RunData]) -> None:
    """Errors of the position with the claimed ±3σ; where no truth is known the claimed σ alone."""
    known = any(run.truth is not None for run in runs)
    series = [_errors_of(run) for run in runs]
    shown = [error if known else sigma for _, error, sigma in series]
    factor, unit = _unit(max((float(np.nanmax(np.abs(values), initial=0.0)) for values in shown), default=0.0))
    styles = zip(_colours(runs), repeated(DASHES, len(runs)), figures.widths(len(runs), 1.1))
    for (colour, dashes, width), run, (time, error, sigma) in zip(styles, runs, series):
        untracked = (run.online.stamps - run.online.stamps[:1])[~run.measured]
        for axis, e, s in zip(axes, factor * error.T, factor * sigma.T):
            if known:
                axis.fill_between(time, -3 * s, 3 * s, color=colour, alpha=0.12, lw=0)
                for side in (-3, 3):
                    axis.plot(time, side * s, color=colour, alpha=0.6, lw=0.6 * width, ls=dashes)
            if run.truth is not None or not known:
                axis.plot(time, e if known else s, color=colour, lw=width, label=run.name)
            if len(untracked):
                label = f"{run.name}, not tracked"
                axis.plot(untracked, np.zeros(len(untracked)), "x", ms=4, color=colour, label=label)
    for axis, name in zip(axes, _AXES):
        axis.set_ylabel(f"{name} [{unit}]" if known else f"σ {name} [{unit}]")
        axis.axhline(0, color="0.6", lw=0.5)
        axis.margins(x=0.01)
    turned = ", truth turned to fit" if any(run.truth is not None and not run.truth_is_exact for run in runs) else ""
    errors = f"Error of the online position{turned}; band: ±3σ as claimed"
    _set_title(axes[0], errors if known else "No true path is known, so no errors: claimed σ of the online position")
    axes[-1].set_xlabel("time [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    if len(handles) > 1:  # a line alone is that of the one run
        _legend_below(axes[0], handles, labels)


def _time_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """Median time of a frame of each run, but for its first frame, which may wait for compilers, and its stages.

    Medians of stages do not add up to that of a frame: they are drawn in proportion.
    """
    rows = np.arange(len(runs))[::-1]
    left = np.zeros(len(runs))
    totals = np.array([_median_of_later(np.sum(list(run.milliseconds.values()), axis=0)) for run in runs])
    names = stages(runs[0].milliseconds)
    parts = np.array([[_median_of_later(run.milliseconds[stage]) for run in runs] for stage in names])
    parts *= totals / np.maximum(parts.sum(axis=0), 1e-12)
    for stage, width in zip(names, parts):
        if width.any():
            axis.barh(rows, width, left=left, height=0.6, color=stage_colour(stage), label=stage_name(stage))
        left += width
    for row, end, total in zip(rows, left, totals):
        axis.text(end, row, f" {total:.0f} ms" if total >= 100 else f" {total:.3g} ms", va="center", fontsize="small")
    axis.set_yticks(rows, [run.name for run in runs])
    axis.set(xlim=(0, 1.25 * max(float(left.max()), 1e-3)), xlabel="time per frame [ms]")
    margin = 0.7 if len(runs) > 1 else 1.2
    axis.set(ylim=(-margin, len(runs) - 1 + margin))
    _set_title(axis, "Median time of a frame, and the shares of its stages")
    _legend_below(axis, *axis.get_legend_handles_labels())


def _median_of_later(times: np.ndarray) -> float:
    """The median of all frames but the first."""
    return float(np.median(times[1:] if len(times) > 1 else times))


def _errors_of(run: RunData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, error and standard deviation; without truth the error is zero."""
    if run.truth is not None:
        return figures.position_errors(run, run.truth)
    stamps = run.online.stamps
    return stamps - stamps[0], np.zeros((len(stamps), 3)), run.deviations


def _in_one_world(runs: Sequence[RunData]) -> tuple[list[Trajectory], Trajectory | None]:
    """The online paths in the world of the first run that has a truth, and that truth; as they are where none has."""
    first = next((run for run in runs if run.truth is not None), None)
    if first is None or first.truth is None:
        return [run.online for run in runs], None
    to_first = figures.place_of_truth(first, first.truth)
    paths = []
    for run in runs:
        if run is first or run.truth is None:
            paths.append(run.online)
            continue
        in_truth = inverse(figures.place_of_truth(run, run.truth)) @ run.online.poses
        paths.append(Trajectory(run.online.stamps, to_first @ in_truth))
    return paths, Trajectory(first.truth.stamps, to_first @ first.truth.poses)


def _unit(largest: float) -> tuple[float, str]:
    """Factor and name of the unit in which a length of so many metres reads best."""
    return (1.0, "m") if largest > 1 else (100.0, "cm") if largest > 0.01 else (1000.0, "mm")


def _title(runs: Sequence[RunData]) -> str:
    """Sequence, frames, and how many of these were not tracked; the first one never is."""
    lost = {run.name: sum(status != "tracked" for status in run.status[1:]) for run in runs}
    frames = ", ".join(dict.fromkeys(f"{len(run.status)} frames" for run in runs))
    frames += "".join(f"; {name}: {count} not tracked" for name, count in lost.items() if count)
    return f"{runs[0].sequence}: {frames}"


def _set_title(axis: Axes, text: str) -> None:
    """A title in as many lines as it takes."""
    axis.set_title(_wrapped(text, _width(axis)))


def _width(axis: Axes) -> float:
    """Width of a panel with what stands beside it [in]."""
    figure, grid = axis.figure, axis.get_gridspec()
    return float(figure.bbox.width / figure.dpi) / (1 if grid is None else grid.ncols)


def _legend_below(axis: Axes, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """A legend below a panel in as many columns as there is room for, all of it inside the picture."""
    columns = max(1, int(_width(axis) / (0.5 + 0.07 * max(map(len, labels), default=1))))
    axis.figure.legend(handles, labels, loc="outside lower center", ncols=min(5, columns), frameon=False)


def _wrapped(text: str, width: float) -> str:
    """A text in lines of titles so wide [in]."""
    from matplotlib import rcParams

    return textwrap.fill(text, int(72 * width / (_LETTER * rcParams["axes.titlesize"])))


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
