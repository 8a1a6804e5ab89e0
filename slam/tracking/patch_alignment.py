"""Features that slide: the image around a landmark's first sight, aligned in this frame to sub-pixel accuracy.

A detector finds a feature at another place of the surface as the view changes. The place is therefore corrected: what
was seen there first, warped as a small surface that faces the camera would be, is aligned to what is seen now. It is
taken anew, at the place to which it was aligned, where it is seen larger or smaller by a fifth; and where it fits no
more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, Patches, StereoFeatures
from slam.geometry.arrays import Array, isin
from slam.geometry.rig import RectifiedRig, StereoRig
from slam.interfaces import AligningFrontend, Frontend
from slam.landmarks import LandmarkRows
from slam.tracking.answer_check import require_aligned, require_patches
from slam.tracking.localizer import LandmarkMatches

_LARGEST = 1.5  # factor by which a patch may have grown or shrunk at most: `Patches` hold no more
_RENEWED = np.sqrt(_LARGEST)  # factor from which it is taken anew: a second change like it stays below the largest
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
        old = self.select(~isin(self.ids, ids))
        ids = np.concatenate([old.ids, ids])
        poses = np.concatenate([old.poses, np.tile(T_world_left, (len(patches), 1, 1))])
        return Anchors(ids, old.patches.joined(patches), poses).select(np.argsort(ids, kind="stable"))

    def known(self, landmarks: LandmarkRows) -> Anchors:
        """Those of landmarks that are in the map and were measured lately."""
        rows = np.minimum(landmarks.rows(self.ids), max(len(landmarks) - 1, 0))
        if not len(landmarks):
            return Anchors.none()
        keep = (landmarks.ids[rows] == self.ids) & (landmarks.unseen[rows] <= _FORGOTTEN)
        return self.select(keep)


@dataclass(frozen=True)
class Aligned:
    """A frame whose features were aligned.

    Attributes:
        features: the same, as measured; those of landmarks whose patch was found have moved there.
        anchors: those that hold.
    """

    features: StereoFeatures
    anchors: Anchors


class Aligner:
    """Moves features of landmarks to where the landmarks were seen first, where the front end can do that.

    Args:
        rig: the cameras.
        enabled: see `slam.tracking.association.AssociationConfig.align`; else features stay.
    """

    def __init__(self, rig: StereoRig, enabled: bool) -> None:
        self._rig = rig
        self._enabled = enabled

    def align(
        self,
        frontend: Frontend | None,
        anchors: Anchors,
        features: StereoFeatures,
        matches: LandmarkMatches,
        landmarks: LandmarkRows,
        positions: Callable[[IdArray], Array],
    ) -> Aligned:
        """Move the features of landmarks to where the landmarks' patches are; without a patch they stay.

        Args:
            frontend: that the features are from.
            anchors: of the landmarks.
            features: of the frame, as measured.
            matches: landmarks that were found, and the pose on which they agree; without one nothing is aligned.
            landmarks: the map.
            positions: gives the positions (M, 3) in the world of landmarks by their ids (M,).

        Raises:
            SlamError: the front end gives something else than pixels.
        """
        if not self._enabled or not isinstance(frontend, AligningFrontend):
            return Aligned(features, Anchors.none())
        anchors = anchors.known(landmarks)
        known, order = isin(anchors.ids, matches.ids), isin(matches.ids, anchors.ids)
        if matches.T_world_left is None or features.images is None or not known.any():
            return Aligned(features, anchors)
        rows, matched = matches.rows[order], anchors.select(known)  # both by ascending id
        rectified = self._rig.rectified
        warps = warps_of(rectified, matched.poses, matches.T_world_left, positions(matched.ids))
        growth = np.sqrt(np.abs(np.linalg.det(warps)))
        similar = (growth <= _LARGEST) & (growth * _LARGEST >= 1)
        outgrown = (growth > _RENEWED) | (growth * _RENEWED < 1)
        left, right = rectified.rectify_left(features.uv_left[rows]), rectified.rectify_right(features.uv_right[rows])
        answer = frontend.align(features.images, matched.patches, warps, left, right)
        left, right = require_aligned(answer, len(rows), frontend)
        stereo = features.has_stereo[rows]
        found = similar & rectified.rig.left.in_image(left) & (rectified.rig.right.in_image(right) | ~stereo)
        right[~stereo] = np.nan
        uv_left, uv_right = features.uv_left.copy(), features.uv_right.copy()
        uv_left[rows[found]] = rectified.unrectify_left(left[found])
        uv_right[rows[found]] = rectified.unrectify_right(right[found])
        return Aligned(
            replace(features, uv_left=uv_left, uv_right=uv_right),
            anchors.select(~isin(anchors.ids, matched.ids[~found | outgrown])),
        )

    def anchored(
        self,
        frontend: Frontend | None,
        aligned: Aligned,
        matches: LandmarkMatches,
        added: LandmarkMatches,
        T_world_left: Array,
    ) -> Anchors:
        """The anchors that hold after a frame, with new ones for its landmarks that have none.

        Args:
            frontend: that the features are from.
            aligned: the frame.
            matches: landmarks that were found in it.
            added: those that are new.
            T_world_left: its pose (4, 4).

        Raises:
            SlamError: the front end gives no patches, or not one for each.
        """
        anchors, features = aligned.anchors, aligned.features
        if not self._enabled or not isinstance(frontend, AligningFrontend) or features.images is None:
            return anchors
        ids, rows = np.concatenate([matches.ids, added.ids]), np.concatenate([matches.rows, added.rows])
        new = ~isin(ids, anchors.ids)
        if not new.any():
            return anchors
        uv = self._rig.rectified.rectify_left(features.uv_left[rows[new]])
        patches = frontend.patches(features.images, uv, features.scale[rows[new]])
        require_patches(patches, len(uv), anchors.patches, frontend)
        return anchors.with_new(ids[new], patches, T_world_left)


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
