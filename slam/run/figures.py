"""What the pictures of runs show: maps with covariance ellipses, paths, and the errors of poses over time."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.evaluation.metrics import align, associate
from slam.evaluation.summary import rotation_errors
from slam.geometry.se3 import Array, hat, so3_exp
from slam.geometry.trajectory import Trajectory
from slam.run.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TRUTH, _SEEN, _UNSEEN, _OLD = "0.35", "#c62828", "#7cb342", "0.75"
_MARKS = {_SEEN: ("^", 3.5), _UNSEEN: (".", 2.0)}  # told apart by shape, too
_CORRECTED, _CLOSED, _REFUSED = "#4527a0", "0.1", "#d81b60"  # what loops do
_BODIES = ("#00838f", "#6a1b9a", "#5d4037", "#ad1457")
_STRAIGHT = 12  # a path that is so many times as long as wide looks like a line on one scale
_SIGMAS = 2.0  # size of ellipses
_TURNED = np.radians(1.0)  # how far the axes of a recorded truth are turned against the camera's, about


def draw_map(axis: Axes, run: RunData, colour: str) -> None:
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
    draw_path(axis, run, run.online, "path, online", color=colour, lw=3, alpha=0.6)
    draw_loops(axis, run)
    label = "moving bodies"
    for positions, body_colour in zip(run.bodies.values(), cycle(_BODIES)):
        axis.plot(*positions[:, [0, 2]].T, "-s", ms=4, lw=1.5, markevery=[-1], color=body_colour, label=label)
        label = "_"
    if run.truth is not None:
        _, true = associate(run.online, run.truth, 0.02, interpolated=True)
        T = place_of_truth(run, run.truth)
        points = true.positions @ T[:3, :3].T + T[:3, 3]
        axis.plot(*points[:, [0, 2]].T, "--", color=_TRUTH, lw=1.2, label="true path")
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


def widths(count: int) -> Array:
    """Widths of lines (N,), the first the widest: where lines coincide, each is seen beside the one drawn over it."""
    return 1 + 1.2 * np.arange(count)[::-1]


def place_of_truth(run: RunData, truth: Trajectory) -> Array:
    """Pose (4, 4) of the true path's world in the run's, in which both paths begin at the same position.

    It is turned by the first pose. A recorded one is turned a little further, so that the whole paths fit: an error of
    its first orientation by some tenths of a degree would look like an error of the path that grows with the distance.
    Where no little turn makes them fit, the truth's orientations are in other axes, and the paths alone count.
    """
    own, true = associate(run.online, truth, 0.02, interpolated=True)
    T, turn = np.eye(4), own.poses[0, :3, :3] @ true.poses[0, :3, :3].T
    T[:3, :3] = turn
    if not run.truth_is_exact:
        places, true_places = (path.positions - path.positions[0] for path in (own, true))
        T[:3, :3] = _fitted(places, true_places, turn, align(true, own).R)
    T[:3, 3] = own.positions[0] - T[:3, :3] @ true.positions[0]
    return T


def _fitted(own: Array, true: Array, turn: Array, by_paths: Array) -> Array:
    """A rotation (3, 3) close to `turn` by which places since the start (N, 3) fit; `by_paths` where none does.

    What the paths do not tell, such as a turn about a straight path, stays as it was.
    """
    turned = true @ turn.T
    J = -hat(turned).reshape(-1, 3)
    gaps = own - turned
    prior = float(np.mean(gaps**2)) / _TURNED**2
    fitted = so3_exp(np.linalg.solve(J.T @ J + max(prior, 1e-12) * np.eye(3), J.T @ gaps.ravel())) @ turn
    left, least = (float(((own - true @ R.T) ** 2).sum()) for R in (fitted, by_paths))
    return fitted if left <= 2 * least or left <= float(np.sum(own**2)) * _TURNED**2 else by_paths


def pose_errors(run: RunData) -> tuple[Array, Array, Array]:
    """Time since the start (N,) [s], errors of the online pose and their claimed standard deviations, (N, 4) each.

    The first three columns are the position along the axes of the run's world [m], see `place_of_truth`; the last one
    is the angle of the rotation's error [deg]. Without a truth the errors are zero.
    """
    if run.truth is None:
        stamps = run.online.stamps
        return stamps - stamps[0], np.zeros((len(stamps), 4)), run.deviations
    own, true = associate(run.online, run.truth, 0.02, interpolated=True)
    T = place_of_truth(run, run.truth)
    expected = true.positions @ T[:3, :3].T + T[:3, 3]
    turned = np.linalg.norm(rotation_errors(own, true, 0.0 if run.truth_is_exact else _TURNED), axis=1)
    errors = np.column_stack([own.positions - expected, np.degrees(turned)])
    return own.stamps - run.online.stamps[0], errors, run.deviations[np.searchsorted(run.online.stamps, own.stamps)]


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
