"""``slam plot`` and the picture of a run: path, map, errors and times, of one run or of several of one sequence.

Drawn without pyplot: there is no state to share, and it is loaded faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.errors import SlamError
from slam.evaluation.metrics import align, associate
from slam.geometry.trajectory import Trajectory
from slam.naming import unknown
from slam.run.figures import RunData, draw_map, position_errors, well_known, widths

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The picture that a run leaves.
PICTURE = "summary.png"

_COLOURS = ("#1565c0", "#ef6c00", "#6a1b9a", "#00838f", "#2e7d32", "#c62828", "#5d4037", "#9e9d24")
_STAGE_COLOURS = {
    "read": "#bdbdbd", "extract": "#1565c0", "predict": "#90caf9", "associate": "#ef6c00",
    "update": "#c62828", "estimate": "#f48fb1", "objects": "#6a1b9a", "manage": "#2e7d32",
}  # fmt: skip
_BANDS = ("-", "--", ":", "-.")  # lines around bands: of equal ones both are seen
_TRUTH = "0.25"
_AXES = ("right", "down", "forward")
_MOST_MAPS = 3  # side by side in the summary
_STRAIGHT = 12  # a path that is so many times as long as wide looks like a line on one scale
_STYLE: dict[str, Any] = {"font.size": 9, "axes.titlesize": 10, "svg.hashsalt": "slam", "pdf.fonttype": 42}

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


def plot(runs: Sequence[RunData], path: Path, kind: str = "summary") -> None:
    """Draw runs of one sequence into a file.

    Args:
        runs: of the same sequence.
        path: PNG, PDF or SVG by its suffix; another picture there is overwritten.
        kind: one of `KINDS`.

    Raises:
        SlamError: the format or the kind is not known, or the file cannot be written.
    """
    if path.suffix.lower() not in _METADATA:
        raise SlamError(f"{path}: a picture is a file .png, .pdf or .svg")
    if kind not in KINDS:
        raise SlamError(unknown("figure", kind, KINDS))
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with rc_context(_STYLE):
        figure = KINDS[kind](runs)
        FigureCanvasAgg(figure)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=110, metadata={"Title": _title(runs), **_METADATA[path.suffix.lower()]})
        except OSError as error:
            raise SlamError(f"cannot write to {path}: {error.strerror or error}") from error


def _summary(runs: Sequence[RunData]) -> Figure:
    """All at a glance: path and maps above, errors and times below."""
    maps = runs[:_MOST_MAPS]
    figure = _figure(5.0 * (1 + len(maps)), 8.2)
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(4.6, 3.6)))
    first, *others = above.subplots(1, 1 + len(maps))
    _path_panel(first, runs)
    for axis, run in zip(others, maps):
        _map_panel(axis, run)
    left, right = np.asarray(below.subfigures(1, 2))
    _error_panels(left.subplots(3, 1, sharex=True), runs)
    _time_panel(right.subplots(), runs)
    figure.suptitle(_title(runs))
    return figure


def _path(runs: Sequence[RunData]) -> Figure:
    figure = _figure(5.0, 4.6)
    _path_panel(figure.subplots(), runs)
    return figure


def _map(runs: Sequence[RunData]) -> Figure:
    figure = _figure(5.0 * len(runs), 4.8)
    for axis, run in zip(figure.subplots(1, len(runs), squeeze=False)[0], runs):
        _map_panel(axis, run)
    return figure


def _errors(runs: Sequence[RunData]) -> Figure:
    figure = _figure(6.0, 4.8)
    _error_panels(figure.subplots(3, 1, sharex=True), runs)
    return figure


def _time(runs: Sequence[RunData]) -> Figure:
    figure = _figure(6.0, 1.9 + 0.4 * len(runs))
    _time_panel(figure.subplots(), runs)
    return figure


#: Figures by name.
KINDS: dict[str, Callable[[Sequence[RunData]], Figure]] = {
    "summary": _summary, "path": _path, "map": _map, "errors": _errors, "time": _time,
}  # fmt: skip


def _path_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """The paths from above, in the world of the first run, and the true one."""
    paths, truth = _in_one_world(runs)
    if truth is not None:
        axis.plot(*truth.positions[:, [0, 2]].T, "--", color=_TRUTH, lw=1.0, label="true path", zorder=3)
    for colour, width, run, path in zip(_repeated(_COLOURS, len(runs)), widths(len(runs), 2.0), runs, paths):
        axis.plot(*path.positions[:, [0, 2]].T, color=colour, lw=width, alpha=0.75, label=run.name)
        axis.plot(*path.positions[:1, [0, 2]].T, "o", color=colour, ms=4)
    axis.set(title="Path, online, from above (dot: start)", xlabel="right [m]", ylabel="forward [m]")
    if not _stretch(axis, np.concatenate([path.positions[:, [0, 2]] for path in paths])):
        axis.set_aspect("equal", adjustable="datalim")
    axis.legend(fontsize=8, frameon=False)
    axis.grid(color="0.9", lw=0.5)


def _stretch(axis: Axes, points: np.ndarray) -> bool:
    """Give each axis a scale of its own where points (N, 2) lie nearly in a line along one; whether it did."""
    extent = np.ptp(points, axis=0)
    narrow = int(np.argmin(extent))
    if not extent[narrow] * _STRAIGHT < extent[1 - narrow]:
        return False
    half = 0.6 * max(float(extent[narrow]), 0.01 * float(extent[1 - narrow]))  # what is straight is not blown up
    middle = float(points[:, narrow].max() + points[:, narrow].min()) / 2
    if narrow == 0:
        axis.set(xlim=(middle - half, middle + half), xlabel=f"{axis.get_xlabel()}, on a scale of its own")
    else:
        axis.set(ylim=(middle - half, middle + half), ylabel=f"{axis.get_ylabel()}, on a scale of its own")
    return True


def _map_panel(axis: Axes, run: RunData) -> None:
    """The map from above with ellipses."""
    draw_map(axis, run, run.truth)
    _widen(axis)
    known, every = len(well_known(run)), len(run.positions)
    of = "" if known == every else f" of {known}"
    axis.set_title(f"Map of {run.name}: {every} landmarks, 2σ ellipses{of}")
    axis.legend(fontsize=7, frameon=True, framealpha=0.8, edgecolor="none")


def _widen(axis: Axes, ratio: float = 1.15) -> None:
    """Widen the limits of one direction until width over height are about those of the panel."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    width, height = right - left, top - bottom
    wider, higher = max(0.0, ratio * height - width) / 2, max(0.0, width / ratio - height) / 2
    axis.set(xlim=(left - wider, right + wider), ylim=(bottom - higher, top + higher))


def _error_panels(axes: Sequence[Axes], runs: Sequence[RunData]) -> None:
    """Errors of the position with the claimed ±3σ; where no truth is known the band alone."""
    known = any(run.truth is not None for run in runs)
    series = [_errors_of(run) for run in runs]
    shown = [error if known else sigma for _, error, sigma in series]
    factor, unit = _unit(max((float(np.nanmax(np.abs(values), initial=0.0)) for values in shown), default=0.0))
    styles = zip(_repeated(_COLOURS, len(runs)), _repeated(_BANDS, len(runs)), widths(len(runs), 1.1))
    for (colour, dashes, width), run, (time, error, sigma) in zip(styles, runs, series):
        for axis, e, s in zip(axes, factor * error.T, 3 * factor * sigma.T):
            axis.fill_between(time, -s, s, color=colour, alpha=0.12, lw=0)
            label = None if known else run.name
            axis.plot(time, s, color=colour, alpha=0.6, lw=0.6 * width, ls=dashes, label=label)
            axis.plot(time, -s, color=colour, alpha=0.6, lw=0.6 * width, ls=dashes)
            if run.truth is not None:
                axis.plot(time, e, color=colour, lw=width, label=run.name)
    for axis, name in zip(axes, _AXES):
        axis.set_ylabel(f"{name} [{unit}]")
        axis.axhline(0, color="0.6", lw=0.5)
        axis.margins(x=0.01)
    title = "Error of the online position" if known else "Online position, no truth is known"
    turned = ", truth turned to fit" if any(run.truth is not None and not run.truth_is_exact for run in runs) else ""
    axes[0].set_title(f"{title}{turned}; band: ±3σ as claimed")
    axes[-1].set_xlabel("time [s]")
    if known or len(runs) > 1:
        axes[0].legend(fontsize=8, framealpha=0.8, edgecolor="none", ncols=4)


def _time_panel(axis: Axes, runs: Sequence[RunData]) -> None:
    """Median time per frame and stage of each run, but for its first frame, which may wait for compilers."""
    rows = np.arange(len(runs))[::-1]
    left = np.zeros(len(runs))
    for stage in runs[0].milliseconds:
        width = np.array([float(np.median(times[1:] if len(times) > 1 else times)) for times in
                          (run.milliseconds[stage] for run in runs)])  # fmt: skip
        axis.barh(rows, width, left=left, height=0.6, color=_STAGE_COLOURS.get(stage, "0.5"), label=stage)
        left += width
    for row, total in zip(rows, left):
        axis.text(total, row, f" {total:.0f} ms" if total >= 100 else f" {total:.3g} ms", va="center", fontsize=8)
    axis.set_yticks(rows, [run.name for run in runs])
    axis.set(xlim=(0, 1.25 * max(float(left.max()), 1e-3)), xlabel="time per frame [ms]")
    margin = 0.7 if len(runs) > 1 else 1.2
    axis.set(ylim=(-margin, len(runs) - 1 + margin), title="Median time of each stage")
    axis.figure.legend(loc="outside lower center", ncols=5, fontsize=8, frameon=False)


def _errors_of(run: RunData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, error and standard deviation; without truth the error is zero."""
    if run.truth is not None:
        return position_errors(run, run.truth)
    stamps = run.online.stamps
    return stamps - stamps[0], np.zeros((len(stamps), 3)), run.deviations


def _in_one_world(runs: Sequence[RunData]) -> tuple[list[Trajectory], Trajectory | None]:
    """The online paths in the world of the first run that has a truth, and that truth; as they are where none has."""
    first = next((run for run in runs if run.truth is not None), None)
    if first is None or first.truth is None:
        return [run.online for run in runs], None
    own, true = associate(first.online, first.truth, 0.02)
    to_first = align(true, own)
    paths = []
    for run in runs:
        if run is first or run.truth is None:
            paths.append(run.online)
            continue
        own, true = associate(run.online, run.truth, 0.02)
        paths.append(to_first.apply_trajectory(align(own, true).apply_trajectory(run.online)))
    return paths, to_first.apply_trajectory(first.truth)


def _unit(largest: float) -> tuple[float, str]:
    """Factor and name of the unit in which a length of so many metres reads best."""
    return (1.0, "m") if largest > 1 else (100.0, "cm") if largest > 0.01 else (1000.0, "mm")


def _title(runs: Sequence[RunData]) -> str:
    """Sequence, frames, and how many of these were not tracked; the first one never is."""
    lost = {run.name: sum(status != "tracked" for status in run.status[1:]) for run in runs}
    frames = ", ".join(dict.fromkeys(f"{len(run.status)} frames" for run in runs))
    frames += "".join(f"; {name}: {count} not tracked" for name, count in lost.items() if count)
    return f"{runs[0].sequence}: {frames}"


def _repeated(styles: Sequence[str], count: int) -> list[str]:
    return [styles[i % len(styles)] for i in range(count)]


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
