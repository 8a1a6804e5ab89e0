"""Parts of a body that move on their own, such as a lid on its hinge.

The test by which bodies are found in a still world (`slam.objects.regions`), with a body in the world's place: what its
tracks measured is taken to its axes, and tracks that lie together and went otherwise than the rest of them are a part.
Without it a part's tracks join the body before anything is known of them, leave it one by one, and never come together.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from slam.objects import membership
from slam.objects.bodies import Body, in_body_axes
from slam.objects.config import ObjectsConfig
from slam.objects.displacements import LAG, RECENT, Displacements, known_well
from slam.objects.regions import Group, classify_scene
from slam.objects.track_kernels import displaced
from slam.objects.tracks import Tracks


def moving_parts(
    bodies: Mapping[int, Body], tracks: Tracks, ages: NDArray[np.intp], T_world_left: NDArray, dt: float,
    config: ObjectsConfig,
) -> list[tuple[int, NDArray[np.intp]]]:  # fmt: skip
    """Groups of tracks on known bodies that move otherwise than these: ids of the bodies, and the groups' rows.

    Args:
        bodies: all bodies, by id.
        tracks: all tracks.
        ages: of the window's slots in frames (W,).
        T_world_left: the camera's pose (4, 4).
        dt: time between frames [s].
        config: settings.
    """
    found = []
    for body in bodies.values():
        if not (body.measured and body.proven):
            continue
        on = membership.tracks_on(body, tracks, config.margin)
        rows, place = known_well(tracks, on, T_world_left, config.min_frames)
        for group in parts_of(body, tracks, rows, ages, place, config.suspect, config.min_support):
            if group.moves(config.group_test, LAG * dt * config.min_speed):
                found.append((body.id, rows[group.members]))
    return found


def parts_of(
    body: Body, tracks: Tracks, rows: NDArray[np.intp], ages: NDArray[np.intp], place: NDArray, test: float,
    support: int,
) -> list[Group]:  # fmt: skip
    """Groups of tracks on a body that moved otherwise than the rest of them; their members are indices into `rows`.

    Args:
        body: the body.
        tracks: all tracks.
        rows: those on the body (N,).
        ages: of the window's slots in frames (W,).
        place: where each is seen (N, 3): x/z, y/z, and log z.
        test: χ²(6) from which a large group moved, and
        support: least number of tracks in a group, as in `classify_scene`.
    """
    if len(rows) < 3 * support:
        return []
    points, A, known = in_body_axes(body, tracks, rows)
    n = len(rows)
    d, W, lag = displaced(
        A, np.where(known[..., None], points, 0.0), np.where(known, tracks.dof[rows], 0).astype(np.int8),
        np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n), np.arange(n), ages, RECENT,
        np.ones((n, 3)), np.zeros((len(ages), 3)), 0.0,
    )  # fmt: skip
    middle = (tracks.position[rows] - body.T[:3, 3]) @ body.T[:3, :3]
    return classify_scene(Displacements(middle, d, W, lag), place, test, support).groups
