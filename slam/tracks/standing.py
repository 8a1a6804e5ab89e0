"""Whether the camera stands: a test of what its images show, whatever moves in front of it.

A camera stands if most features stay at their pixels and no small motion explains the rest of what is left of noise.
Once it stands, features that stay where they were are witnesses, however few a passing body leaves of them: a motion of
the camera would move them too. It is over as soon as some motion of the camera explains witnesses and moving features
alike. While the camera stands, only features that stay are used to measure its pose and to make landmarks.

Places are pixels and no points of the world: they are compared with the features before the pose is predicted, as how
it is predicted depends on them, and they have neither a depth nor a prediction of their own. So they are no tracks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS, chi_square_limit
from slam.data import StereoFeatures
from slam.geometry.arrays import BoolArray, Table, changed, median, quantile
from slam.geometry.rig import MINIMAL_POINTS, StereoRig, measurement_rows
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.tracks.follow import Windows, follow

_FRAMES = 3  # in which a feature stays at its pixel, and in which most do, before that counts
_GATE = chi_square_limit(3, 0.997)  # of the displacement of a feature that stays
_MOVES = chi_square_limit(6, 1 - 1e-4)  # of a common motion; asked in every frame
_MEDIAN = chi_square_limit(3, 0.5)
_FEW = 2 * MINIMAL_POINTS  # features that tell nothing of a motion


@dataclass(frozen=True, eq=False)
class Places(Table):
    """Features that may stay at their pixels, a row each."""

    z: Array  # mean (uL, vL, uR) of their first sights (K, 3) [px]
    descriptors: NDArray[np.float32]  # at first sight (K, D)
    laplacian: NDArray[np.int8]  # signs of the Laplacian (K,)
    sights: NDArray[np.int64]  # number of frames in which each was there (K,)
    missed: NDArray[np.int64]  # frames since (K,)

    @classmethod
    def of(cls, z: Array, features: StereoFeatures) -> Places:
        """Features at `z` (N, 3), seen for the first time."""
        ones = np.ones(len(z), np.int64)
        return cls(z, features.descriptors, features.laplacian, ones, 0 * ones)

    def after(self, at: NDArray, rows: NDArray, z: Array, features: StereoFeatures) -> Places:
        """The places after a frame with features (N,) at `z` (N, 3), of which `rows` stayed at the places `at`."""
        sights, missed, mean = self.sights.copy(), self.missed + 1, self.z.copy()
        sights[at] += 1
        missed[at] = 0
        # 10: sights whose mean is a feature's place; later ones would follow a slow motion
        share = np.where(sights[at] <= 10, 1.0 / sights[at], 0.0)
        mean[at] += share[:, None] * (z[rows] - mean[at])
        keep = np.flatnonzero((missed <= sights) | (sights > _FRAMES))
        keep = np.sort(keep[np.argsort(missed[keep], kind="stable")][:3000])  # 3000: features
        new = np.delete(np.arange(len(z)), rows)
        kept = changed(self, z=mean, sights=sights, missed=missed).select(keep)
        return kept.joined(Places.of(z[new], features.select(new)))


def _none() -> NDArray[np.intp]:
    return np.zeros(0, np.intp)


@dataclass(frozen=True, eq=False)
class Rest:
    """A rest that a common motion has ended: of the camera, or of a body that fills most of the view.

    Features that stay exactly where they were refute the camera's motion, unless they are too far to show it, or are
    fastened to the camera: such are nearer than nearly all that moves.
    """

    places: Places  # features that stayed
    T_world_left: Array  # the camera's pose (4, 4)
    rows: NDArray[np.intp] = field(default_factory=_none)  # rows of the present features that still stay (M,)
    shift: Array = field(default_factory=lambda: np.zeros((0, 3)))  # of these since the rest (M, 3) [px]
    unseen: int = 0  # frames in succession in which these were too few to tell
    refuted: int = 0  # frames in succession in which they refuted the camera's motion

    @property
    def goes_on(self) -> bool:
        """Whether the camera rests, as it is a body that moves."""
        return self.refuted >= _FRAMES

    def after(self, z: Array, seen: StereoFeatures, stereo: NDArray[np.intp], sigma: float) -> Rest | None:
        """The rest after a frame with features (N,) at `z` (N, 3), in rows `stereo`; None if it is over."""
        _, rows, shift = _staying(self.places, np.inf, z, seen, sigma)
        unseen = self.unseen + 1 if len(rows) <= _FEW else 0
        if unseen > (_FRAMES if self.goes_on else 0):
            return None
        return changed(self, rows=stereo[rows], shift=shift, unseen=unseen)


@dataclass(frozen=True, eq=False)
class Standing:
    """What is known of a camera at rest."""

    places: Places | None = None  # features that may stay; None before the first frame
    frames: int = 0  # number of frames in which most features stayed where they were in the first of them
    # rows of the present features that stay (M,); meaningful if the camera stands
    witnesses: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    variance: float = np.inf  # of a pixel of a feature that stays [px²], as seen so far; infinite before anything was
    # the camera's pose (4, 4) in the last frame whose images were new
    T_world_left: Array = field(default_factory=lambda: np.eye(4))
    blind: int = 0  # number of frames in which too little of what stays was seen to tell, as something hides it
    rest: Rest | None = None  # an earlier one, while features stay where they were then

    @cached_property
    def stands(self) -> bool:
        """Whether the camera stands for certain."""
        return self.frames > _FRAMES or self.goes_on

    @property
    def goes_on(self) -> bool:
        """Whether it is the earlier rest that goes on."""
        return self.rest is not None and self.rest.goes_on

    def holds(self, lost: bool) -> bool:
        """Whether the camera stands at a known place, or something hides what it knows: then no other is looked for."""
        return self.stands and (self.blind > 0 or not lost)

    def after(self, rig: StereoRig, sigma: float, features: StereoFeatures) -> Standing:
        """What a frame's features with a right pixel say; `sigma` is the pixel noise [px]."""
        standing = self._after(rig, sigma, features)
        return changed(standing, witnesses=standing.rest.rows) if standing.rest and standing.goes_on else standing

    def _after(self, rig: StereoRig, sigma: float, features: StereoFeatures) -> Standing:
        stereo, places = np.flatnonzero(features.has_stereo), self.places
        seen = features.select(stereo)
        z = measurement_rows(seen.uv_left, seen.uv_right)
        begun = Standing(Places.of(z, seen), T_world_left=self.T_world_left)
        if places is None or places.descriptors.shape[1] != seen.descriptors.shape[1]:
            return begun
        rest = None if self.rest is None else self.rest.after(z, seen, stereo, sigma)
        begun, stood = changed(begun, rest=rest), self.frames > _FRAMES
        at, rows, shift = _staying(places, self.variance, z, seen, sigma)
        most = 2 * len(rows) > min(len(z), int((places.missed == 0).sum()))
        if not (stood or most):
            return begun
        witnesses = stereo[rows[places.sights[at] >= _FRAMES]]
        places_after = places.after(at, rows, z, seen)
        at_rest, variance = _at_rest(rig, places.z[at], shift, self.variance)
        if at_rest:
            return changed(begun, places=places_after, frames=self.frames + 1, witnesses=witnesses, variance=variance)
        if stood and len(rows) <= _FEW and self.blind < min(self.frames, 10):  # frames: then carried off
            return changed(self, places=places_after, witnesses=witnesses, blind=self.blind + 1, rest=rest)
        return changed(begun, rest=rest or _ended(places, self.T_world_left)) if stood else begun

    def contested(
        self, rig: StereoRig, sigma: float, features: StereoFeatures, matched: NDArray[np.intp], T_world_left: Array
    ) -> Standing:
        """At rest no more if a motion of the camera explains all: landmarks left their pixels by it, few witnesses do.

        At rest again where features that stayed in an earlier rest refute that motion. `sigma` is the pixel noise [px],
        `matched` are rows of the features that agree on a pose `T_world_left` (4, 4).
        """
        if self.goes_on:
            return self
        after, motion = self, inverse(T_world_left) @ self.T_world_left
        z = measurement_rows(features.uv_left, features.uv_right)
        if self.stands:
            left = np.setdiff1d(matched, self.witnesses)
            moved, witnesses = (_moved(rig, sigma, z[rows], z[rows], motion).sum() for rows in (left, self.witnesses))
            # 0.1: share of landmarks that a motion must move, for it to be one
            if moved > 0.1 * len(matched) and 2 * witnesses < max(len(self.witnesses), 1):
                after = changed(self.moving(), rest=self.rest or _ended(self.places, self.T_world_left))
        rest = after.rest
        if rest is None or not len(rest.rows):
            return after
        motion = inverse(T_world_left) @ rest.T_world_left
        left = np.setdiff1d(matched[features.has_stereo[matched]], rest.rows)
        moving = left[_moved(rig, sigma, z[left], z[left], motion)]
        stay = rest.rows[_moved(rig, sigma, z[rest.rows] - rest.shift, z[rest.rows], motion)]
        refuted = min(len(stay), len(moving)) > _FEW and not _nearer(z, stay, moving)
        rest = changed(rest, refuted=rest.refuted + 1 if refuted else 0)
        if not rest.goes_on:
            return changed(after, rest=rest)
        return changed(after, rest=rest, witnesses=rest.rows, T_world_left=rest.T_world_left)

    def unseen(self) -> Standing:
        """After a frame whose features are left out, as its images are earlier ones."""
        return changed(self, frames=0, witnesses=self.witnesses[:0])

    def moving(self) -> Standing:
        """The same features, of a camera that does not stand."""
        return changed(self, frames=0, rest=None)


def _ended(places: Places | None, T_world_left: Array) -> Rest | None:
    """The rest at a pose (4, 4) that has just ended, perhaps."""
    return None if places is None else Rest(places.select(places.sights >= _FRAMES), T_world_left)


def _staying(
    places: Places, variance: float, z: Array, seen: StereoFeatures, sigma: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Places whose features stay, rows of these features, and by how much they are off (M, 3) [px]."""
    radius, none = SIGMAS * np.sqrt(2.0) * sigma, np.zeros((len(places.z), 2, 2))
    # 0.5: largest distance of descriptors of one feature in unchanged light
    near = Windows((1.0,), (0.5,), 1.0, radius, radius)
    pairs = follow(places.z[:, :2], none, places.descriptors, places.laplacian, seen, near)
    at, rows = pairs.tracks, pairs.features
    shift = z[rows] - places.z[at]
    stay = np.square(shift).sum(axis=1) <= _GATE * min(variance, 2.0 * sigma**2)
    return at[stay], rows[stay], shift[stay]


def _nearer(z: Array, some: NDArray[np.intp], others: NDArray[np.intp]) -> bool:
    """Whether of features at `z` (N, 3) three of four in rows `some` are nearer than three of four `others`."""
    disparity = z[:, 0] - z[:, 2]
    return quantile(disparity[some], 0.25) > quantile(disparity[others], 0.75)


def _moved(rig: StereoRig, sigma: float, before: Array, now: Array, motion: Array) -> BoolArray:
    """Which features are not where a motion (4, 4) takes what was seen `before` (M, 3), but off by more than noise."""
    local = rig.triangulate(before[:, :2], before[:, [2, 1]])
    pixels, _ = rig.project_stereo(transform(motion, local), jacobian=False)
    return np.asarray(((pixels - now) ** 2).sum(axis=1) > _GATE * 2.0 * sigma**2)


def _at_rest(rig: StereoRig, before: Array, d: Array, variance: float) -> tuple[bool, float]:
    """Whether no common motion moves features that stay by more than noise, and the variance of a pixel [px²].

    They were at (uL, vL, uR) (M, 3) `before` and have moved by `d` (M, 3) [px].
    """
    local = rig.triangulate(before[:, :2], before[:, [2, 1]])
    used = np.flatnonzero(np.isfinite(local).all(axis=1))
    if len(used) <= _FEW:
        return False, variance
    _, J = rig.project_stereo(local[used])
    J = J @ points_by_pose(local[used])
    d, weight = d[used], np.ones(len(used))
    for _ in range(3):  # 3: of reweighting
        WJ = weight[:, None, None] * J
        information = np.einsum("nij,nik->jk", WJ, J)
        xi = np.linalg.lstsq(information, np.einsum("nij,ni->j", WJ, d), rcond=1e-12)[0]
        squares = ((d - J @ xi) ** 2).sum(axis=1)
        variance = max(median(squares) / _MEDIAN, 0.05**2)  # 0.05: [px] of a pixel: no feature is found more precisely
        weight = 1.0 / np.maximum(1.0, squares / (_MEDIAN * variance))
    by_motion = J @ xi
    test = float(np.einsum("n,nij,nij->", weight, by_motion[:, :, None], by_motion[:, :, None])) / variance
    # 0.25: of the variance of a pixel, that features may share: light moves them alike, too
    within_noise = float((by_motion**2).mean()) < 0.25 * variance
    return test < _MOVES or within_noise, variance
