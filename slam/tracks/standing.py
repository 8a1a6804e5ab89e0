"""Whether the camera stands: a test of what its images show, whatever moves in front of it.

A camera stands if most features that are found again stay at their pixels, and no small motion explains the rest of
what is left of noise. Once it stands, features that stay where they were are witnesses, however few a passing body
leaves of them: a motion of the camera would move them too. It is over as soon as some motion of the camera explains
witnesses and moving features alike. While the camera stands, only features that stay are used to measure its pose and
to make landmarks.

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
from slam.geometry.arrays import Table, changed, median
from slam.geometry.rig import MINIMAL_POINTS, StereoRig, measurement_rows
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.tracks.follow import ALIKE, Matches, Windows, follow, match_everywhere
from slam.window.consensus import CLEAR_MAJORITY, find_consensus

_FRAMES = 3  # in which a feature stays at its pixel, and in which most do, before that counts
_GATE = chi_square_limit(3, 0.997)  # of the displacement of a feature that stays
_MOVES = chi_square_limit(6, 1 - 1e-4)  # of a common motion; asked in every frame
_MEDIAN = chi_square_limit(3, 0.5)
_FEW = 2 * MINIMAL_POINTS  # features that tell nothing of a motion
_SIGHTS = 10  # whose mean is a feature's place; later ones would follow a slow motion
_HYPOTHESES = 50  # cost: motions tried that may explain what left its pixels


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

    def found(self, sigma: float, features: StereoFeatures, sizes: tuple[float, ...] = (1.0,)) -> Matches:
        """The features at the places: in a window that noise explains, then in larger ones of these `sizes`."""
        radius, none = SIGMAS * np.sqrt(2.0) * sigma, np.zeros((len(self), 2, 2))
        windows = Windows(sizes, ALIKE[:1] * len(sizes), 1.0, radius, radius)
        return follow(self.z[:, :2], none, self.descriptors, self.laplacian, features, windows)

    def after(self, at: NDArray, rows: NDArray, z: Array, features: StereoFeatures) -> Places:
        """The places after a frame with features (N,) at `z` (N, 3), of which `rows` stayed at the places `at`."""
        sights, missed, mean = self.sights.copy(), self.missed + 1, self.z.copy()
        sights[at] += 1
        missed[at] = 0
        share = np.where(sights[at] <= _SIGHTS, 1.0 / sights[at], 0.0)
        mean[at] += share[:, None] * (z[rows] - mean[at])
        keep = np.flatnonzero((missed <= sights) | (sights > _FRAMES))
        keep = np.sort(keep[np.argsort(missed[keep], kind="stable")][:3000])  # 3000: features
        new = np.delete(np.arange(len(z)), rows)
        kept = changed(self, z=mean, sights=sights, missed=missed).select(keep)
        return kept.joined(Places.of(z[new], features.select(new)))


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
    # frames in which too little of what stays was seen to tell, as something hides it, or which was the first to say
    # that it moves: light that changes says so once, a camera that moves goes on
    blind: int = 0
    left: Places | None = None  # the places of a rest that a vehicle has just ended; None without one
    fastened: Places | None = None  # what stayed at its pixels as a vehicle drove off, until it stands; None if nothing

    @cached_property
    def stands(self) -> bool:
        """Whether the camera stands for certain."""
        return self.frames > _FRAMES

    def holds(self, lost: bool) -> bool:
        """Whether the camera stands at a known place, or something hides what it knows: then no other is looked for."""
        return self.stands and (self.blind > 0 or not lost)

    def without_fastened(self, sigma: float, features: StereoFeatures) -> StereoFeatures:
        """The features without what is fastened to the camera, such as a bonnet; `sigma` is the pixel noise [px]."""
        fastened = self.fastened
        if not fastened or fastened.descriptors.shape[1] != features.descriptors.shape[1]:
            return features
        pairs = fastened.found(sigma, features)
        shift = measurement_rows(features.uv_left, features.uv_right)[pairs.features] - fastened.z[pairs.tracks]
        parted = np.square(shift).sum(axis=1) > _GATE * 2.0 * sigma**2  # of NaN false: a sight without a right pixel
        return features.select(np.delete(np.arange(len(features)), pairs.features[~parted]))

    def after(self, rig: StereoRig, sigma: float, features: StereoFeatures, wheels: bool = False) -> Standing:
        """What a frame's features with a right pixel say; `sigma` is the pixel noise [px].

        With `wheels` the camera is on a vehicle, see `MotionModel`.
        """
        stereo, places = np.flatnonzero(features.has_stereo), self.places
        seen = features.select(stereo)
        z = measurement_rows(seen.uv_left, seen.uv_right)
        begun = Standing(Places.of(z, seen), T_world_left=self.T_world_left, fastened=self.fastened)
        if places is None or places.descriptors.shape[1] != seen.descriptors.shape[1]:
            return begun
        variance = min(self.variance, 2.0 * sigma**2)
        if wheels and (rest := self._rest()) is not None:
            drives, held, share = _driven_past(rig, sigma, variance, rest, seen)
            fastened = held if self.fastened is None else self.fastened.joined(held)
            # 0.5: share of a rest's places below which the vehicle has left them behind
            begun = changed(begun, left=rest if share > 0.5 else None, fastened=fastened)
            if self.stands and drives:
                return begun
        pairs = places.found(sigma, seen)
        at, rows = pairs.tracks, pairs.features
        shift = z[rows] - places.z[at]
        stay = np.square(shift).sum(axis=1) <= _GATE * variance
        at, rows, shift = at[stay], rows[stay], shift[stay]
        if not (self.stands or _most_stay(places, seen, rows)):
            return begun
        witnesses = stereo[rows[places.sights[at] >= _FRAMES]]
        places_after = places.after(at, rows, z, seen)
        at_rest, variance = _at_rest(rig, places.z[at], shift, self.variance)
        if at_rest:
            frames = self.frames + 1
            # at the next rest it is found anew: if it was not fastened, but still, this would else not be seen again
            known = None if frames > _FRAMES else begun.fastened
            return changed(
                begun, places=places_after, frames=frames, witnesses=witnesses, variance=variance, fastened=known
            )
        hidden = min(self.frames, 10) if len(rows) <= _FEW else 1  # frames: then carried off, or moving
        if self.stands and self.blind < hidden:
            return changed(self, places=places_after, witnesses=witnesses, blind=self.blind + 1)
        return begun

    def _rest(self) -> Places | None:
        """The places that were there for most of a rest, which lasts or has just ended; None without one."""
        if self.stands and self.places is not None:
            return self.places.select(self.places.sights >= min(_SIGHTS, self.frames // 2 + 1))
        return self.left

    def contested(
        self, rig: StereoRig, sigma: float, features: StereoFeatures, matched: NDArray[np.intp], T_world_left: Array
    ) -> Standing:
        """At rest no more if a motion of the camera explains all: landmarks left their pixels by it, few witnesses do.

        `sigma` is the pixel noise [px], `matched` are rows of the features that agree on a pose `T_world_left` (4, 4).
        """
        motion = inverse(T_world_left) @ self.T_world_left
        left = np.setdiff1d(matched, self.witnesses)
        flow = _flow(rig, measurement_rows(features.uv_left, features.uv_right), motion)
        moves = np.square(flow).sum(axis=1) > _GATE * 2.0 * sigma**2
        moved, witnesses = moves[left].sum(), moves[self.witnesses].sum()
        # 0.1: share of landmarks that a motion must move, for it to be one
        explains = moved > 0.1 * len(matched) and 2 * witnesses < max(len(self.witnesses), 1)
        return self.moving() if explains else self

    def unseen(self) -> Standing:
        """After a frame whose features are left out, as its images are earlier ones."""
        return changed(self, frames=0, witnesses=self.witnesses[:0])

    def moving(self) -> Standing:
        """The same features, of a camera that does not stand."""
        return changed(self, frames=0)


def _most_stay(places: Places, seen: StereoFeatures, rows: NDArray[np.intp]) -> bool:
    """Whether most of what is found again stays, as `rows` (M,) of the features do.

    What is found nowhere says nothing: leaves and shadows are other features in each frame.
    """
    last = places.select(places.missed == 0)
    every = min(len(seen), len(last))
    if 2 * len(rows) > every or 3 * len(rows) <= every:  # 3: fewer may be fastened to the camera
        return 2 * len(rows) > every
    found = match_everywhere(last.descriptors, last.laplacian, seen, ALIKE[0], 1.0)  # 1: also what repeats itself
    return 2 * len(rows) > len(np.union1d(rows, found.features))


def _driven_past(
    rig: StereoRig, sigma: float, variance: float, rest: Places, seen: StereoFeatures
) -> tuple[bool, Places, float]:
    """Whether the vehicle drives, the places of a `rest` that stay though, and the share of all that is seen.

    It drives if some motion ahead explains most of what left, and of what it would have moved far more left than stays:
    that is fastened to the vehicle. What passes came later, or moves sideways. The `variance` is of a pixel [px²].
    """
    pairs = rest.found(sigma, seen, (1.0, 10.0))  # 10: windows
    before, now = rest.z[pairs.tracks], measurement_rows(seen.uv_left, seen.uv_right)[pairs.features]
    d = now - before
    stays = np.square(d).sum(axis=1) <= _GATE * variance
    points = rig.triangulate(before[:, :2], before[:, [2, 1]])
    left = ~stays & np.isfinite(points).all(axis=1)
    found = find_consensus(rig, points[left], now[left], np.eye(4), SIGMAS * sigma, _HYPOTHESES, seed=0)
    by_motion = _flow(rig, before, inverse(found.T_world_left))
    size = np.square(by_motion).sum(axis=1)
    against = stays & (size > _GATE * variance) & (size > 2.0 * (d * by_motion).sum(axis=1))
    aside, _, ahead = found.T_world_left[:3, 3]
    moved = found.inliers.sum()
    clear = moved > CLEAR_MAJORITY * (moved + against.sum())
    # 0.1: share of what is seen that a motion must move, for it to be one
    drives = clear and moved > 0.1 * len(pairs) and abs(aside) < ahead
    return bool(drives), rest.select(pairs.tracks[against & drives]), len(pairs) / max(len(rest), 1)


def _flow(rig: StereoRig, z: Array, motion: Array) -> Array:
    """How a motion (4, 4) of what they see moves features at `z` (N, 3) [px]; NaN for those without a point."""
    pixels, _ = rig.project_stereo(transform(motion, rig.triangulate(z[:, :2], z[:, [2, 1]])), jacobian=False)
    return np.asarray(pixels - z)


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
