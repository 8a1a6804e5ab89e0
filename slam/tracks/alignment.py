"""Corrects drifting features: aligns the image patch of a point's first sight with this frame, to sub-pixels.

As the view changes, a detector finds a feature at another point of the surface. So the patch seen at first, warped as a
small surface that faces the camera, is aligned with the present image, and the feature moved there. The patch is taken
again, at the aligned position, once its size has changed by a fifth or it no longer fits. Seen from a body it is the
camera that moves: its members are aligned as landmarks are, by the camera's poses in the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from slam.data import IndexArray, Patches, StereoFeatures
from slam.errors import SlamError
from slam.geometry.arrays import Array, changed
from slam.geometry.rig import StereoRig
from slam.interfaces import AligningFrontend
from slam.third_party import checked
from slam.tracks.table import STILL, LandmarkTable, Patch

_LARGEST = 1.5  # largest factor by which a patch may have grown or shrunk: `Patches` hold no more
_RENEWED = np.sqrt(_LARGEST)  # factor from which it is taken again, so that another such change stays below the largest
_PARTS = attrgetter("image", "centre", "size", "T_left")  # of a `Patch`


@dataclass(frozen=True, eq=False)
class Aligner:
    """Moves features to where patches of earlier frames are found, by a front end that can do that."""

    rig: StereoRig
    frontend: AligningFrontend

    def align(
        self, features: StereoFeatures, rows: IndexArray, table: LandmarkTable, at: IndexArray, T_left: Array,
        positions: Array, body: int = STILL,
    ) -> StereoFeatures:  # fmt: skip
        """The features, with those in `rows` (K,) moved to where the patches of points are found that they show.

        The points are `at` (K,) in the table, at `positions` (K, 3) [m] in the world, or in a body; there the camera
        is at `T_left` (4, 4). Those without a patch are unchanged; patches that are to be taken anew, and those of
        landmarks not seen for long, are dropped, in place. Raises SlamError where the front end does not return pixels.
        """
        if body == STILL:
            table.patches[at[table.unseen[at] > 10]] = None  # [frames]
        usable = table.has_patch(at, body)
        if features.images is None or not usable.any():
            return features
        rows, at = rows[usable], at[usable]
        images, centres, size, poses = map(np.array, zip(*map(_PARTS, table.patches[at])))
        warps = warps_of(self.rig, poses, T_left, positions[usable])
        growth = np.sqrt(np.abs(np.linalg.det(warps)))
        similar = (growth <= _LARGEST) & (growth * _LARGEST >= 1)
        outgrown = (growth > _RENEWED) | (growth * _RENEWED < 1)
        start = features.uv_left[rows], features.uv_right[rows]
        answer = self.frontend.align(features.images, Patches(images, centres, size), warps, *start)
        if (got := [np.shape(uv) for uv in checked(self.frontend, "align", answer)]) != 2 * [start[0].shape]:
            what = f"{type(self.frontend).__name__}.align: must give left and right pixels {start[0].shape}"
            raise SlamError(f"{what}, got {got}")
        left, right = answer
        stereo = features.has_stereo[rows]
        aligned = similar & self.rig.left.in_image(left) & (self.rig.right.in_image(right) | ~stereo)
        right[~stereo] = np.nan
        uv_left, uv_right = features.uv_left.copy(), features.uv_right.copy()
        uv_left[rows[aligned]], uv_right[rows[aligned]] = left[aligned], right[aligned]
        table.patches[at[~aligned | outgrown]] = None
        return changed(features, uv_left=uv_left, uv_right=uv_right)

    def take_patches(
        self, features: StereoFeatures, rows: IndexArray, table: LandmarkTable, at: IndexArray, T_left: Array,
        body: int = STILL,
    ) -> None:  # fmt: skip
        """Points that have no patch get one, in place, at their aligned features; arguments as of `align`.

        Raises SlamError where the front end returns no patches, or not one for each point.
        """
        new = ~table.has_patch(at, body)
        at, rows, sizes = at[new], rows[new], {"n": int(new.sum())}
        if features.images is None or not len(at):
            return
        one = next((patch for patch in table.patches.tolist() if patch is not None), None)
        if one is not None:
            sizes["s"] = len(one.image)
        answer = self.frontend.patches(features.images, features.uv_left[rows], features.scale[rows])
        taken: Patches = checked(self.frontend, "patches", answer, **sizes)
        parts = zip(taken.images, taken.centres, taken.size)
        table.patches[at] = [Patch(*each, body, T_left) for each in parts]


def shifted_as(corrected: StereoFeatures, before: StereoFeatures, now: StereoFeatures) -> StereoFeatures:
    """Corrected features that move as the measured ones did: the correction is the same over so small a shift."""
    if corrected is before:
        return now
    left, right = now.uv_left - before.uv_left, now.uv_right - before.uv_right
    return changed(corrected, uv_left=corrected.uv_left + left, uv_right=corrected.uv_right + right)


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
