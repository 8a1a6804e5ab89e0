"""Landmarks that part from the rest of the scene in a frame: what may have begun to move does not measure its pose.

A near body that starts to move would carry the camera along. Points of a far wall hardly tell a step sideways from a
turn, and three points before it decide. So before each update the landmarks found in a frame are compared with where
their tracks saw them: those that lie together, and whose motion is not that of the rest, are two explanations of one
frame, by the camera's motion and by theirs. The camera keeps with the rest, which is wider spread, and the covariance
of its pose grows by what the withheld measurements would have told.
"""

from __future__ import annotations

import numpy as np

from slam.bodies.fits import measure
from slam.bodies.frame import Setup
from slam.bodies.scene import FARTHEST, Displacements, classify_scene, places_in_view, tail
from slam.bodies.track_kernels import fit_fixed_points, inverses
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.pnp import measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.tracks.table import Tracks

_FEW = 3  # derived: landmarks that determine a pose
_AROUND = 0.5  # of a group's extent in view, how far beyond it landmarks of unknown motion are taken for a part of it
_LEAST_NOISE = 0.05  # [px] of a pixel from frame to frame: correlation finds it no better; errors of the rig are below
_RIDGE = 1e-6  # numerics: share of the trace


def parting(
    setup: Setup, tracks: Tracks, now: int, features: StereoFeatures, at: IndexArray, rows: IndexArray,
    T_world_left: Array,
) -> BoolArray:  # fmt: skip
    """Which landmarks (K,) part from the rest, or lie among those that do and are not known for long enough.

    Args:
        setup: cameras and settings.
        tracks: as they were after the last frame.
        now: number of this frame.
        features: of the frame.
        at: rows in the table of the landmarks found in it that are followed (K,).
        rows: of their features (K,).
        T_world_left: the camera's pose (4, 4) as far as it is known: an error of it moves all landmarks alike.
    """
    c, t, out = setup.config, tracks, np.zeros(len(at), bool)
    mine = np.flatnonzero((t.body[at] < 0) & (t.count(at) >= c.min_frames))
    known = at[mine]
    position, covariance = np.empty_like(t.position), np.empty_like(t.covariance)
    fit_fixed_points(t.A, t.p, t.anchor, known, position, covariance)
    before, P = position[known], covariance[known]
    z = measurement_rows(features.uv_left[rows[mine]], features.uv_right[rows[mine]])
    points, A, dof = measure(setup.rig, T_world_left, before, z, setup.sigma)
    local = transform(inverse(T_world_left), before)
    tested = np.flatnonzero((dof > 0) & (local[:, 2] > FARTHEST * np.sqrt(np.trace(P, axis1=1, axis2=2))))
    ages = 1 + (now - 1 - np.arange(c.window)) % c.window
    seen = t.dof[known[tested]] > 0
    W = inverses(inverses(A[tested], _RIDGE, 0.0) + P[tested], _RIDGE, 0.0)
    moved = Displacements(
        before[tested] - T_world_left[:3, 3], (points - before)[tested], W, (seen @ ages) / seen.sum(axis=1)
    )
    view = places_in_view(local[tested])
    scene = classify_scene(moved, view, c.suspect, _FEW, (_LEAST_NOISE / setup.sigma) ** 2)
    if not scene.groups:
        return out
    young = np.setdiff1d(np.arange(len(at)), mine[tested])
    local = transform(inverse(T_world_left), t.position[at[young]])
    young, place = young[local[:, 2] > 0], places_in_view(local[local[:, 2] > 0])
    for members in (group.members for group in scene.groups):
        out[mine[tested[members]]] = True
        low, high = view[members].min(axis=0), view[members].max(axis=0)
        beyond = _AROUND * (high - low)
        out[young] |= ((place > low - beyond) & (place < high + beyond)).all(axis=1)
    return out


def moved_since(
    rig: StereoRig, T_world_left: Array, first: Array, frames: Array, pixels: Array, sigma: float, doubtful: float,
    suspect: float, support: int,
) -> BoolArray:  # fmt: skip
    """Which points (N,) moved otherwise than the scene since they were first seen: for a run's first frames.

    What moves from the beginning on would else pull the camera along until its tracks are known, and that error stays:
    the world's axes are those of the first frame. The noise is that of these displacements themselves. Tracks are then
    too short for their means, of which `parting` asks, to be any better than their first points.

    Args:
        rig: the cameras.
        T_world_left: the camera's pose (4, 4), which may be wrong.
        first: where the points were first seen (N, 3), in world coordinates [m].
        frames: since then (N,).
        pixels: (uL, vL, uR) of each in this frame (N, 3); those without a right pixel are not tested.
        sigma: pixel noise [px].
        doubtful: χ²(3) from which a single point moved.
        suspect: χ²(6) from which a group did.
        support: least number of points of a group.
    """
    moves = np.zeros(len(pixels), bool)
    points, information, dof = measure(rig, T_world_left, first, pixels, sigma)
    local = transform(inverse(T_world_left), first)
    known = np.flatnonzero((dof == 3) & (local[:, 2] > 0))
    if len(known) < 3 * support:
        return moves
    A, was = information[known], first[known]
    ridge = _RIDGE * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    moved = Displacements(was - T_world_left[:3, 3], points[known] - was, 0.5 * (A + ridge), frames[known])
    scene = classify_scene(moved, places_in_view(local[known]), suspect, support, (_LEAST_NOISE / sigma) ** 2)
    moves[known[~scene.rest | (scene.alone > doubtful * tail(scene.alone[scene.rest]))]] = True
    return moves
