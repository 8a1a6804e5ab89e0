"""The panels of a run's picture: paths and maps from above, errors and times, of one run or of several."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.evaluation.metrics import associate
from slam.geometry.se3 import Array, inverse
from slam.geometry.trajectory import Trajectory
from slam.run.run_data import RunData, place_of_truth, pose_errors, well_known
from slam.run.schema import STAGE_NAMES

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

_BACKENDS = {"ekf": "#1565c0", "smoother": "#ef6c00", "batch": "#6a1b9a", "window": "#00838f", "iekf": "#ad1457"}
_OTHERS = ("#2e7d32", "#c62828", "#5d4037", "#9e9d24")
_STAGES = {
    "read": "#bdbdbd", "extract": "#1565c0", "predict": "#90caf9", "associate": "#ef6c00", "update": "#c62828",
    "estimate": "#f48fb1", "objects": "#6a1b9a", "manage": "#2e7d32", "atlas": "#00838f",
}  # fmt: skip
_TRUTH, _OLD = "0.3", "0.75"
_LANDMARKS = {"not seen now": ("#7cb342", ".", 2.0), "seen now": ("#c62828", "^", 3.5)}  # told apart by shape, too
_CORRECTED, _CLOSED, _REFUSED = "#4527a0", "0.1", "#d81b60"  # what loops do
_BODIES = ("#00838f", "#6a1b9a", "#5d4037", "#ad1457")
_SEEN = 4.0  # a panel of errors reaches so many times as far as the largest one, at most
_DASHES = ("-", "--", ":", "-.")  # around bands: where those of two back ends are equal, both are seen
_STRAIGHT = 12  # a path that is so many times as long as wide looks like a line on one scale
_SIGMAS = 2.0  # size of ellipses
_LETTER = 0.6  # mean width of a letter in sizes of the font
_LEAST_SHARE = 0.002  # of the longest time: a stage below it is not seen, and not named
_MAP_RATIO = 1.15  # width of a map over its height


def backend_colours(backends: Sequence[str]) -> list[str]:
    """A colour for each of the runs in a picture, by the names of their back ends.

    A built-in back end has the same colour in all pictures, in whatever order. Others, and further runs of the same
    back end, have the next colour that is left.
    """
    left = cycle([*_OTHERS, *(colour for name, colour in _BACKENDS.items() if name not in backends)])
    own = dict(_BACKENDS)
    return [own.pop(name) if name in own else next(left) for name in backends]


def widths(count: int) -> Array:
    """Widths of lines (N,), the first the widest: where lines coincide, each is seen beside the one drawn over it."""
    return 1 + 1.2 * np.arange(count)[::-1]


# ------------------------------------------------------------------------------------------------ path and map


def path_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """The paths from above, in the world of the first run that has a truth, and the true one."""
    paths, truth = [run.online for run in runs], None
    first = next((run for run in runs if run.truth is not None), None)
    if first is not None and first.truth is not None:
        to_first = place_of_truth(first, first.truth)
        truth = Trajectory(first.truth.stamps, to_first @ first.truth.poses)
        for i, run in enumerate(runs):
            if run is not first and run.truth is not None:
                there = to_first @ inverse(place_of_truth(run, run.truth)) @ run.online.poses
                paths[i] = Trajectory(run.online.stamps, there)
        axis.plot(*truth.positions[:, [0, 2]].T, "--", color=_TRUTH, lw=1.0, label="true path", zorder=3)
    for colour, width, run, path in zip(_colours(runs), 1.5 * widths(len(runs)), runs, paths):
        _draw_path(axis, run, path, run.name, color=colour, lw=width, alpha=0.75)
        axis.plot(*path.positions[:1, [0, 2]].T, "o", color=colour, ms=4)
        if _is_revised(run):
            final = path.poses[0] @ inverse(run.online.poses[0]) @ run.final.poses
            axis.plot(*final[:, [0, 2], 3].T, ":", color=colour, lw=1.5, label=f"{run.name}, final")
    set_title(axis, "Path from above, online (dot: start)")
    axis.set(xlabel="right [m]", ylabel="forward [m]")
    shown = paths if truth is None else [*paths, truth]
    if not _stretch(axis, np.concatenate([path.positions[:, [0, 2]] for path in shown])):
        axis.set_aspect("equal", adjustable="datalim")
    axis.legend(frameon=True, framealpha=0.8, edgecolor="none")
    axis.locator_params(axis="x", nbins=6)
    axis.grid(color="0.9", lw=0.5)


def map_panels(axes: Sequence[Axes], runs: Sequence[RunData]) -> None:
    """Each run's map from above: landmarks with the ellipses of those well known, path, loops, bodies; one legend."""
    for axis, run, colour in zip(axes, runs, _colours(runs)):
        _draw_map(axis, run, colour)
        known, every = len(well_known(run)), len(run.positions)
        of = "" if known == every else f" of {known}"  # the others would cover these
        set_title(axis, f"{run.name}: {every} landmarks, 2σ ellipses{of}")
    _legend_below(axes)


def _draw_map(axis: Axes, run: RunData, colour: str) -> None:
    """One map, in limits that hold the path and the well-known landmarks with their ellipses."""
    from matplotlib.collections import EllipseCollection

    plane = run.covariances[:, [0, 2]][:, :, [0, 2]]
    values, vectors = np.linalg.eigh(plane) if len(plane) else (np.zeros((0, 2)), np.zeros((0, 2, 2)))
    width = 2 * _SIGMAS * np.sqrt(np.maximum(values, 0))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    known = well_known(run)
    for rows, (label, (shade, mark, size)) in zip((~run.seen_last, run.seen_last), _LANDMARKS.items()):
        sure = known[rows[known]]
        ellipses = EllipseCollection(
            width[sure, 1], width[sure, 0], angle[sure], units="xy", offsets=run.positions[sure][:, [0, 2]],
            offset_transform=axis.transData, facecolors="none", edgecolors=shade, linewidths=0.8,
        )  # fmt: skip
        axis.add_collection(ellipses)
        axis.plot(*run.positions[rows][:, [0, 2]].T, mark, ms=size, color=shade, label=f"landmarks {label}")
    if len(run.old):
        axis.plot(*run.old[:, [0, 2]].T, ".", ms=1.5, color=_OLD, zorder=0, label="landmarks before")
    _draw_path(axis, run, run.online, f"path of {run.name}, online", color=colour, lw=3, alpha=0.6)
    final = run.final.positions[:, [0, 2]]
    if _is_revised(run):
        axis.plot(*final.T, color=_CORRECTED, lw=1.2, label="path, final")
    if len(run.loops):
        axis.plot(*final[run.keyframes].T, ".", ms=3, color=_CORRECTED, label="keyframes")
        axis.plot(*final[run.loops[:, 0]].T, "o", ms=6, mfc="none", color=_CLOSED, label="loops closed")
    if len(run.refused):
        axis.plot(*final[run.refused[:, 0]].T, "x", ms=5, color=_REFUSED, label="loops refused")
    for positions, shade in zip(run.bodies.values(), cycle(_BODIES)):
        axis.plot(*positions[:, [0, 2]].T, "-s", ms=4, lw=1.5, markevery=[-1], color=shade, label="moving bodies")
    if run.truth is not None:
        _, true = associate(run.online, run.truth, 0.02, interpolated=True)
        T = place_of_truth(run, run.truth)
        points = true.positions @ T[:3, :3].T + T[:3, 3]
        axis.plot(*points[:, [0, 2]].T, "--", color=_TRUTH, lw=1.2, label="true path")
    near = np.linalg.norm(run.old - run.centre, axis=1) < run.reach
    points = np.concatenate([run.positions[known], run.online.positions, run.final.positions, run.old[near]])[:, [0, 2]]
    around = np.zeros_like(points)
    around[: len(known)] = _SIGMAS * np.sqrt(np.diagonal(run.covariances[known], axis1=1, axis2=2)[:, [0, 2]])
    low, high = (points - around).min(axis=0), (points + around).max(axis=0)
    across, up = high - low + 0.1 * float((high - low).max()) + 0.2
    half = 0.5 * np.array([max(across, _MAP_RATIO * up), max(up, across / _MAP_RATIO)])
    (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
    axis.set(xlabel="right [m]", ylabel="forward [m]", aspect="equal", xlim=(left, right), ylim=(bottom, top))


def _draw_path(axis: Axes, run: RunData, path: Trajectory, label: str, **style: Any) -> None:
    """A run's path from above in any world; dotted where the camera was not tracked."""
    points = path.positions[:, [0, 2]]
    axis.plot(*np.where(run.measured[:, None], points, np.nan).T, label=label, **style)
    if not run.measured.all():
        axis.plot(*points.T, label=f"{label}, not tracked", **{**style, "lw": 1, "ls": ":"})


def _is_revised(run: RunData) -> bool:
    """Whether the final path is another than the online one."""
    same = len(run.final) == len(run.online)
    return not (same and np.allclose(run.final.poses, run.online.poses, rtol=0, atol=1e-6))


def _stretch(axis: Axes, points: np.ndarray) -> bool:
    """Give each axis a scale of its own where points (N, 2) lie nearly in a line along one; whether it did."""
    extent = np.ptp(points, axis=0)
    narrow = int(np.argmin(extent))
    if not extent[narrow] * _STRAIGHT < extent[1 - narrow]:
        return False
    half = 0.6 * max(float(extent[narrow]), 0.01 * float(extent[1 - narrow]))  # what is straight is not blown up
    middle = float(points[:, narrow].max() + points[:, narrow].min()) / 2
    name, label = "xy"[narrow], (axis.get_xlabel, axis.get_ylabel)[narrow]()
    axis.set(**{f"{name}lim": (middle - half, middle + half), f"{name}label": f"{label}, on a scale of its own"})
    return True


# --------------------------------------------------------------------------------------------- errors and times


def error_panels(axes: Sequence[Axes], runs: Sequence[RunData]) -> None:
    """Errors of position and rotation with ±3σ, that of a truth included; where none is known the claimed σ alone."""
    known = any(run.truth is not None for run in runs)
    series = [pose_errors(run) for run in runs]
    shown = [(error if known else sigma)[:, :3] for _, error, sigma in series]
    largest = max((float(np.nanmax(np.abs(values), initial=0.0)) for values in shown), default=0.0)
    factor, unit = (1.0, "m") if largest > 1 else (100.0, "cm") if largest > 0.01 else (1000.0, "mm")
    factors = np.array([factor, factor, factor, 1.0])
    for i, (run, colour, (time, error, sigma)) in enumerate(zip(runs, _colours(runs), series)):
        dashes, width = _DASHES[i % len(_DASHES)], 0.8 * widths(len(runs))[i]
        untracked = (run.online.stamps - run.online.stamps[:1])[~run.measured]
        for k, (axis, e, s) in enumerate(zip(axes, (factors * error).T, (factors * sigma).T)):
            if known:
                low = -3 * s if k < 3 else 0 * s  # an angle has no sign
                axis.fill_between(time, low, 3 * s, color=colour, alpha=0.12, lw=0)
                for side in (low, 3 * s)[k == 3 :]:
                    axis.plot(time, side, color=colour, alpha=0.7, lw=0.9, ls=dashes)
            if run.truth is not None or not known:
                axis.plot(time, e if known else s, color=colour, lw=width, label=run.name)
            if len(untracked):
                label = f"{run.name}, not tracked"
                axis.plot(untracked, np.zeros(len(untracked)), "x", ms=4, color=colour, label=label)
    cut = False
    for k, (axis, name, of) in enumerate(
        zip(axes, ("right", "down", "forward", "rotation"), (unit, unit, unit, "deg"), strict=True)
    ):
        seen = _SEEN * factors[k] * max(np.nanmax(np.abs(error[:, k]), initial=0.0) for _, error, _ in series)
        if known and 0 < seen < axis.get_ylim()[1]:  # else the error is a flat line in a wide band
            axis.set_ylim(-seen if k < 3 else 0, seen)
            cut = True
        axis.set_ylabel(f"{name} [{of}]" if known else f"σ {name} [{of}]")
        axis.axhline(0, color="0.6", lw=0.5)
        axis.margins(x=0.01)
    measured = any(run.truth is not None and not run.truth_is_exact for run in runs)
    turned, band = (", truth turned to fit", ", with the truth's own errors") if measured else ("", "")
    ends = ", cut where it is far wider" if cut else ""
    errors = f"Error of the online pose{turned}; band: ±3σ as claimed{band}{ends}"
    set_title(axes[0], errors if known else "No true path is known, so no errors: claimed σ of the online pose")
    axes[-1].set_xlabel("time [s]")
    if len(axes[0].get_legend_handles_labels()[0]) > 1:  # a line alone is that of the one run
        _legend_below(axes[:1])


def time_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """Median time of a frame of each run, but for its first frame, which may wait for compilers, and its stages.

    Medians of stages do not add up to that of a frame: they are drawn in proportion.
    """
    rows, left = np.arange(len(runs))[::-1], np.zeros(len(runs))
    later = [{name: ms[1:] if len(ms) > 1 else ms for name, ms in run.milliseconds.items()} for run in runs]
    totals = np.array([np.median(np.sum(list(times.values()), axis=0)) for times in later])
    names = [stage for stage in _STAGES if stage in later[0]]
    parts = np.array([[np.median(times[stage]) for times in later] for stage in names])
    parts *= totals / np.maximum(parts.sum(axis=0), 1e-12)
    for stage, width in zip(names, parts):
        label = STAGE_NAMES[stage] if width.max() > _LEAST_SHARE * totals.max() else "_"
        axis.barh(rows, width, left=left, height=0.6, color=_STAGES[stage], label=label)
        left += width
    for row, end, total in zip(rows, left, totals):
        axis.text(end, row, f" {total:.0f} ms" if total >= 100 else f" {total:.3g} ms", va="center", fontsize="small")
    axis.set_yticks(rows, [run.name for run in runs])
    margin = 0.7 if len(runs) > 1 else 1.2
    right = 1.25 * max(float(left.max()), 1e-3)
    axis.set(xlim=(0, right), xlabel="time per frame [ms]", ylim=(-margin, len(runs) - 1 + margin))
    set_title(axis, "Median time of a frame, by stage")
    _legend_below([axis])


# -------------------------------------------------------------------------------------------- titles and legends


def set_title(axis: Axes, text: str) -> None:
    """A title in as many lines as it takes."""
    figure, grid = axis.figure, axis.get_gridspec()
    columns = 1 if grid is None else grid.ncols
    axis.set_title(wrapped(text, 0.9 * figure.bbox.width / figure.dpi / columns))


def wrapped(text: str, width: float) -> str:
    """A text in lines of titles so wide [in]."""
    from matplotlib import rcParams

    return textwrap.fill(text, int(72 * width / (_LETTER * rcParams["axes.titlesize"])))


def _colours(runs: Sequence[RunData]) -> list[str]:
    return backend_colours([run.backend for run in runs])


def _legend_below(axes: Sequence[Axes]) -> None:
    """One legend below some panels, each name once, in as many columns as there is room for inside the picture."""
    from matplotlib import rcParams

    names: dict[str, Artist] = {}
    for axis in axes:
        names |= {label: handle for handle, label in zip(*axis.get_legend_handles_labels()) if label not in names}
    figure = axes[0].figure
    letters = 72 * figure.bbox.width / figure.dpi / rcParams["legend.fontsize"]  # room, in heights of a letter
    columns = max(1, int(letters / (4.8 + _LETTER * max(map(len, names), default=1))))  # a mark takes 4.8
    figure.legend(list(names.values()), list(names), loc="outside lower center", ncols=min(5, columns), frameon=False)
