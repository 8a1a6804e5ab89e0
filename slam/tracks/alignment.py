"""Corrects drifting features: aligns the image patch of a landmark's first sight with this frame, to sub-pixels.

As the view changes, a detector finds a feature at another point of the surface. So the patch seen at first, warped as a
small surface that faces the camera, is aligned with the present image, and the feature moved there. The patch is taken
again, at the aligned position, once its size has changed by a fifth or it no longer fits.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter

import numpy as np

from slam.data import IdArray, Patches, StereoFeatures
from slam.errors import SlamError
from slam.geometry.arrays import Array, changed, isin
from slam.geometry.rig import StereoRig
from slam.interfaces import AligningFrontend
from slam.third_party import checked
from slam.tracks.step import LandmarkMatches
from slam.tracks.table import LandmarkTable, Patch

_LARGEST = 1.5  # largest factor by which a patch may have grown or shrunk: `Patches` hold no more
_RENEWED = np.sqrt(_LARGEST)  # factor from which it is taken again, so that another such change stays below the largest
_PARTS = attrgetter("image", "centre", "size", "T_world_left")  # of a `Patch`


def align(
    rig: StereoRig, frontend: AligningFrontend, features: StereoFeatures, matches: LandmarkMatches,
    landmarks: LandmarkTable, positions: Callable[[IdArray], Array],
) -> StereoFeatures:  # fmt: skip
    """Move landmarks' features to where the landmarks' patches are found; those without a patch are unchanged.

    Patches that are to be taken anew are dropped, in place. Without a pose on which the matches agree nothing is
    aligned. `positions` returns landmarks' positions (M, 3) [m] in the world by their ids (M,). Raises SlamError where
    the front end does not return pixels.
    """
    landmarks.patches[landmarks.unseen > 10] = None  # [frames]
    at = landmarks.rows(matches.ids)
    usable = landmarks.has_patch(at)
    if matches.T_world_left is None or features.images is None or not usable.any():
        return features
    rows, at = matches.rows[usable], at[usable]
    images, centres, size, poses = map(np.array, zip(*map(_PARTS, landmarks.patches[at])))
    warps = warps_of(rig, poses, matches.T_world_left, positions(landmarks.ids[at]))
    growth = np.sqrt(np.abs(np.linalg.det(warps)))
    similar = (growth <= _LARGEST) & (growth * _LARGEST >= 1)
    outgrown = (growth > _RENEWED) | (growth * _RENEWED < 1)
    start = features.uv_left[rows], features.uv_right[rows]
    answer = frontend.align(features.images, Patches(images, centres, size), warps, *start)
    if (got := [np.shape(uv) for uv in checked(frontend, "align", answer)]) != 2 * [start[0].shape]:
        what = f"{type(frontend).__name__}.align: must give left and right pixels {start[0].shape}"
        raise SlamError(f"{what}, got {got}")
    left, right = answer
    stereo = features.has_stereo[rows]
    aligned = similar & rig.left.in_image(left) & (rig.right.in_image(right) | ~stereo)
    right[~stereo] = np.nan
    uv_left, uv_right = features.uv_left.copy(), features.uv_right.copy()
    uv_left[rows[aligned]], uv_right[rows[aligned]] = left[aligned], right[aligned]
    landmarks.patches[at[~aligned | outgrown]] = None
    return changed(features, uv_left=uv_left, uv_right=uv_right)


def take_patches(
    frontend: AligningFrontend, features: StereoFeatures, seen: LandmarkMatches, landmarks: LandmarkTable,
    T_world_left: Array,
) -> None:  # fmt: skip
    """Landmarks that were seen from a pose (4, 4) and have no patch get one, in place, at their aligned features.

    Raises SlamError where the front end returns no patches, or not one for each landmark.
    """
    seen = seen.select(isin(seen.ids, landmarks.ids))
    at = landmarks.rows(seen.ids)
    new = ~landmarks.has_patch(at)
    at, rows, sizes = at[new], seen.rows[new], {"n": int(new.sum())}
    if features.images is None or not len(at):
        return
    one = next((patch for patch in landmarks.patches.tolist() if patch is not None), None)
    if one is not None:
        sizes["s"] = len(one.image)
    answer = frontend.patches(features.images, features.uv_left[rows], features.scale[rows])
    taken: Patches = checked(frontend, "patches", answer, **sizes)
    landmarks.patches[at] = [Patch(*each, T_world_left) for each in zip(taken.images, taken.centres, taken.size)]


def warps_of(rig: StereoRig, poses: Array, T_world_left: Array, positions: Array) -> Array:
    """Matrices (N, 2, 2) from present pixel offsets to those seen from earlier poses (N, 4, 4), at points (N, 3) [m].

    The surface around a point is taken to face the camera.
    """
    f = np.array([rig.left.fu, rig.left.fv])
    R_now, R_then = T_world_left[:3, :3], poses[:, :3, :3]
    depth = (positions - T_world_left[:3, 3]) @ R_now[:, 2]
    then = np.einsum("nij,ni->nj", R_then, positions - poses[:, :3, 3])
    R = np.einsum("nij,ik->njk", R_then, R_now)
    on_surface = R[:, :, :2] * (depth[:, None, None] / f)
    x = then[:, :2, None] / then[:, 2, None, None]
    return f[:, None] * (on_surface[:, :2] - x * on_surface[:, 2:]) / then[:, 2, None, None]
