"""What of a large world is near the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slam.data import BoolArray, IdArray
from slam.geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class Places:
    """Things in a tree by their places.

    Attributes:
        tree: of those that stand still.
        still, moving: indices of things (S,), (M,).
        radius: of the largest thing that stands still [m].
    """

    tree: cKDTree
    still: IdArray
    moving: IdArray
    radius: float

    @classmethod
    def of(cls, points: Array, moves: BoolArray, radius: float = 0.0) -> Places:
        """Of things at `points` (P, 3), of which some move; `radius` [m] is the largest one's."""
        still = np.flatnonzero(~moves)
        return cls(cKDTree(points[still]), still, np.flatnonzero(moves), radius)

    def within(self, place: Array, distance: float) -> IdArray:
        """Indices of what stands within a distance [m] of a place (3,), and of all that moves, in order."""
        near = self.tree.query_ball_point(place, distance + self.radius)
        return np.sort(np.concatenate([self.still[np.array(near, np.int64)], self.moving]))
