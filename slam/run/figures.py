"""Pictures of runs, made from the files that they leave: maps with covariance ellipsoids, paths, errors over time."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.evaluation.metrics import align, associate
from slam.files import whole_file
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.run.run_data import RunData
from slam.run.style import backend_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TRUTH, _SEEN, _UNSEEN, _OLD = "0.35", "#c62828", "#7cb342", "0.75"
_MARKS = {_SEEN: ("^", 3.5), _UNSEEN: (".", 2.0)}  # told apart by shape, too
_CORRECTED, _CLOSED, _REFUSED = "#4527a0", "0.1", "#d81b60"  # what loops do
_BODIES = ("#00838f", "#6a1b9a", "#5d4037", "#ad1457")
_STRAIGHT = 12  # a path that is so many times as long as wide looks like a line on one scale
_SIGMAS = 2.0  # size of ellipses and ellipsoids


def draw_map(axis: Axes, run: RunData, truth: Trajectory | None, colour: str) -> None:
    """The map from above, the path in a colour, and the 2σ ellipses of the landmarks that are well known."""
    from matplotlib.collections import EllipseCollection

    plane = run.covariances[:, [0, 2]][:, :, [0, 2]]
    values, vectors = np.linalg.eigh(plane) if len(plane) else (np.zeros((0, 2)), np.zeros((0, 2, 2)))
    width = 2 * _SIGMAS * np.sqrt(np.maximum(values, 0))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    known = np.isin(np.arange(len(run.positions)), well_known(run))  # the others would cover these
    for rows, shade, label in ((~run.seen_last, _UNSEEN, "not seen now"), (run.seen_last, _SEEN, "seen now")):
        sure = rows & known
        ellipses = EllipseCollection(
            width[sure, 1], width[sure, 0], angle[sure], units="xy", offsets=run.positions[sure][:, [0, 2]],
            offset_transform=axis.transData, facecolors="none", edgecolors=shade, linewidths=0.8,
        )  # fmt: skip
        axis.add_collection(ellipses)
        mark, size = _MARKS[shade]
        axis.plot(*run.positions[rows][:, [0, 2]].T, mark, ms=size, color=shade, label=f"landmarks {label}")
    if len(run.old):
        axis.plot(*run.old[:, [0, 2]].T, ".", ms=1.5, color=_OLD, zorder=0, label="landmarks before")
    draw_path(axis, run, run.online, f"path of {run.name}, online", color=colour, lw=3, alpha=0.6)
    draw_loops(axis, run)
    label = "moving bodies"
    for positions, body_colour in zip(run.bodies.values(), cycle(_BODIES)):
        axis.plot(*positions[:, [0, 2]].T, "-s", ms=4, lw=1.5, markevery=[-1], color=body_colour, label=label)
        label = "_"
    _draw_truth(axis, run, truth)
    axis.set(xlabel="right [m]", ylabel="forward [m]", aspect="equal")
    _limit_to_most(axis, run)


def draw_path(axis: Axes, run: RunData, path: Trajectory, label: str, **style: Any) -> None:
    """A run's path from above in any world; dotted where the camera was not tracked."""
    points = path.positions[:, [0, 2]]
    axis.plot(*np.where(run.measured[:, None], points, np.nan).T, label=label, **style)
    if not run.measured.all():
        axis.plot(*points.T, label=f"{label}, not tracked", **{**style, "lw": 1, "ls": ":"})


def draw_loops(axis: Axes, run: RunData) -> None:
    """The final path from above where it is another, keyframes, and the places where loops were found."""
    final = run.final.positions[:, [0, 2]]
    if is_revised(run):
        axis.plot(*final.T, color=_CORRECTED, lw=1.2, label="path, final")
    if len(run.loops):
        axis.plot(*final[run.keyframes].T, ".", ms=3, color=_CORRECTED, label="keyframes")
        axis.plot(*final[run.loops[:, 0]].T, "o", ms=6, mfc="none", color=_CLOSED, label="loops closed")
    if len(run.refused):
        axis.plot(*final[run.refused[:, 0]].T, "x", ms=5, color=_REFUSED, label="loops refused")


def is_revised(run: RunData) -> bool:
    """Whether the final path is another than the online one."""
    same = len(run.final) == len(run.online)
    return not (same and np.allclose(run.final.poses, run.online.poses, rtol=0, atol=1e-6))


def draw_map_3d(runs: list[RunData], path: Path, most: int = 400) -> None:
    """The map in 3D with covariance ellipsoids and the path (paper A, Fig. 5)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4 * len(runs), 5.4))
    FigureCanvasAgg(figure)
    u, v = np.mgrid[0 : 2 * np.pi : 9j, 0 : np.pi : 6j]
    sphere = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    for i, run in enumerate(runs):
        axis: Any = figure.add_subplot(1, len(runs), i + 1, projection="3d")
        for row in well_known(run)[-most:]:
            values, vectors = np.linalg.eigh(run.covariances[row])
            shape = (sphere * _SIGMAS * np.sqrt(np.maximum(values, 0))) @ vectors.T + run.positions[row]
            colour = _SEEN if run.seen_last[row] else _UNSEEN
            axis.plot_wireframe(shape[..., 0], shape[..., 2], -shape[..., 1], color=colour, lw=0.35)
        p, colour = run.online.positions, backend_colours([run.backend])[0]
        axis.plot(p[:, 0], p[:, 2], -p[:, 1], color=colour, lw=1.5, label="path")
        for colour, label in ((_SEEN, "landmarks seen now, 2σ"), (_UNSEEN, "landmarks not seen now, 2σ")):
            axis.plot([], [], [], color=colour, lw=1, label=label)
        axis.set(xlabel="right [m]", ylabel="forward [m]", zlabel="up [m]")
        axis.set_title(run.name, y=0.92)
        for side in (axis.xaxis, axis.yaxis, axis.zaxis):
            side.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.yaxis.labelpad = axis.zaxis.labelpad = 9  # clear of the numbers
        axis.set_box_aspect(np.ptp([axis.get_xlim(), axis.get_ylim(), axis.get_zlim()], axis=1))  # one scale for all
        axis.view_init(elev=25, azim=-65)
    labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(*labels, loc="lower center", bbox_to_anchor=(0.5, 0.05), ncols=3, fontsize=8, frameon=False)
    with whole_file(path) as file:
        figure.savefig(file, dpi=110, metadata={"Software": None}, bbox_inches="tight")


def stretch(axis: Axes, points: np.ndarray) -> bool:
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


def widths(count: int, last: float) -> list[float]:
    """Widths of lines, the first the widest: where lines coincide, each is seen beside the one drawn over it."""
    return [last * (1 + 1.2 * (count - 1 - i)) for i in range(count)]


def place_of_truth(run: RunData, truth: Trajectory) -> Array:
    """Pose (4, 4) of the true path's world in the run's, in which both paths begin at the same position.

    It is turned by the first pose where the truth is exact. A recorded one is turned so that the whole paths fit: an
    error of its first orientation by some tenths of a degree would look like an error of the path that grows with the
    distance.
    """
    own, true = associate(run.online, truth, 0.02, interpolated=True)
    T = np.eye(4)
    T[:3, :3] = own.poses[0, :3, :3] @ true.poses[0, :3, :3].T if run.truth_is_exact else align(true, own).R
    T[:3, 3] = own.positions[0] - T[:3, :3] @ true.positions[0]
    return T


def position_errors(run: RunData, truth: Trajectory) -> tuple[Array, Array, Array]:
    """Time since the start (N,) [s], error of the online position and its claimed standard deviation, (N, 3) [m] each.

    Both are along the axes of the run's world, see `place_of_truth`.
    """
    own, true = associate(run.online, truth, 0.02, interpolated=True)
    T = place_of_truth(run, truth)
    expected = true.positions @ T[:3, :3].T + T[:3, 3]
    rows = np.searchsorted(run.online.stamps, own.stamps)
    return own.stamps - run.online.stamps[0], own.positions - expected, run.deviations[rows]


def _draw_truth(axis: Axes, run: RunData, truth: Trajectory | None) -> None:
    """The true path of the estimated poses, from above, as `place_of_truth` says."""
    if truth is None:
        return
    _, true = associate(run.online, truth, 0.02, interpolated=True)
    T = place_of_truth(run, truth)
    axis.plot(*(true.positions @ T[:3, :3].T + T[:3, 3])[:, [0, 2]].T, "--", color=_TRUTH, lw=1.2, label="true path")


def well_known(run: RunData) -> np.ndarray:
    """Rows of landmarks that are well known and near the path, most recent last: others spoil a picture's scale."""
    size = np.sqrt(np.trace(run.covariances, axis1=1, axis2=2)) if len(run.positions) else np.zeros(0)
    distance = np.linalg.norm(run.positions - run.online.positions.mean(axis=0), axis=1)
    return np.flatnonzero((size < 0.2 * _extent(run)) & (distance < _reach(run)))


def _extent(run: RunData) -> float:
    """How far the path reaches [m]; of the scene where the camera hardly moved, or was lost."""
    distance = np.linalg.norm(run.positions - run.online.positions.mean(axis=0), axis=1)
    scene = 0.5 * float(np.median(distance)) if len(distance) else 0.0
    return max(float(np.ptp(run.online.positions, axis=0).max()), scene, 1.0)


def _reach(run: RunData) -> float:
    """Distance from the middle of the path up to which landmarks are shown [m]."""
    return 2.0 * _extent(run) + 3.0


def _limit_to_most(axis: Axes, run: RunData) -> None:
    """Axis limits that hold the path and the well-known landmarks with their ellipses."""
    known = well_known(run)
    near = np.linalg.norm(run.old - run.online.positions.mean(axis=0), axis=1) < _reach(run)
    points = np.concatenate([run.positions[known], run.online.positions, run.final.positions, run.old[near]])[:, [0, 2]]
    reach = np.zeros_like(points)
    reach[: len(known)] = np.diagonal(run.covariances[known], axis1=1, axis2=2)[:, [0, 2]]
    reach = _SIGMAS * np.sqrt(reach)  # of the ellipses
    low, high = (points - reach).min(axis=0), (points + reach).max(axis=0)
    margin = 0.05 * float((high - low).max()) + 0.1
    axis.set_xlim(low[0] - margin, high[0] + margin)
    axis.set_ylim(low[1] - margin, high[1] + margin)
