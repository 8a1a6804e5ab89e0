"""``slam plot`` and the picture of a run: path, map, errors and times, of one run or of several of one sequence.

Drawn without pyplot: there is no state to share, and it is loaded faster. Landmarks are told apart by how light they
are: dark where they are seen now, light where they have left the map.
"""

from __future__ import annotations

import logging
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.errors import ConfigurationError, SlamError
from slam.files import noting_inputs, whole_file
from slam.geometry.se3 import Array, inverse, transform
from slam.geometry.stamps import pair
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.naming import unknown
from slam.outputs import Output, require_outputs
from slam.run.results import facts, number
from slam.run.run_data import RunData, place_of_truth, pose_errors, well_known
from slam.run.schema import STAGE_NAMES, body_colour
from slam.runtime.memory import give_back_freed_memory

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

#: Dark below, light above: ekf and window often coincide, and both should be seen.
_BACKENDS = {"ekf": "#0d47a1", "smoother": "#ef6c00", "batch": "#6a1b9a", "window": "#26c6da", "iekf": "#ad1457"}
_OTHERS = ("#2e7d32", "#c62828", "#5d4037", "#9e9d24")
_TRUTH, _BEFORE, _NOT_NOW, _NOW = "0.3", "0.8", "#9fa8da", "#283593"
_DOUBT = "#c62828"
_LOOPS = ("o", "k", "loops closed"), ("x", _DOUBT, "loops refused")
_NAME = 2.0  # [in] room for a mark and its name
_SIGMAS = 2.0  # size of ellipses
_DECADES = 2.5  # of errors, at most: smaller ones are where an error changes its sign
_STANDS = 0.01  # [m] within which a camera that stands is estimated
_LEAST_SHARE = 0.002  # of the longest time: a stage below it is not seen, and not named


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
    require_outputs([Output(file, "--out")], inputs, overwrite)
    plot(runs, file, kind)
    return file


def leave_picture(folder: Path) -> None:
    """The picture of a run that has just ended; where there is nothing to draw a warning says so."""
    give_back_freed_memory()
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
    """Draw runs of one sequence into a PNG, PDF or SVG by the suffix of `path`, a picture of one of the `KINDS`.

    Another file there is overwritten. Raises SlamError where format or kind is unknown, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in _METADATA:
        raise SlamError(f"{path}: a picture is a file .png, .pdf or .svg")
    if kind not in KINDS:
        raise SlamError(unknown("figure", kind, KINDS))
    from matplotlib import rc_context

    figure = drawn(runs, kind)
    with whole_file(path) as file, rc_context(_STYLE):
        metadata = {"Title": _title(runs), **_METADATA[suffix]}
        figure.savefig(file, format=suffix[1:], dpi=110, metadata=metadata)


def drawn(runs: Sequence[RunData], kind: str) -> Figure:
    """A picture."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    maps = [f"map {k}" for k in range(len(runs[:_MOST_MAPS] if kind == "summary" else runs))]
    wide = max(10.0, 4.4 * (1 + len(maps))) if kind == "summary" else 5.0 * len(maps) if kind == "map" else 5.2
    below: list[Any] = [["position", "time"], ["rotation", "time"]]
    # names of panels, nested ones with margins of their own, and heights of the rows [in]
    layouts: dict[str, tuple[list[Any], list[float]]] = {
        "summary": ([[[["path", *maps]]], ["key"], [below]], [wide / (1 + len(maps)), 0.5, 4.2]),
        "map": ([maps, ["key"] * len(maps)], [5.0, 0.5]),
        "path": ([["path"]], [4.8]),
        "errors": ([["position"], ["rotation"]], [1.8, 1.8]),
        "time": ([["time"]], [2.6]),
    }
    rows, heights = layouts[kind]
    brief = len(runs) > 1
    lines = [_title(runs), *(f"{run.name}: {text}" for run in runs if (text := facts(run.summary, brief)))]
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
            doubted = any(run.summary.get("doubt") for run in runs)
            figure.suptitle(head, x=0.01, ha="left", color=_DOUBT if doubted else "k")
    return figure


def _title(runs: Sequence[RunData]) -> str:
    """Sequence, frames, and how many of these were not tracked; the first one never is."""
    lost = {run.name: sum(status != "tracked" for status in run.status[1:]) for run in runs}
    frames = f"{' and '.join(dict.fromkeys(str(len(run.status)) for run in runs))} frames"
    frames += "".join(f"; {name}: {count} not tracked" for name, count in lost.items() if count)
    return f"{runs[0].sequence.partition('?')[0]}: {frames}"


# ------------------------------------------------------------------------------------------------ path and map


def _coloured(runs: Sequence[RunData]) -> list[tuple[RunData, str, float]]:
    """Runs with their colours and widths of lines: where lines coincide, each is seen beside the one drawn over it.

    A built-in back end has the same colour in all pictures, in whatever order. Others, and further runs of the same
    back end, have the next colour that is left.
    """
    names = [run.backend for run in runs]
    left = cycle([*_OTHERS, *(colour for name, colour in _BACKENDS.items() if name not in names)])
    own = dict(_BACKENDS)
    colours = [own.pop(name) if name in own else next(left) for name in names]
    return list(zip(runs, colours, 1.2 + 1.2 * np.arange(len(runs))[::-1]))


def draw_paths(axis: Axes, runs: Sequence[RunData]) -> None:
    """The paths, in the world of the first run that has a truth, and its true one.

    From above, or from the side where the camera moves most up and down.
    """
    first = next((run for run in runs if run.truth is not None), None)
    paths: dict[str, list[Array]] = {}
    to_first = np.eye(4) if first is None else place_of_truth(first)
    truths = [run.truth for run in runs if run.truth is not None]
    differ = not all(_agree(truths[0], other) for other in truths[1:])
    truth = (to_first @ truths[0].poses)[:, :3, 3] if truths and not differ else None
    for run in runs:
        T = np.eye(4) if run.truth is None or run is first else to_first @ inverse(place_of_truth(run))
        paths[run.name] = [(T @ path.poses)[:, :3, 3] for path in (run.online, run.final)]
    every = np.concatenate([*(online for online, _ in paths.values()), *([] if truth is None else [truth])])
    extent = np.ptp(every, axis=0)
    factor, unit = _unit(float(extent.max()))
    shown = [0, 2] if extent[1] < extent.max() else [0 if extent[0] > extent[2] else 2, 1]
    signs = factor * np.array([1.0, 1.0 if shown[1] == 2 else -1.0])  # y points down
    if truth is not None:
        axis.plot(*(signs * truth[:, shown]).T, "--", color=_TRUTH, lw=1.0, label="true path", zorder=3)
    for run, colour, width in _coloured(runs):
        online, final = (signs * points[:, shown] for points in paths[run.name])
        axis.plot(*np.where(run.measured[:, None], online, np.nan).T, color=colour, lw=1.2 * width, alpha=0.75,
                  label=run.name)  # fmt: skip
        if not run.measured.all():
            axis.plot(*online.T, ":", color=colour, lw=1, alpha=0.75, label=f"{run.name}, not tracked")
        axis.plot(*online[:1].T, "o", color=colour, ms=4)
        if not (len(final) == len(online) and np.allclose(final, online, rtol=0, atol=1e-6 * factor)):
            axis.plot(*final.T, ":", color=colour, lw=1.5, label=f"{run.name}, final")
    across, ahead = (f"{('right', 'up', 'forward')[k]} [{unit}]" for k in shown)
    view = "above" if shown[1] == 2 else "the side"
    title = f"Path from {view}, online (dot: start){'; true paths differ' if differ else ''}"
    if not any(run.measured[1:].any() for run in runs):
        title = "No path: no frame after the first was tracked"
    elif extent.max() < _STANDS:
        title = f"The camera stands: all within {number(factor * float(extent.max()))} {unit}"
    axis.set(title=title, xlabel=across, ylabel=ahead)
    if not extent.any():
        axis.update_datalim([(-1.0, -1.0), (1.0, 1.0)])
        axis.autoscale_view()
    axis.set_aspect("equal", adjustable="datalim")
    axis.legend(framealpha=0.8)
    axis.locator_params(axis="x", nbins=6)
    axis.grid(color="0.9", lw=0.5)


def _agree(one: Trajectory, other: Trajectory) -> bool:
    """Whether two true paths have stamps in common, and the same positions then."""
    rows = pair(one.stamps, other.stamps, 1e-6)
    both = rows >= 0
    return bool(both.any()) and np.allclose(one.positions[both], other.positions[rows[both]], atol=1e-6)


def _unit(largest: float) -> tuple[float, str]:
    """A unit for lengths up to `largest` [m], and what metres are multiplied by."""
    return (1.0, "m") if largest > 1 else (100.0, "cm") if largest > 0.01 else (1000.0, "mm")


def draw_maps(axes: Sequence[Axes], runs: Sequence[RunData], key: Axes) -> None:
    """Each run's map from above; in the panel `key` what the marks are."""
    names: dict[str, Any] = {}
    limits: list[Array] = []
    for axis, (run, colour, _) in zip(axes, _coloured(runs)):
        limits.append(_draw_map(axis, run, colour))
        handles, labels = axis.get_legend_handles_labels()
        names |= dict(zip(labels, handles))
    (left, bottom), (right, top) = np.min(limits, axis=0)[0], np.max(limits, axis=0)[1]
    for axis in axes[: len(limits)]:  # of all maps, so that they can be compared
        axis.set(xlim=(left, right), ylim=(bottom, top))
    key.axis("off")
    columns = max(1, int(key.get_figure(root=True).get_figwidth() / _NAME))  # type: ignore[union-attr]
    key.legend(list(names.values()), list(names), loc="center", ncols=columns, frameon=False, markerscale=1.5)


def _draw_map(axis: Axes, run: RunData, colour: str) -> Array:
    """One map; returns limits (2, 2) that hold the path and the well-known landmarks with their ellipses."""
    from matplotlib.collections import EllipseCollection

    known, plane = well_known(run), run.covariances[:, [0, 2]][:, :, [0, 2]]
    values, vectors = np.linalg.eigh(plane.reshape(-1, 2, 2))
    width = 2 * _SIGMAS * np.sqrt(np.maximum(values, 0))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    if len(run.old):
        axis.plot(*run.old[:, [0, 2]].T, ".", ms=2, color=_BEFORE, label="landmarks that have left")
    for rows, shade, label in ((~run.seen_last, _NOT_NOW, "not seen now"), (run.seen_last, _NOW, "seen now")):
        sure = known[rows[known]]
        axis.add_collection(EllipseCollection(
            width[sure, 1], width[sure, 0], angle[sure], units="xy", offsets=run.positions[sure][:, [0, 2]],
            offset_transform=axis.transData, facecolors="none", edgecolors=shade, linewidths=0.8,
        ))  # fmt: skip
        axis.plot(*run.positions[rows][:, [0, 2]].T, ".", ms=4, color=shade, label=f"landmarks {label}")
    final = run.final.positions[:, [0, 2]]
    axis.plot(*final.T, color=colour, lw=2, label=f"path of {run.name}, final")
    for rows, (mark, shade, label) in zip((run.loops, run.refused), _LOOPS):
        if len(rows):
            axis.plot(*final[rows[:, 0]].T, mark, ms=6, mfc="none", color=shade, label=label)
    for body, positions in run.bodies.items():
        rgb = np.array(body_colour(int(body))) / 255
        axis.plot(*positions[:, [0, 2]].T, "-s", ms=5, lw=1.5, markevery=[-1], color=rgb, label=f"body {body}")
    paths = [run.online.positions, run.final.positions, *run.bodies.values()]
    if run.truth is not None:
        paths.append(transform(place_of_truth(run), run.truth.positions))
        axis.plot(*paths[-1][:, [0, 2]].T, "--", color=_TRUTH, lw=1.0, label="true path")
    near = np.linalg.norm(run.old - run.centre, axis=1) < run.reach
    points = np.concatenate([run.positions[known], *paths, run.old[near]])[:, [0, 2]]
    around = np.zeros_like(points)
    around[: len(known)] = _SIGMAS * np.sqrt(np.diagonal(run.covariances[known], axis1=1, axis2=2)[:, [0, 2]])
    low, high = (points - around).min(axis=0), (points + around).max(axis=0)
    half = 0.55 * float((high - low).max()) + 0.1
    sure = "" if len(known) == len(run.positions) else f" of {len(known)}"  # the others would cover these
    title = f"{run.name}: {len(run.positions)} landmarks, 2σ ellipses{sure}"
    axis.set(title=title, xlabel="right [m]", ylabel="forward [m]", aspect="equal")
    return np.array([(low + high) / 2 - half, (low + high) / 2 + half])


# --------------------------------------------------------------------------------------------- errors and times


def draw_errors(axes: Sequence[Axes], runs: Sequence[RunData]) -> None:
    """Errors of position and rotation, and the σ that is claimed; that alone where no true path is known.

    Where the true path has errors of its own, the σ of both together is shown, too. Where the first true poses are
    missing or doubtful, the title says since when errors count: σ counts from the start, see `pose_errors`.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator

    series = [pose_errors(run) for run in runs]
    known = any(run.truth is not None for run in runs)
    factor, unit = _unit(max(float(np.nanmax(both[:, 0], initial=0.0)) for _, *pair in series for both in pair))
    for k, (axis, name, times) in enumerate(zip(axes, (f"position [{unit}]", "rotation [deg]"), (factor, 1.0))):
        for (run, colour, width), (time, error, sigma, expected) in zip(_coloured(runs), series):
            if run.truth is not None:
                axis.plot(time, times * error[:, k], color=colour, lw=0.7 * width)
            axis.plot(time, times * sigma[:, k], "--", color=colour, lw=0.7 * width)
            if run.truth is not None and run.truth_noise != TruthNoise():
                axis.plot(time, times * expected[:, k], ":", color=colour, lw=0.7 * width)
            every = run.online.stamps - run.online.stamps[:1]
            for start in every[~run.measured]:
                axis.axvspan(start, start, color=colour, alpha=0.2)
            for start in every[~np.isin(every, time)]:
                axis.axvspan(start, start + 1.1 * np.median(np.diff(every)), color="0.92", lw=0, zorder=0)
        curves = [np.asarray(line.get_ydata()) for line in axis.lines]
        values = np.concatenate(curves)
        values = values[values > 0]
        if len(values):
            axis.set_yscale("log", nonpositive="clip")  # a curve goes down to the axis
            top = (2.0 if k or len(runs) == 1 else 6.0) * float(values.max())  # room for a legend
            lowest = min(float(np.median(curve)) for curve in curves)
            bottom = max(0.7 * float(values.min()), min(top * 10.0**-_DECADES, 0.3 * lowest))
            axis.set_ylim(bottom, top)
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if top < 100 * bottom else (1,)))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("")
        axis.set_ylabel(name)
        axis.grid(color="0.9", lw=0.5)
        end = max(float(np.ptp(run.online.stamps)) for run in runs)  # also where the truth begins later
        axis.set_xlim(-0.01 * end, 1.01 * end or 1.0)
    axes[0].tick_params(labelbottom=False)
    measured = [run for run in runs if run.truth is not None and not run.truth_is_exact]
    late = dict.fromkeys(number(time[0]) for run, (time, *_) in zip(runs, series) if run.truth is not None and time[0])
    title = "Online error since the start (solid), claimed σ (dashed)"
    if late:
        title = f"Online error since {' or '.join(late)} s (solid), claimed σ since 0 s (dashed):"
        title += "\ncompare them only where σ is far above its first value"
    if measured:
        exact = all(run.truth_noise == TruthNoise() for run in measured)
        title += "\nthe truth counts as exact" if exact else "\nσ with that of the truth (dotted)"
    if known and any(len(time) < len(run.online) for run, (time, *_) in zip(runs, series)):
        title += "; grey: no sure truth"
    if any(run.summary.get("truth_doubt") for run in runs):
        title += "\nthe true path and the estimated one do not fit"
    axes[0].set_title(title if known else "Claimed σ of the online pose; no true path is known")
    axes[-1].set_xlabel("time [s]")
    if len(runs) > 1:
        colours = [Line2D([], [], color=colour) for _, colour, _ in _coloured(runs)]
        axes[0].legend(colours, [run.name for run in runs], framealpha=0.8, ncols=3, loc="upper left")


def draw_times(axis: Axes, runs: Sequence[RunData]) -> None:
    """Median time of each stage of a frame, but for the first frame, which may wait for compilers."""
    later = [{name: ms[1:] if len(ms) > 1 else ms for name, ms in run.milliseconds.items()} for run in runs]
    totals = [float(np.median(np.sum(list(times.values()), axis=0))) for times in later]
    medians = {stage: [float(np.median(times[stage])) for times in later] for stage in STAGE_NAMES if stage in later[0]}
    stages = [stage for stage, values in medians.items() if max(values) > _LEAST_SHARE * max(*totals, 1e-9)]
    high = 0.8 / len(runs)
    for i, ((run, colour, _), total) in enumerate(zip(_coloured(runs), totals)):
        at = np.arange(len(stages)) + (i - (len(runs) - 1) / 2) * high
        label = f"{run.name}: {number(total)} ms"
        axis.barh(at, [medians[stage][i] for stage in stages], height=high, color=colour, label=label)
    axis.set_yticks(range(len(stages)), [STAGE_NAMES[stage] for stage in stages])
    axis.invert_yaxis()
    axis.set(title="Median time of a frame", xlabel="time [ms]")
    axis.legend(framealpha=0.8, loc="lower right")
