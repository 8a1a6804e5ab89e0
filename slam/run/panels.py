"""The panels of a run's picture: paths and maps from above, errors and times, of one run or of several."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from slam.geometry.se3 import inverse
from slam.geometry.trajectory import Trajectory
from slam.run.figures import draw_map, draw_path, is_revised, place_of_truth, pose_errors, stretch, well_known, widths
from slam.run.run_data import RunData
from slam.run.schema import STAGE_NAMES
from slam.run.style import DASHES, STAGE_COLOURS, backend_colours

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

_LETTER = 0.6  # mean width of a letter in sizes of the font
_TRUTH = "0.25"
_AXES = ("right", "down", "forward", "rotation")
_HEADROOM = 1.2  # height of a map over that of what it shows: room for the legend


def path_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """The paths from above, in the world of the first run, and the true one."""
    paths, truth = in_one_world(runs)
    if truth is not None:
        axis.plot(*truth.positions[:, [0, 2]].T, "--", color=_TRUTH, lw=1.0, label="true path", zorder=3)
    for colour, width, run, path in zip(colours(runs), 2.0 * widths(len(runs)), runs, paths):
        draw_path(axis, run, path, run.name, color=colour, lw=width, alpha=0.75)
        axis.plot(*path.positions[:1, [0, 2]].T, "o", color=colour, ms=4)
        if is_revised(run):
            final = path.poses[0] @ inverse(run.online.poses[0]) @ run.final.poses
            axis.plot(*final[:, [0, 2], 3].T, ":", color=colour, lw=0.7 * width, label=f"{run.name}, final")
    set_title(axis, "Path from above, online unless said otherwise (dot: start)")
    axis.set(xlabel="right [m]", ylabel="forward [m]")
    shown = paths if truth is None else [*paths, truth]
    if not stretch(axis, np.concatenate([path.positions[:, [0, 2]] for path in shown])):
        axis.set_aspect("equal", adjustable="datalim")
    axis.legend(frameon=False)
    axis.grid(color="0.9", lw=0.5)


def colours(runs: Sequence[RunData]) -> list[str]:
    """A colour for each run."""
    return backend_colours([run.backend for run in runs])


def map_panel(axis: Axes, run: RunData, colour: str) -> None:
    """The map from above with ellipses."""
    draw_map(axis, run, colour)
    _widen(axis)
    axis.set_ylim(top=axis.get_ylim()[0] + _HEADROOM * float(np.ptp(axis.get_ylim())))
    known, every = len(well_known(run)), len(run.positions)
    shown = "2σ ellipses" if known == every else f"2σ ellipses of {known}"  # the others would cover these
    set_title(axis, f"Map of {run.name}: {every} landmarks, {shown}")
    axis.legend(loc="upper left", ncols=2, fontsize="small", frameon=True, framealpha=0.8, edgecolor="none")


def _widen(axis: Axes, ratio: float = 1.15) -> None:
    """Widen the limits of one direction until width over height are about those of the panel."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    width, height = right - left, top - bottom
    wider, higher = max(0.0, ratio * height - width) / 2, max(0.0, width / ratio - height) / 2
    axis.set(xlim=(left - wider, right + wider), ylim=(bottom - higher, top + higher))


def error_panels(axes: Sequence[Axes], runs: Sequence[RunData]) -> None:
    """Errors of position and rotation with the claimed ±3σ; where no truth is known the claimed σ alone."""
    known = any(run.truth is not None for run in runs)
    series = [pose_errors(run) for run in runs]
    shown = [(error if known else sigma)[:, :3] for _, error, sigma in series]
    factor, unit = unit_of(max((float(np.nanmax(np.abs(values), initial=0.0)) for values in shown), default=0.0))
    factors = np.array([factor, factor, factor, 1.0])
    for i, (run, colour, (time, error, sigma)) in enumerate(zip(runs, colours(runs), series)):
        dashes, width = DASHES[i % len(DASHES)], 1.1 * widths(len(runs))[i]
        untracked = (run.online.stamps - run.online.stamps[:1])[~run.measured]
        for k, (axis, e, s) in enumerate(zip(axes, (factors * error).T, (factors * sigma).T)):
            if known:
                low = -3 * s if k < 3 else 0 * s  # an angle has no sign
                axis.fill_between(time, low, 3 * s, color=colour, alpha=0.12, lw=0)
                for side in (low, 3 * s)[k == 3 :]:
                    axis.plot(time, side, color=colour, alpha=0.6, lw=0.6 * width, ls=dashes)
            if run.truth is not None or not known:
                axis.plot(time, e if known else s, color=colour, lw=width, label=run.name)
            if len(untracked):
                label = f"{run.name}, not tracked"
                axis.plot(untracked, np.zeros(len(untracked)), "x", ms=4, color=colour, label=label)
    for axis, name, of in zip(axes, _AXES, (unit, unit, unit, "deg")):
        axis.set_ylabel(f"{name} [{of}]" if known else f"σ {name} [{of}]")
        axis.axhline(0, color="0.6", lw=0.5)
        axis.margins(x=0.01)
    turned = ", truth turned to fit" if any(run.truth is not None and not run.truth_is_exact for run in runs) else ""
    errors = f"Error of the online pose{turned}; band: ±3σ as claimed"
    set_title(axes[0], errors if known else "No true path is known, so no errors: claimed σ of the online pose")
    axes[-1].set_xlabel("time [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    if len(handles) > 1:  # a line alone is that of the one run
        _legend_below(axes[0], handles, labels)


def time_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """Median time of a frame of each run, but for its first frame, which may wait for compilers, and its stages.

    Medians of stages do not add up to that of a frame: they are drawn in proportion.
    """
    rows = np.arange(len(runs))[::-1]
    left = np.zeros(len(runs))
    totals = np.array([_median_of_later(np.sum(list(run.milliseconds.values()), axis=0)) for run in runs])
    names = [stage for stage in STAGE_COLOURS if stage in runs[0].milliseconds]
    parts = np.array([[_median_of_later(run.milliseconds[stage]) for run in runs] for stage in names])
    parts *= totals / np.maximum(parts.sum(axis=0), 1e-12)
    for stage, width in zip(names, parts):
        if width.any():
            axis.barh(rows, width, left=left, height=0.6, color=STAGE_COLOURS[stage], label=STAGE_NAMES[stage])
        left += width
    for row, end, total in zip(rows, left, totals):
        axis.text(end, row, f" {total:.0f} ms" if total >= 100 else f" {total:.3g} ms", va="center", fontsize="small")
    axis.set_yticks(rows, [run.name for run in runs])
    axis.set(xlim=(0, 1.25 * max(float(left.max()), 1e-3)), xlabel="time per frame [ms]")
    margin = 0.7 if len(runs) > 1 else 1.2
    axis.set(ylim=(-margin, len(runs) - 1 + margin))
    set_title(axis, "Median time of a frame, and the shares of its stages")
    _legend_below(axis, *axis.get_legend_handles_labels())


def _median_of_later(times: np.ndarray) -> float:
    """The median of all frames but the first."""
    return float(np.median(times[1:] if len(times) > 1 else times))


def in_one_world(runs: Sequence[RunData]) -> tuple[list[Trajectory], Trajectory | None]:
    """The online paths in the world of the first run that has a truth, and that truth; as they are where none has."""
    first = next((run for run in runs if run.truth is not None), None)
    if first is None or first.truth is None:
        return [run.online for run in runs], None
    to_first = place_of_truth(first, first.truth)
    paths = []
    for run in runs:
        if run is first or run.truth is None:
            paths.append(run.online)
            continue
        in_truth = inverse(place_of_truth(run, run.truth)) @ run.online.poses
        paths.append(Trajectory(run.online.stamps, to_first @ in_truth))
    return paths, Trajectory(first.truth.stamps, to_first @ first.truth.poses)


def unit_of(largest: float) -> tuple[float, str]:
    """Factor and name of the unit in which a length of so many metres reads best."""
    return (1.0, "m") if largest > 1 else (100.0, "cm") if largest > 0.01 else (1000.0, "mm")


def set_title(axis: Axes, text: str) -> None:
    """A title in as many lines as it takes."""
    axis.set_title(wrapped(text, _width(axis)))


def _width(axis: Axes) -> float:
    """Width of a panel with what stands beside it [in]."""
    figure, grid = axis.figure, axis.get_gridspec()
    return float(figure.bbox.width / figure.dpi) / (1 if grid is None else grid.ncols)


def _legend_below(axis: Axes, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """A legend below a panel in as many columns as there is room for, all of it inside the picture."""
    columns = max(1, int(_width(axis) / (0.5 + 0.07 * max(map(len, labels), default=1))))
    axis.figure.legend(handles, labels, loc="outside lower center", ncols=min(5, columns), frameon=False)


def wrapped(text: str, width: float) -> str:
    """A text in lines of titles so wide [in]."""
    from matplotlib import rcParams

    return textwrap.fill(text, int(72 * width / (_LETTER * rcParams["axes.titlesize"])))
