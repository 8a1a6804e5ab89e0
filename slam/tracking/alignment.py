"""Features that slide: the image around a landmark's first sight, aligned in this frame to sub-pixel accuracy.

A detector finds a feature at another place of the surface as the view changes. The place is therefore corrected: what
was seen there first, warped as a small surface that faces the camera would be, is aligned to what is seen now. It is
taken anew where the view has changed by much, or where it fits no more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.geometry.rig import RectifiedRig, StereoRig
from slam.geometry.se3 import Array
from slam.interfaces import AligningFrontend, Patches
from slam.landmarks import LandmarkRows
from slam.tracking.answer_check import require_aligned, require_patches
from slam.tracking.localizer import LandmarkMatches

_LARGEST = 1.5  # factor by which a patch may have grown or shrunk before it is taken anew: `Patches` hold no more
_FORGOTTEN = 10  # frames without a measurement after which a patch is given up


@dataclass(frozen=True)
class Anchors:
    """What landmarks looked like where their patches were taken, a row each, ids ascending.

    Attributes:
        ids: landmark ids (N,).
        patches: the images around them.
        poses: of the left camera in the world (N, 4, 4).
    """

    ids: IdArray
    patches: Patches
    poses: Array

    @classmethod
    def none(cls) -> Anchors:
        """No landmark."""
        return cls(np.zeros(0, np.int64), Patches.none(), np.zeros((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: BoolArray | NDArray[np.intp]) -> Anchors:
        """Some of the rows, in order."""
        return Anchors(self.ids[keep], self.patches.select(keep), self.poses[keep])

    def with_new(self, ids: IdArray, patches: Patches, T_world_left: Array) -> Anchors:
        """These and new ones; a landmark's own are replaced."""
        old = self.select(~np.isin(self.ids, ids))
        ids = np.concatenate([old.ids, ids])
        poses = np.concatenate([old.poses, np.tile(T_world_left, (len(patches), 1, 1))])
        return Anchors(ids, old.patches.joined(patches), poses).select(np.argsort(ids, kind="stable"))

    def known(self, landmarks: LandmarkRows) -> Anchors:
        """Those of landmarks that are in the map and were measured lately."""
        rows = np.minimum(landmarks.rows(self.ids), max(len(landmarks) - 1, 0))
        if not len(landmarks):
            return Anchors.none()
        keep = (landmarks.ids[rows] == self.ids) & (landmarks.unseen[rows] <= _FORGOTTEN)
        return self if keep.all() else self.select(keep)


@dataclass(frozen=True)
class Aligned:
    """A frame whose features were aligned.

    Attributes:
        features: the same, as measured; those of landmarks whose patch was found have moved there.
        anchors: those that hold.
    """

    features: StereoFeatures
    anchors: Anchors


def align(
    frontend: AligningFrontend,
    rig: StereoRig,
    anchors: Anchors,
    features: StereoFeatures,
    matches: LandmarkMatches,
    landmarks: LandmarkRows,
    positions: Array,
) -> Aligned:
    """Move the features of landmarks to where the landmarks' patches are; without a patch they stay.

    Args:
        frontend: that the features are from.
        rig: the cameras.
        anchors: of the landmarks.
        features: of the frame, as measured.
        matches: landmarks that were found, and the pose on which they agree; without one nothing is aligned.
        landmarks: the map.
        positions: of its landmarks (N, 3) in the world.

    Raises:
        SlamError: the front end gives something else than pixels.
    """
    anchors = anchors.known(landmarks)
    known, order = np.isin(anchors.ids, matches.ids), np.isin(matches.ids, anchors.ids)
    if matches.T_world_left is None or features.images is None or not known.any():
        return Aligned(features, anchors)
    rows, matched = matches.rows[order], anchors.select(known)  # both by ascending id
    rectified, T = rig.rectified, matches.T_world_left
    warps = warps_of(rectified, matched.poses, T, positions[landmarks.rows(matched.ids)])
    growth = np.sqrt(np.abs(np.linalg.det(warps)))
    similar = (growth <= _LARGEST) & (growth * _LARGEST >= 1)
    left, right = rectified.rectify_left(features.uv_left[rows]), rectified.rectify_right(features.uv_right[rows])
    answer = frontend.align(features.images, matched.patches, warps, left, right)
    left, right = require_aligned(answer, len(rows), frontend)
    found = similar & rectified.rig.left.in_image(left)
    if features.images.right is not None:
        found &= rectified.rig.right.in_image(right)
    uv_left, uv_right = features.uv_left.copy(), features.uv_right.copy()
    uv_left[rows[found]] = rectified.unrectify_left(left[found])
    uv_right[rows[found]] = rectified.unrectify_right(right[found])
    return Aligned(
        replace(features, uv_left=uv_left, uv_right=uv_right),
        anchors.select(~np.isin(anchors.ids, matched.ids[~found])),
    )


def anchored(
    frontend: AligningFrontend,
    rig: StereoRig,
    anchors: Anchors,
    features: StereoFeatures,
    seen: LandmarkMatches,
    T_world_left: Array,
) -> Anchors:
    """Anchors and those of the landmarks `seen` that have none, from a frame's features, as measured, and its pose.

    Raises:
        SlamError: the front end gives no patches, or not one for each.
    """
    rows = np.flatnonzero(~np.isin(seen.ids, anchors.ids))
    if features.images is None or not len(rows):
        return anchors
    uv = rig.rectified.rectify_left(features.uv_left[seen.rows[rows]])
    patches = frontend.patches(features.images, uv, features.scale[seen.rows[rows]])
    require_patches(patches, len(rows), anchors.patches, frontend)
    return anchors.with_new(seen.ids[rows], patches, T_world_left)


def warps_of(rectified: RectifiedRig, poses: Array, T_world_left: Array, positions: Array) -> Array:
    """Matrices (N, 2, 2) from pixel offsets now to those in the image of an earlier pose (N, 4, 4), for points (N, 3).

    The surface around a point is taken to face the camera.
    """
    turn, f = rectified.R_left.T, np.array([rectified.rig.left.fu, rectified.rig.left.fv])
    R_now, R_then = T_world_left[:3, :3] @ turn, poses[:, :3, :3] @ turn
    depth = (positions - T_world_left[:3, 3]) @ R_now[:, 2]
    then = np.einsum("nij,ni->nj", R_then, positions - poses[:, :3, 3])
    R = np.einsum("nij,ik->njk", R_then, R_now)
    on_surface = R[:, :, :2] * (depth[:, None, None] / f)
    x = then[:, :2, None] / then[:, 2, None, None]
    return f[:, None] * (on_surface[:, :2] - x * on_surface[:, 2:]) / then[:, 2, None, None]
