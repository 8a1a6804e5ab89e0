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
from slam.bodies.scene import FARTHEST, Displacements, Scene, classify_scene, places_in_view, tail
from slam.bodies.track_kernels import fit_fixed_points, inverses
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.pnp import measurement_rows
from slam.geometry.se3 import Array, inverse, transform
from slam.tracks.table import Tracks

_FEW = 3  # derived: landmarks that determine a pose
_AROUND = 0.5  # of a group's extent in view, how far beyond it landmarks of unknown motion are taken for a part of it
_LEAST_NOISE = 0.05  # [px] of a pixel from frame to frame: correlation finds it no better; errors of the rig are below
_RIDGE = 1e-6  # numerics: share of the trace


def parting(
    setup: Setup, tracks: Tracks, now: int, features: StereoFeatures, at: IndexArray, rows: IndexArray,
    T_world_left: Array,
) -> tuple[BoolArray, BoolArray]:  # fmt: skip
    """Which landmarks (K,) part from the rest, or lie among those that do and are not known for long enough.

    And which moved since they were first seen, in a run's first frames: what moves from the beginning on would else
    pull the camera along until its tracks are known, and that error stays, as the world's axes are those of the first
    frame. Means of tracks are no better than their first points then.

    Args:
        setup: cameras and settings.
        tracks: as they were after the last frame.
        now: number of this frame.
        features: of the frame.
        at: rows in the table of the landmarks found in it that are followed (K,).
        rows: of their features (K,).
        T_world_left: the camera's pose (4, 4) as far as it is known: an error of it moves all landmarks alike.
    """
    c, t = setup.config, tracks
    parts, moved = np.zeros((2, len(at)), bool)
    z = measurement_rows(features.uv_left[rows], features.uv_right[rows])
    mine = np.flatnonzero((t.body[at] < 0) & (t.count(at) >= c.min_frames))
    position, covariance = np.empty_like(t.position), np.empty_like(t.covariance)
    fit_fixed_points(t.A, t.p, t.anchor, at[mine], position, covariance)
    ages, seen = 1 + (now - 1 - np.arange(c.window)) % c.window, t.dof[at[mine]] > 0
    age = (seen @ ages) / np.maximum(seen.sum(axis=1), 1)
    known, view, scene = _compared(setup, T_world_left, position[at[mine]], covariance[at[mine]], age, z[mine])
    young = np.setdiff1d(np.arange(len(at)), mine[known])
    local = transform(inverse(T_world_left), t.position[at[young]])
    young, place = young[local[:, 2] > 0], places_in_view(local[local[:, 2] > 0])
    for group in scene.groups:
        parts[mine[known[group.members]]] = True
        low, high = view[group.members].min(axis=0), view[group.members].max(axis=0)
        beyond = _AROUND * (high - low)
        parts[young] |= ((place > low - beyond) & (place < high + beyond)).all(axis=1)
    if now < c.window:  # slots are frames
        first = (t.dof[at] > 0).argmax(axis=1)
        was = inverses(t.A[at, first], _RIDGE, 0.0)
        known, _, scene = _compared(setup, T_world_left, t.anchor[at], was, now - first.astype(float), z)
        moved[known] = ~scene.rest | (scene.alone > c.doubtful * tail(scene.alone[scene.rest]))
    return parts, moved


def _compared(
    setup: Setup, T_world_left: Array, before: Array, P: Array, age: Array, z: Array
) -> tuple[IndexArray, Array, Scene]:
    """How points `before` (N, 3), of covariances P (N, 3, 3), have moved in `age` (N,) frames to pixels z (N, 3).

    Returns:
        those whose depth is known (K,), where the camera saw them (K, 3), and the scene in the noise of the rest.
    """
    points, A, dof = measure(setup.rig, T_world_left, before, z, setup.sigma)
    local = transform(inverse(T_world_left), before)
    known = np.flatnonzero((dof > 0) & (local[:, 2] > FARTHEST * np.sqrt(np.trace(P, axis1=1, axis2=2))))
    W = inverses(inverses(A[known], _RIDGE, 0.0) + P[known], _RIDGE, 0.0)
    moved = Displacements(before[known] - T_world_left[:3, 3], (points - before)[known], W, age[known])
    view = places_in_view(local[known])
    return known, view, classify_scene(moved, view, setup.config.suspect, _FEW, (_LEAST_NOISE / setup.sigma) ** 2)
