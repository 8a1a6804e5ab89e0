"""Corrects drifting features: aligns the image patch of a landmark's first sight with this frame, to sub-pixels.

As the view changes, a detector finds a feature at another point of the surface. So the patch seen at first, warped as a
small surface that faces the camera, is aligned with the present image, and the feature moved there. The patch is taken
again, at the aligned position, once its size has changed by a fifth or it no longer fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, Patches, StereoFeatures
from slam.errors import SlamError
from slam.geometry.arrays import Array, ascending, isin
from slam.geometry.rig import RectifiedRig, StereoRig
from slam.interfaces import AligningFrontend, Frontend
from slam.third_party import checked
from slam.tracks.localizer import LandmarkMatches
from slam.tracks.table import LandmarkTable

_LARGEST = 1.5  # largest factor by which a patch may have grown or shrunk: `Patches` hold no more
_RENEWED = np.sqrt(_LARGEST)  # factor from which it is taken again, so that another such change stays below the largest
_FORGOTTEN = 10  # frames without a measurement after which a patch is dropped


@dataclass(frozen=True, eq=False)
class PatchAnchors:
    """Landmarks' image patches and the poses from which they were taken: one row per landmark, ids ascending.

    Attributes:
        ids: landmark ids (N,).
        patches: the images around the landmarks.
        poses: of the left camera in the world when they were taken (N, 4, 4).
    """

    ids: IdArray
    patches: Patches
    poses: Array

    @classmethod
    def none(cls) -> PatchAnchors:
        """No landmark."""
        return cls(np.zeros(0, np.int64), Patches.none(), np.zeros((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: BoolArray | NDArray[np.intp]) -> PatchAnchors:
        """Some of the rows, in order."""
        if keep.dtype == bool and keep.all():
            return self
        return PatchAnchors(self.ids[keep], self.patches.select(keep), self.poses[keep])

    def with_new(self, ids: IdArray, patches: Patches, T_world_left: Array) -> PatchAnchors:
        """These and new ones, which replace earlier ones of the same landmark."""
        old = self.select(~isin(self.ids, ids))
        ids = np.concatenate([old.ids, ids])
        poses = np.concatenate([old.poses, np.tile(T_world_left, (len(patches), 1, 1))])
        both = PatchAnchors(ids, old.patches.joined(patches), poses)
        return both if ascending(ids) else both.select(np.argsort(ids, kind="stable"))

    def known(self, landmarks: LandmarkTable) -> PatchAnchors:
        """Those of landmarks that are in the map and were measured recently."""
        rows = np.minimum(landmarks.rows(self.ids), max(len(landmarks) - 1, 0))
        if not len(landmarks):
            return PatchAnchors.none()
        keep = (landmarks.ids[rows] == self.ids) & (landmarks.unseen[rows] <= _FORGOTTEN)
        return self.select(keep)


@dataclass(frozen=True, eq=False)
class Aligned:
    """A frame whose features were aligned.

    Attributes:
        features: as measured, but those of landmarks whose patch was found have been moved there.
        anchors: those still valid.
    """

    features: StereoFeatures
    anchors: PatchAnchors


class Aligner:
    """Moves landmarks' features to the surface points first seen, if the front end can align patches.

    Args:
        rig: the cameras.
        enabled: see `slam.tracks.follow.AssociationConfig.align`; if False, features are left unchanged.
    """

    def __init__(self, rig: StereoRig, enabled: bool) -> None:
        self._rig = rig
        self._enabled = enabled

    def align(
        self,
        frontend: Frontend | None,
        anchors: PatchAnchors,
        features: StereoFeatures,
        matches: LandmarkMatches,
        landmarks: LandmarkTable,
        positions: Callable[[IdArray], Array],
    ) -> Aligned:
        """Move landmarks' features to where the landmarks' patches are found; those without a patch are unchanged.

        Args:
            frontend: which made the features.
            anchors: of the landmarks.
            features: of the frame, as measured.
            matches: landmarks that were found, and the pose on which they agree; without a pose nothing is aligned.
            landmarks: the map.
            positions: returns landmarks' positions (M, 3) [m] in the world by their ids (M,).

        Raises:
            SlamError: the front end does not return pixels.
        """
        if not self._enabled or not isinstance(frontend, AligningFrontend):
            return Aligned(features, PatchAnchors.none())
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
        left, right = _pixels(frontend, answer, len(rows))
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
    ) -> PatchAnchors:
        """The anchors valid after a frame, with new ones for its landmarks that have none.

        Args:
            frontend: which made the features.
            aligned: the frame.
            matches: landmarks found in the frame.
            added: new landmarks.
            T_world_left: the frame's pose (4, 4).

        Raises:
            SlamError: the front end returns no patches, or not one for each landmark.
        """
        anchors, features = aligned.anchors, aligned.features
        if not self._enabled or not isinstance(frontend, AligningFrontend) or features.images is None:
            return anchors
        ids, rows = np.concatenate([matches.ids, added.ids]), np.concatenate([matches.rows, added.rows])
        new = ~isin(ids, anchors.ids)
        if not new.any():
            return anchors
        uv = self._rig.rectified.rectify_left(features.uv_left[rows[new]])
        sizes = {"n": len(uv), **({"s": anchors.patches.images.shape[1]} if len(anchors) else {})}
        answer = frontend.patches(features.images, uv, features.scale[rows[new]])
        patches: Patches = checked(frontend, "patches", answer, **sizes)
        return anchors.with_new(ids[new], patches, T_world_left)


def _pixels(frontend: AligningFrontend, answer: Any, count: int) -> tuple[Array, Array]:
    """Left and right pixels (N, 2) that a front end has found; raises SlamError where it answered something else."""
    both = [np.shape(uv) for uv in checked(frontend, "align", answer)]
    if both != 2 * [(count, 2)]:
        raise SlamError(f"{type(frontend).__name__}.align: must give left and right pixels ({count}, 2), got {both}")
    return answer[0], answer[1]


def warps_of(rectified: RectifiedRig, poses: Array, T_world_left: Array, positions: Array) -> Array:
    """Matrices (N, 2, 2) from present pixel offsets to those seen from earlier poses (N, 4, 4), at points (N, 3) [m].

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
