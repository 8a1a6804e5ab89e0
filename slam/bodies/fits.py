"""What tracks measured, as points in world coordinates, and how that fits a fixed point or a constant velocity."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from slam.bodies.bodies import Body
from slam.bodies.config import MIN_FRAMES
from slam.bodies.frame import Frame, Setup
from slam.bodies.track_kernels import fit_tracks, measure
from slam.data import IndexArray
from slam.geometry.rig import StereoRig, measurement_rows
from slam.geometry.se3 import Array
from slam.tracks.table import Tracks

_TOO_FAR = 3.0  # expected points so far off that linearising there is worse than at the measured point [px]
_STEPS = 4  # numerics: of Gauss-Newton at most
_ROUNDED = 1e-6  # numerics: disparity [px] up to which rounding decides what it is
MOVES = 12.0  #: derived: χ²(3) at 99.3 % of the velocity, from which it counts
AGREES = 11.3  #: derived: χ²(3) at 99 %, of places or velocities that are the same


def record(tracks: Tracks, rows: IndexArray, frame: Frame) -> None:
    """Enter what the features of tracks (K,) measure in this frame, in place."""
    f, at = frame.features, tracks.row[rows]
    z = measurement_rows(f.uv_left[at], f.uv_right[at])
    record_in(tracks, rows, frame.setup, frame.T_world_left, z, frame.slot)


def record_in(tracks: Tracks, rows: IndexArray, setup: Setup, T_world_left: Array, z: Array, slot: int) -> None:
    """Enter pixels (K, 3) of tracks (K,) into a slot of their windows, as points with their information, in place.

    Each is linearised on the measured ray, at the depth of the expected point: so the left pixel is met exactly, and
    the depth is linear in the disparity and therefore free of bias; only where the expected point is far off, at the
    measured depth. Rows whose uR is NaN have no information along the ray; unusable rows none.
    """
    t, camera = tracks, setup.rig.rectified_parameters
    measure(camera, T_world_left, t.position, t.anchor, z, rows, slot, setup.sigma, _TOO_FAR, _STEPS, t.A, t.p, t.dof)


def fit_positions(tracks: Tracks, rows: IndexArray) -> None:
    """Fit fixed points to the windows of tracks, in place."""
    fit(tracks, rows, np.zeros(tracks.dof.shape[1]), 1.0)  # at one time there is no velocity


def fit(tracks: Tracks, rows: IndexArray, times: Array, max_speed: float) -> None:
    """Fit windows of tracks, in place: those that may move have a velocity where a fixed point does not explain them.

    Those may that are in doubt, had a velocity before, or have few measurements; see `constant_velocity`.
    """
    t = tracks
    into = t.position, t.covariance, t.velocity, t.velocity_covariance
    fit_tracks(t.A, t.p, t.dof, t.anchor, rows, t.doubtful, MIN_FRAMES, times, max_speed**-2, MOVES, *into)


@dataclass(frozen=True, eq=False)
class ConstantVelocity:
    """Points with an even velocity, a row each."""

    position: Array  # now (N, 3)
    covariance: Array  # of the position (N, 3, 3)
    velocity: Array  # (N, 3) [m/s]
    velocity_covariance: Array  # (N, 3, 3)
    test: Array  # χ²(3) of the velocity (N,)


def constant_velocity(tracks: Tracks, rows: IndexArray, times: Array, max_speed: float) -> ConstantVelocity:
    """Points with an even velocity, fitted to windows of tracks whose slots have `times` (W,) less the present [s].

    `max_speed` is the deviation of velocities before anything is known [m/s].
    """
    t, n = tracks, len(tracks)
    (position, velocity), (P, V), every = np.zeros((2, n, 3)), np.zeros((2, n, 3, 3)), np.ones(n, bool)
    into = position, P, velocity, V
    test = fit_tracks(t.A, t.p, t.dof, t.anchor, rows, every, 0, times, max_speed**-2, -np.inf, *into)
    return ConstantVelocity(position[rows], P[rows], velocity[rows], V[rows], test)


def times_vectors(M: Array, v: Array) -> Array:
    """Products (..., 3) of matrices (..., 3, 3) and vectors (..., 3)."""
    return np.asarray((M @ v[..., None])[..., 0])


def revise_tracks(
    tracks: Tracks, bodies: Mapping[int, Body], poses: Array, slot: int, rig: StereoRig,
    correct: Callable[[Array], Array],
) -> None:  # fmt: skip
    """Move the points of all tracks, and of bodies, to where their pixels say that they are, corrected again; in place.

    Without it a change of all disparities looks as if all that is far away had moved along the line of sight. `poses`
    (W, 4, 4) are the camera's by slot, `slot` is the newest.
    """
    rows, slots = np.nonzero(tracks.dof)
    points = tracks.anchor[rows] + tracks.p[rows, slots]
    tracks.p[rows, slots] += _shifts(points, poses[slots], rig, correct)
    alive = np.flatnonzero(tracks.number >= 0)
    shift = _shifts(tracks.position[alive], np.broadcast_to(poses[slot], (len(alive), 4, 4)), rig, correct)
    tracks.position[alive] += shift
    for body in bodies.values():
        mine = tracks.body[alive] == body.id
        tracks.local[alive[mine]] += shift[mine] @ body.T[:3, :3]


def _shifts(points: Array, T_world_left: Array, rig: StereoRig, correct: Callable[[Array], Array]) -> Array:
    """By what points (N, 3) seen from poses (N, 4, 4) move in the world (N, 3); not out of view or at infinity."""
    R = T_world_left[:, :3, :3]
    z, J = rig.project_stereo(times_vectors(np.swapaxes(R, 1, 2), points - T_world_left[:, :3, 3]))
    disparity = z[:, 0] - z[:, 2]
    good = np.flatnonzero(rig.left.in_image(z[:, :2]) & (disparity > _ROUNDED) & (disparity < rig.width))
    change = correct(z[good]) - z[good]
    known = np.isfinite(change).all(axis=1)
    good, change, shifts = good[known], change[known], np.zeros_like(points)
    shifts[good] = times_vectors(R[good], np.linalg.solve(J[good], change[..., None])[..., 0])
    return shifts
