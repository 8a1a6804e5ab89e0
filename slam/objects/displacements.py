"""How far each track went from the older to the recent frames of its window, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.objects.tracks import Tracks, times_vectors
from slam.se3 import Array

_RECENT = 5  # frames


@dataclass(frozen=True)
class Displacements:
    """How tracks moved from the older to the recent frames, a row each.

    Attributes:
        points: where they are (N, 3), relative to the camera, in world axes [m].
        d: displacements (N, 3) [m].
        W: their information (N, 3, 3).
        lag: frames between the older and the recent measurements, in the mean (N,); a pose error that grows evenly
            shows in proportion.
    """

    points: Array
    d: Array
    W: Array
    lag: Array


def displacements(tracks: Tracks, rows: NDArray[np.intp], ages: NDArray[np.intp], camera: Array) -> Displacements:
    """Displacements of tracks from older to recent frames.

    The recent frames are the last five, of short tracks the later half.

    Args:
        tracks: all tracks.
        rows: which of them.
        ages: of the window's slots in frames (W,).
        camera: position (3,) of the left camera.
    """
    n, w = len(rows), len(ages)
    A = tracks.A[rows]
    count = (tracks.dof[rows] > 0).sum(axis=1)
    recent = (ages[None] < np.clip(count // 2, 2, _RECENT)[:, None]).astype(float)
    b = times_vectors(A, tracks.p[rows])
    A_recent = (recent[:, None] @ A.reshape(n, w, 9)).reshape(n, 3, 3)
    b_recent = (recent[:, None] @ b)[:, 0]
    A_older = A.sum(axis=1) + tracks.older_A[rows] - A_recent
    b_older = b.sum(axis=1) + tracks.older_b[rows] - b_recent
    weight = np.trace(A, axis1=2, axis2=3)
    late = (weight * recent) @ ages / np.maximum((weight * recent).sum(axis=1), 1e-12)
    early = (weight * (1 - recent)) @ ages + tracks.older_age[rows]
    early /= np.maximum((weight * (1 - recent)).sum(axis=1) + np.trace(tracks.older_A[rows], axis1=1, axis2=2), 1e-12)
    P_recent, P_older = _inverses(A_recent), _inverses(A_older)
    d = times_vectors(P_recent, b_recent) - times_vectors(P_older, b_older)
    W = np.linalg.inv(P_recent + P_older)
    return Displacements(tracks.position[rows] - camera, d, W, np.maximum(early - late, 1.0))


def _inverses(M: Array) -> Array:
    """Inverses (N, 3, 3) of information matrices, also of those that know nothing along the ray."""
    return np.linalg.inv(M + (1e-6 * np.trace(M, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(3))
