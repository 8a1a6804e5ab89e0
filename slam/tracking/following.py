"""Landmarks followed by their image: where the patch around their first sight is in this frame, to sub-pixel accuracy.

A feature slides over the surface as the view changes, and a detector does not find it in each frame. The image around
a landmark is therefore looked for where the landmark is expected, warped as a small surface that faces the camera would
be. It is taken anew where the view has changed by much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.interfaces import FollowingFrontend, Patches
from slam.landmarks import LandmarkRows
from slam.tracking.localizer import LandmarkMatches

_LARGEST = 1.5  # factor by which a patch may have grown or shrunk before it is taken anew: `Patches` hold no more
_APART = 2.0  # least distance from a feature that is another landmark [px]
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
class Followed:
    """A frame after landmarks were followed into it.

    Attributes:
        features: those of the frame, as measured; landmarks that were found have moved there or are new rows.
        matches: the same and those that the detector had not found.
        anchors: those that hold.
    """

    features: StereoFeatures
    matches: LandmarkMatches
    anchors: Anchors


def follow(
    frontend: FollowingFrontend,
    rig: StereoRig,
    as_measured: Callable[[Array], Array],
    anchors: Anchors,
    features: StereoFeatures,
    matches: LandmarkMatches,
    landmarks: LandmarkRows,
    positions: Array,
) -> Followed:
    """Find landmarks by their patches: those that were matched, and those in view that were not.

    Args:
        frontend: that the features are from.
        rig: the cameras.
        as_measured: takes rectified rows (uL, vL, uR) (N, 3) [px] that `rig` would measure to those that are measured.
        anchors: of the landmarks that can be followed.
        features: of the frame, as measured.
        matches: landmarks that were recognised, and the pose on which they agree; without one nothing is followed.
        landmarks: the map.
        positions: of its landmarks (N, 3) in the world.
    """
    T, images = matches.T_world_left, features.images
    anchors = anchors.known(landmarks)
    if T is None or images is None or not len(anchors):
        return Followed(features, matches, anchors)
    rectified = rig.rectified
    rows = landmarks.rows(anchors.ids)
    T_world_camera = T @ rectified.T_left_rectified
    start_left, start_right = _expected(rig, as_measured, transform(inverse(T_world_camera), positions[rows]))
    feature = np.full(len(landmarks), -1)
    feature[landmarks.rows(matches.ids)] = matches.rows
    feature = feature[rows]
    matched = np.flatnonzero(feature >= 0)
    seen_left = rectified.rectify_left(features.uv_left[feature[matched]])
    seen_right = rectified.rectify_right(features.uv_right[feature[matched]])
    start_left[matched] = seen_left
    start_right[matched] = np.where(np.isfinite(seen_right), seen_right, start_right[matched])
    warps = warps_of(rectified.rig, rectified.T_left_rectified, anchors.poses, T_world_camera, positions[rows])
    growth = np.sqrt(np.abs(np.linalg.det(warps)))
    tried = np.flatnonzero(np.isfinite(start_left).all(axis=1) & (growth <= _LARGEST) & (growth * _LARGEST >= 1))
    left, right = np.full((2, len(anchors), 2), np.nan)
    left[tried], right[tried] = frontend.follow(
        images, anchors.patches.select(tried), warps[tried], start_left[tried], start_right[tried]
    )
    found = np.isfinite(left[:, 0]) & (np.isfinite(right[:, 0]) | (images.right is None))
    left, right = rectified.unrectify_left(left), rectified.unrectify_right(right)
    moved = matched[found[matched]]
    uv_left, uv_right = features.uv_left.copy(), features.uv_right.copy()
    uv_left[feature[moved]], uv_right[feature[moved]] = left[moved], right[moved]
    features = replace(features, uv_left=uv_left, uv_right=uv_right)
    new = np.flatnonzero(found & (feature < 0))
    new = new[~_near(left[new], uv_left[matches.rows])]
    features, matches = _with_new(features, matches, landmarks, anchors, rows[new], new, left[new], right[new])
    return Followed(features, matches, anchors.select(found | (feature < 0)))


def anchored(
    frontend: FollowingFrontend,
    rig: StereoRig,
    anchors: Anchors,
    features: StereoFeatures,
    seen: LandmarkMatches,
    T_world_left: Array,
) -> Anchors:
    """Anchors and those of the landmarks `seen` that have none, from a frame's features, as measured, and its pose."""
    rows = np.flatnonzero(~np.isin(seen.ids, anchors.ids))
    if features.images is None or not len(rows):
        return anchors
    uv = rig.rectified.rectify_left(features.uv_left[seen.rows[rows]])
    patches = frontend.patches(features.images, uv, features.scale[seen.rows[rows]])
    return anchors.with_new(seen.ids[rows], patches, T_world_left)


def _expected(rig: StereoRig, as_measured: Callable[[Array], Array], local: Array) -> tuple[Array, Array]:
    """Rectified pixels, left and right (N, 2), at which points (N, 3) before the camera are measured; else NaN."""
    z, _ = rig.rectified.rig.project_stereo(local, jacobian=False)
    z[(local[:, 2] <= 0) | ~rig.rectified.rig.left.in_image(z[:, :2])] = np.nan
    z = as_measured(z)
    return z[:, :2], z[:, [2, 1]]


def warps_of(rig: StereoRig, T_left_rectified: Array, poses: Array, T_world_camera: Array, positions: Array) -> Array:
    """Matrices (N, 2, 2) from pixel offsets now to those in the image of an earlier pose (N, 4, 4), for points (N, 3).

    The surface around a point is taken to face the camera.
    """
    now = (positions - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    R_then = poses[:, :3, :3] @ T_left_rectified[:3, :3]
    then = np.einsum("nij,ni->nj", R_then, positions - poses[:, :3, 3])
    R = np.einsum("nij,ik->njk", R_then, T_world_camera[:3, :3])
    f = np.array([rig.left.fu, rig.left.fv])
    on_surface = R[:, :, :2] * (now[:, 2, None, None] / f)
    x = then[:, :2, None] / then[:, 2, None, None]
    return f[:, None] * (on_surface[:, :2] - x * on_surface[:, 2:]) / then[:, 2, None, None]


def _near(uv: Array, others: Array) -> BoolArray:
    """Which pixels (N, 2) lie beside any of `others` (M, 2), or beside one before them."""
    gap = np.linalg.norm(uv[:, None] - np.concatenate([others, uv])[None], axis=2)
    gap[:, len(others) :][np.triu_indices(len(uv))] = np.inf
    return np.asarray((gap < _APART).any(axis=1))


def _with_new(
    features: StereoFeatures, matches: LandmarkMatches, landmarks: LandmarkRows, anchors: Anchors,
    rows: NDArray[np.intp], new: NDArray[np.intp], left: Array, right: Array,
) -> tuple[StereoFeatures, LandmarkMatches]:  # fmt: skip
    """Features and matches with landmarks found at pixels (N, 2): `rows` of the map, `new` of the anchors."""
    count = len(features)
    weakest = features.response.min() if count else 0.0
    more = {
        "uv_left": left, "uv_right": right, "scale": anchors.patches.size[new], "angle": np.zeros(len(new)),
        "response": np.full(len(new), weakest), "laplacian": landmarks.laplacian[rows],
        "descriptors": landmarks.descriptors[rows],
    }  # fmt: skip
    features = replace(features, **{k: np.concatenate([getattr(features, k), v]) for k, v in more.items()})
    ids = np.concatenate([matches.ids, landmarks.ids[rows]])
    places = np.concatenate([matches.rows, count + np.arange(len(new))])
    order = np.argsort(ids, kind="stable")
    return features, LandmarkMatches(ids[order], places[order], matches.T_world_left)
