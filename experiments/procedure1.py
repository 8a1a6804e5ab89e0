"""The papers' detector of a moving object, as it was printed (paper B, section 3, Procedure 1 and steps a to e).

The object's features are known beforehand: a database of descriptors and 3D points of the initial scene. Three features
give a body frame in the initial and in the current scene, and these give the object's motion. A misprint: step e says
"the image correspondence A′, B′, C′", meant are their 3D positions, ``A′ = F_j + R (A − M_j)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, pose, transform
from slam.tracks.follow import match_everywhere

_ALIKE = 0.45, 0.8  # largest descriptor distance, and its largest ratio to the second best
_CANDIDATES = 12  # cost: features with the largest determinants among which a triple is looked for
_SIDE, _SINE = 0.08, 0.3  # least distance of two of three points [m], and least sine of an angle of their triangle


@dataclass(frozen=True, eq=False)
class ObjectDatabase:
    """What is known of an object beforehand: its features in the initial scene."""

    points: Array  # 3D positions (M, 3) in world coordinates [m], M_j of step c
    descriptors: NDArray[np.float32]  # (M, D)
    laplacian: NDArray[np.int8]  # signs (M,)
    origin: Array  # A (3,), the origin of the object's coordinates in the initial scene [m]

    @classmethod
    def of(
        cls, features: StereoFeatures, rows: NDArray, rig: StereoRig, T_world_left: Array, origin: Array
    ) -> ObjectDatabase:
        """From the features of the initial scene that lie on the object; those that have no depth are left out."""
        seen = features.select(rows)
        points = transform(T_world_left, rig.triangulate(seen.uv_left, seen.uv_right))
        deep = np.isfinite(points).all(axis=1)
        return cls(points[deep], seen.descriptors[deep], seen.laplacian[deep], origin)

    def find(self, features: StereoFeatures, rig: StereoRig, T_world_left: Array) -> Array | None:
        """The object's pose (4, 4), of axes that were the world's in the initial scene; None where it is not found.

        Of the features that are recognised (step c) the three with the largest determinant (of the Hessian, the
        detector's response) are taken (step a); where they make no frame, the next ones.
        """
        seen = features.select(features.has_stereo)
        found = match_everywhere(self.descriptors, self.laplacian, seen, *_ALIKE)
        known, rows = found.tracks, found.features
        order = np.argsort(-seen.response[rows], kind="stable")[:_CANDIDATES]
        points = transform(T_world_left, rig.triangulate(seen.uv_left, seen.uv_right))
        for triple in sorted(combinations(range(len(order)), 3), key=lambda three: three[::-1]):  # by the weakest one
            three = order[list(triple)]
            current, initial = points[rows[three]], self.points[known[three]]
            if makes_a_frame(current) and makes_a_frame(initial):
                R, shift = motion_of_triples(current, initial, self.origin)
                return pose(R, self.origin + shift)
        return None


def body_frame(A: Array, B: Array, C: Array) -> Array:
    """Rotation (3, 3) of the body frame of three points: columns x, y, z in world axes (paper B, Procedure 1).

    x is along AB, y along AB × AC, z along AB × (AB × AC).
    """
    x = B - A
    y = np.cross(x, C - A)
    z = np.cross(x, y)
    return np.column_stack([v / np.linalg.norm(v) for v in (x, y, z)])


def makes_a_frame(points: Array) -> bool:
    """Whether points A, B, C (3, 3) [m] have a depth each, and are neither near each other nor nearly on a line."""
    sides = points[[1, 2, 2]] - points[[0, 0, 1]]
    lengths = np.linalg.norm(sides, axis=1)
    area = np.linalg.norm(np.cross(sides[0], sides[1]))
    return bool(lengths.min() >= _SIDE and area >= _SINE * np.sort(lengths)[1:].prod())  # false for NaN, too


def motion_of_triples(current: Array, initial: Array, origin: Array) -> tuple[Array, Array]:
    """``R_2^1`` (3, 3) and ``AA′`` (3,) from three points in the current and initial scene (steps b to e)."""
    R = body_frame(*current) @ body_frame(*initial).T
    return R, current[0] + R @ (origin - initial[0]) - origin
