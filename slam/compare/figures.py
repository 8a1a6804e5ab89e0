"""The pictures of a comparison: for its report as SVG texts, for papers as PDF files."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.compare.collect import SERIES_COLUMNS
from slam.compare.measure import Metric
from slam.compare.plan import is_world
from slam.compare.sweep import Run
from slam.compare.tables import Group
from slam.compare.trial import SERIES
from slam.errors import SlamError
from slam.evaluation.metrics import align, associate, chi_square_band
from slam.files import read_numbers
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.naming import printable
from slam.run.figures import stretch, widths
from slam.run.style import DASHES, backend_colours, repeated, stage_colour, stage_name, stages
from slam.sequences import open_sequence
from slam.sequences.faults import said_before

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_TICKS = 15
_WIDTH = 5.2  # [inch] about that of a phone: text stays readable where the picture fills the screen


@dataclass(frozen=True)
class Picture:
    """A picture with what stands below it.

    Attributes:
        name: short, for a file.
        title: a few words.
        caption: a sentence or two, without the measurements, which all pictures of a group share.
        draw: makes it.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[], Figure]


def pictures(group: Group) -> list[Picture]:
    """The pictures of a group, as far as there is truth; none where every run failed."""
    shown = example(group)
    if not shown:
        return []
    trial = next(iter(shown.values())).trial
    of_seed = f", seed {trial.seed}" if is_world(trial.sequence) else ""
    noisy = "" if is_world(trial.sequence) else (
        " The band does not count what is not known of the recorded truth, which NEES does."
    )  # fmt: skip
    known = {metric.key: metric for metric in group.metrics}
    main = known.get("ate_online_m") or known.get("gps_m")
    found = [Picture("paths", "Paths from above", f"Paths from above{of_seed}.", partial(draw_paths, group))]
    if main is not None and group.trials > 1:
        text = f"{main.label}, of every trial; lines join the back ends' runs on the same recording."
        found.insert(0, Picture("trials", main.label, text, partial(draw_pairs, group, main)))
    if "nees_per_dof" in known:
        text = f"Error of the position{of_seed}, and the ±3σ that each back end claims (shaded).{noisy}"
        found.append(Picture("errors", "Error over time", text, partial(draw_errors, group)))
        text = (
            "NEES / 6 from the start over time, mean of the trials; 1 is expected, and the mean of a consistent "
            "estimator is in the shaded band 95 % of the time. Above it, errors are larger than the covariances claim."
        )
        found.append(Picture("nees", "NEES over time", text, partial(draw_nees, group)))
    text = "Time per frame by stage, median of the trials, one thread; it depends on the machine."
    return [*found, Picture("time", "Time per stage", text, partial(draw_timing, group))]


def colours(group: Group) -> dict[str, str]:
    """A colour per back end."""
    return dict(zip(group.runs, backend_colours(list(group.runs))))


def example(group: Group) -> dict[str, Run]:
    """The first trial that every back end completed; else the first completed of each."""
    for k in range(group.trials):
        runs = {backend: group.runs[backend][k] for backend in group.runs}
        if all(run.completed for run in runs.values()):
            return runs
    firsts = {backend: next((r for r in runs if r.completed), None) for backend, runs in group.runs.items()}
    return {backend: run for backend, run in firsts.items() if run is not None}


def read_series(run: Run) -> dict[str, Array]:
    """A run's columns of `SERIES_COLUMNS`.

    Raises:
        SlamError: the file cannot be read, or has no row.
    """
    rows = read_numbers(run.folder / SERIES, len(SERIES_COLUMNS))
    if not len(rows):
        raise SlamError(f"{run.folder / SERIES}: has no row")
    return dict(zip(SERIES_COLUMNS, rows.T))


def paths(run: Run) -> tuple[Trajectory, Trajectory | None]:
    """The path that a run said online (the final one of a replay), and the true one in its axes."""
    file = run.folder / "trajectory.txt"
    own = Trajectory.read_tum(file if file.exists() else run.folder / "trajectory_final.txt")
    with said_before():
        truth = open_sequence(run.trial.source).ground_truth
    if truth is None:
        return own, None
    estimated, true = associate(own, truth, 0.02, interpolated=True)
    return own, align(true, estimated).apply_trajectory(true)


def draw_pairs(group: Group, metric: Metric) -> Figure:
    """Each trial's values, those of the back ends side by side and joined: whether the differences are of one sign."""
    figure, axis = _axes(2.6)
    values = np.array([metric.scale * group.values(name, metric.key) for name in group.runs])
    backends, trials = values.shape
    x = np.arange(trials) + (np.linspace(-0.25, 0.25, backends) if backends > 1 else np.zeros(1))[:, None]
    axis.plot(x, values, color="0.7", lw=1, zorder=1)
    for at, value, (name, colour) in zip(x, values, colours(group).items()):
        axis.plot(at, value, "o", color=colour, ms=4, alpha=0.8, label=name)
    axis.set_xlim(-0.5, trials - 0.5)
    axis.set_xticks(range(0, trials, -(-trials // _MOST_TICKS)))
    axis.set(xlabel="seed", ylabel=metric.title)
    low, high = float(np.nanmin(values, initial=np.inf)), float(np.nanmax(values, initial=1e-9))
    axis.set_ylim(0 if low < 0.5 * high else low - 0.1 * high, 1.1 * high)  # trifles are not blown up
    _legend_above(axis)
    return figure


def draw_paths(group: Group) -> Figure:
    """Top view of the first trial's paths and the true one."""
    figure, axis = _axes(3.6)
    truth = None
    shown = []
    for width, (name, run) in zip(widths(len(group.runs), 1.6), example(group).items()):
        own, true = paths(run)
        truth = true if truth is None else truth
        shown.append(own.positions[:, [0, 2]])
        axis.plot(*own.positions[:, [0, 2]].T, color=colours(group)[name], lw=width, label=name)
    if truth is not None:
        axis.plot(*truth.positions[:, [0, 2]].T, "--", color="0.3", lw=1, label="truth")
        shown.append(truth.positions[:, [0, 2]])
    axis.set(xlabel="right [m]", ylabel="forward [m]")
    if not stretch(axis, np.concatenate(shown)):
        axis.axis("equal")
    axis.locator_params(nbins=6)
    _legend_above(axis)
    return figure


def draw_errors(group: Group) -> Figure:
    """Position error of the first trial over time, component by component, inside the ±3σ that each run claims."""
    figure, axes = _rows(3, 1.5)
    shown = example(group)
    for dashes, width, (name, run) in zip(repeated(DASHES, len(shown)), widths(len(shown), 1.0), shown.items()):
        s, colour = read_series(run), colours(group)[name]
        t = s["stamp"] - s["stamp"][0]
        for axis, c in zip(axes, "xyz"):
            band = 300 * s[f"sd_{c}"]
            axis.fill_between(t, -band, band, color=colour, alpha=0.13, lw=0)
            for side in (-1, 1):  # an outline each: where bands lie over each other their colours mix
                axis.plot(t, side * band, color=colour, alpha=0.7, lw=0.6 * width, ls=dashes)
            axis.plot(t, 100 * s[f"error_{c}"], color=colour, lw=width, label=name)
    for axis, label in zip(axes, ("right", "down", "forward")):
        axis.axhline(0, color="0.6", lw=0.5)
        axis.set_ylabel(f"{label} [cm]")
    _legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    return figure


def draw_nees(group: Group) -> Figure:
    """NEES / 6 over time, mean over the trials whose pose was measured, with the 95 % band of as many trials."""
    from matplotlib.ticker import LogLocator

    figure, axis = _axes(2.8)
    fewest = group.trials
    for name, runs in group.runs.items():
        every = [read_series(run) for run in runs if run.completed]
        if not every:
            continue
        fewest = min(fewest, len(every))
        length = min(len(s["nees"]) for s in every)
        nees = np.ma.masked_invalid([s["nees"][1:length] for s in every])
        t = (every[0]["stamp"] - every[0]["stamp"][0])[1:length]
        axis.plot(t, nees.mean(axis=0).filled(np.nan) / 6, color=colours(group)[name], lw=1.2, label=name)
    axis.axhline(1, color="0.3", lw=0.8, ls="--", label="expected")
    low, high = chi_square_band(6, fewest)
    axis.axhspan(
        low / 6, high / 6, color="0.6", alpha=0.3, lw=0, label=f"95 % band if consistent, mean of {_count(fewest)}"
    )
    axis.set_yscale("log")
    bottom, top = axis.get_ylim()
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if top > 10 * bottom else (0.6, 0.8, 1, 1.5, 2, 3, 4)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter("")
    axis.set(xlabel="time [s]", ylabel="NEES / 6")
    _legend_above(axis, 2)
    return figure


def draw_timing(group: Group) -> Figure:
    """Milliseconds per frame and stage, median of the trials' medians."""
    names = list(group.runs)
    figure, axis = _axes(1.1 + 0.45 * len(names))
    left = np.zeros(len(names))
    runs = {name: [r for r in group.runs[name] if r.milliseconds] for name in names}
    for stage in stages(stage for rs in runs.values() for r in rs for stage in r.milliseconds):
        width = np.array(
            [np.median([r.milliseconds.get(stage, 0.0) for r in runs[n]]) if runs[n] else 0.0 for n in names]
        )
        axis.barh(range(len(names)), width, left=left, color=stage_colour(stage), label=stage_name(stage))
        left += width
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set_xlabel("ms per frame, one thread")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=8)
    return figure


def map_data(group: Group, most: int = 700) -> dict[str, Any]:
    """The first trial's maps and paths for the picture in 3D that can be turned."""
    layers = []
    truth = None
    for name, run in example(group).items():
        own, true = paths(run)
        truth = true if truth is None else truth
        layers.append(
            {
                "name": name,
                "colour": colours(group)[name],
                "path": _thin(own.positions),
                **_landmarks(run.folder, own, most),
            }
        )
    return {"layers": layers, "truth": [] if truth is None else _thin(truth.positions)}


def _landmarks(folder: Path, own: Trajectory, most: int) -> dict[str, Any]:
    """Positions and the axes of the 2σ ellipsoids of the best-known landmarks near the path."""
    file = folder / "landmarks.csv"
    rows = read_numbers(file, 12) if file.exists() else np.zeros((0, 12))
    positions, upper = rows[:, 1:4], rows[:, 4:10]
    extent = max(float(np.ptp(own.positions, axis=0).max()), 1.0)
    distance = np.linalg.norm(positions - own.positions.mean(axis=0), axis=1)
    size = np.sqrt(np.maximum(upper[:, 0] + upper[:, 3] + upper[:, 5], 0))
    near = np.flatnonzero((distance < 2 * extent + 3) & (size < 0.3 * extent))
    near = near[np.argsort(size[near], kind="stable")[:most]]
    covariances = upper[near][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(covariances)
    axes = 2 * np.sqrt(np.maximum(values, 0))[:, None, :] * vectors
    return {"points": _round(positions[near]), "axes": _round(np.swapaxes(axes, 1, 2).reshape(-1, 9))}


def _thin(positions: Array, most: int = 600) -> list[list[float]]:
    step = max(1, len(positions) // most)
    return _round(positions[::step])


def _round(rows: Array) -> list[list[float]]:
    return [[round(float(x), 4) for x in row] for row in rows]


_STYLE: Mapping[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "slam",
    "pdf.fonttype": 42,
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def _count(trials: int) -> str:
    return "1 trial" if trials == 1 else f"{trials} trials"


def _legend_above(axis: Any, columns: int = 4) -> None:
    """A legend that hides nothing."""
    axis.legend(frameon=False, fontsize=8, ncols=columns, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)


def _axes(height: float) -> tuple[Any, Any]:
    figure, axes = _rows(1, height)
    return figure, axes[0]


def _rows(count: int, height: float) -> tuple[Any, list[Any]]:
    """A figure of rows of axes under one time axis, apart from pyplot's global state."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(dict(_STYLE)):
        figure = Figure((_WIDTH, height * count), layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    return figure, list(axes)


def as_svg(figure: Figure) -> str:
    """A picture as SVG, the same for the same data."""
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context(dict(_STYLE)):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def as_pdf(figure: Figure, title: str) -> bytes:
    """A picture as PDF with embedded TrueType fonts: the same bytes for the same data, without a date."""
    from matplotlib import rc_context

    content = io.BytesIO()
    with rc_context(dict(_STYLE)):
        figure.savefig(content, format="pdf", metadata={"CreationDate": None, "Title": printable(title)})
    return content.getvalue()
