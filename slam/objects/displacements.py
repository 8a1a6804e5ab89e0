"""How far each track went from the older to the recent frames of its window, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import Array
from slam.objects.track_kernels import displaced, places_known
from slam.objects.tracks import Tracks

RECENT = 5  #: frames that are recent, at most
LAG = 4  #: frames between the older and the recent measurements, about
_FARTHEST = 4.0  # a track's depth must be so many times its deviation


@dataclass(frozen=True, eq=False)
class Displacements:
    """How tracks moved from the older to the recent frames, a row each."""

    points: Array  # where they are (N, 3), relative to the camera, in world axes [m]
    d: Array  # displacements (N, 3) [m]
    W: Array  # their information (N, 3, 3)
    # frames between the older and the recent measurements, in the mean (N,); a pose error that grows evenly shows in
    # proportion
    lag: Array


def displacements(
    tracks: Tracks, rows: NDArray[np.intp], ages: NDArray[np.intp], centres: Array, slide: float
) -> Displacements:  # fmt: skip
    """Displacements of tracks from older to recent frames.

    The recent frames are the last five, of short tracks the later half.

    Args:
        tracks: all tracks.
        rows: which of them.
        ages: of the window's slots in frames (W,).
        centres: positions of the left camera by slot (W, 3).
        slide: variance of a feature's direction with the angle from which it is seen [rad].
    """
    t = tracks
    rays = t.position[rows] - centres[int(np.argmin(ages))]
    d, W, lag = displaced(
        t.A, t.p, t.dof, t.older_A, t.older_b, t.older_age, rows, ages, RECENT, rays, centres, slide
    )  # fmt: skip
    return Displacements(rays, d, W, lag)


def known_well(
    tracks: Tracks, rows: NDArray[np.intp], T_world_left: Array, min_frames: int
) -> tuple[NDArray[np.intp], Array]:
    """Those of the tracks that were seen in enough frames and whose depth is known, and where they are seen.

    Args:
        tracks: all tracks.
        rows: some of them.
        T_world_left: the camera's pose (4, 4).
        min_frames: in which a track must have been seen.

    Returns:
        rows (K,), and x/z, y/z, log z of each (K, 3).
    """
    rows = rows[tracks.count(rows) >= min_frames]
    known, place = places_known(tracks.position, tracks.covariance, rows, T_world_left, _FARTHEST)
    return known, place
