"""The map's bookkeeping: landmarks' descriptors and how often they are seen. Positions are the back end's alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.geometry.arrays import Table, among, ascending, isin
from slam.geometry.se3 import Array, transform
from slam.naming import count


@dataclass(frozen=True, eq=False)
class Patch:
    """The image around a landmark, seen from a pose."""

    image: NDArray[np.float32]  # (S, S) float32
    centre: Array  # coordinates of the landmark within it (2,)
    size: float  # of the feature [px]
    T_world_left: Array  # pose of the left camera (4, 4)


@dataclass(frozen=True, eq=False)
class LandmarkTable(Table):
    """Landmarks in the map, a row each, ids ascending."""

    ids: IdArray  # landmark ids (N,)
    descriptors: NDArray[np.float32]  # (N, D)
    laplacian: NDArray[np.int8]  # signs of the Laplacian (N,)
    seen: IdArray  # number of frames in which it was measured (N,)
    in_view: IdArray  # number of frames in which it should have been detected or was (N,)
    missed: IdArray  # number of such frames since it was last measured (N,)
    last_seen: IdArray  # frame index (N,)
    seen_from: Array = None  # type: ignore[assignment]  # camera at first sight (N, 3) [m], in the world; NaN: unknown
    out_of_view: IdArray = None  # type: ignore[assignment]  # frames outside of the image since last measured (N,)
    # frames since it was last measured (N,), of those in which some landmark was measured and this one not withheld
    # as possibly moving
    unseen: IdArray = None  # type: ignore[assignment]
    # of those long out of view: frames up to the last in which it was found, in succession, without counting (N,)
    returning: IdArray = None  # type: ignore[assignment]
    patches: NDArray[np.object_] = None  # type: ignore[assignment]  # `Patch` at first sight (N,), or None

    def __post_init__(self) -> None:
        n = len(self.ids)
        empty = {"seen_from": np.full((n, 3), np.nan), "patches": np.full(n, None)}
        for name in ("seen_from", "out_of_view", "unseen", "returning", "patches"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, empty.get(name, np.zeros(n, np.int64)))

    def __repr__(self) -> str:
        return f"LandmarkTable({count(len(self), 'landmark')}, {self.descriptors.shape[1]}-D)"

    @classmethod
    def empty(cls, dimensions: int) -> LandmarkTable:
        """No landmarks, for descriptors of `dimensions` numbers."""
        none = np.zeros(0, np.int64)
        return cls(none, np.zeros((0, dimensions), np.float32), np.zeros(0, np.int8), none, none, none, none)

    def rows(self, ids: IdArray) -> NDArray[np.intp]:
        """Row numbers of ids that are in the map."""
        return np.searchsorted(self.ids, ids)

    def after_frame(
        self,
        frame: int,
        in_view: IdArray,
        measured: IdArray,
        features: StereoFeatures,
        feature_rows: NDArray[np.intp],
        descriptor_update: float = 1.0,
        camera: Array | None = None,
        in_image: BoolArray | None = None,
        rematch_after: int = 0,
        withheld: IdArray | None = None,
    ) -> LandmarkTable:
        """The rows after a frame, given which ids were in view, which were measured, and by which features.

        `descriptor_update` is the weight of the new descriptors in the landmarks' own: 1 keeps the newest, 0 the first.
        `in_image` says which landmarks (N,) lie inside the image. If the camera's position (3,) [m] is given, landmarks
        seen again after `rematch_after` frames outside the image count as first seen now, from there. For landmarks
        `withheld` from the update, the frame counts as neither missed nor seen.
        """
        back = np.zeros(len(self), bool) if withheld is None else isin(self.ids, withheld)
        view, hit = self.rows(in_view), self.rows(measured)
        view = view[~back[view]]
        seen, missed, last_seen = self.seen.copy(), self.missed.copy(), self.last_seen.copy()
        views = self.in_view + (among(len(self), view) | among(len(self), hit))
        missed[view] += 1
        seen[hit] += 1
        missed[hit] = 0
        last_seen[hit] = frame
        descriptors = self.descriptors.copy()
        look = (1 - descriptor_update) * descriptors[hit] + descriptor_update * features.descriptors[feature_rows]
        descriptors[hit] = look / np.maximum(np.linalg.norm(look, axis=1, keepdims=True), 1e-6)
        seen_from = self.seen_from.copy()
        if camera is not None:
            again = self.long_out_of_view(rematch_after)[hit]
            seen_from[hit[again]] = camera
            descriptors[hit[again]] = features.descriptors[feature_rows[again]]
        out_of_view = self.out_of_view + (0 if in_image is None else ~in_image)
        unseen = self.unseen + (~back if len(hit) else 0)
        out_of_view[hit] = unseen[hit] = 0
        return replace(
            self, descriptors=descriptors, seen=seen, in_view=views, missed=missed, last_seen=last_seen,
            seen_from=seen_from, out_of_view=out_of_view, unseen=unseen,
        )  # fmt: skip

    @property
    def has_patch(self) -> BoolArray:
        """Which landmarks have a patch (N,)."""
        return np.array([patch is not None for patch in self.patches], bool)

    def with_patches(self, rows: NDArray[np.intp], patches: Sequence[Patch] | None) -> LandmarkTable:
        """A copy in which the landmarks at some rows (M,) have other patches; None for none."""
        if not len(rows):
            return self
        column = self.patches.copy()
        column[rows] = patches
        return replace(self, patches=column)

    def long_out_of_view(self, after: int) -> BoolArray:
        """Which landmarks (N,) were outside of the image for `after` frames, or are of an earlier run."""
        return np.asarray((self.last_seen < 0) | (self.out_of_view >= after))

    def with_returning(self, ids: IdArray) -> LandmarkTable:
        """After a frame in which some landmarks (M,) long out of view were found without counting."""
        if not (len(ids) or self.returning.any()):
            return self
        return replace(self, returning=np.where(isin(self.ids, ids), self.returning + 1, 0))

    def with_new(
        self, frame: int, ids: IdArray, features: StereoFeatures, rows: NDArray[np.intp], camera: Array | None = None
    ) -> LandmarkTable:
        """The rows with new landmarks, by their ids (M,) and rows of features, seen from `camera` (3,)."""
        once = np.ones(len(ids), np.int64)
        seen_from = np.full((len(ids), 3), np.nan) if camera is None else np.tile(camera, (len(ids), 1))
        looks = features.descriptors[rows], features.laplacian[rows]
        return self.joined(LandmarkTable(ids, *looks, once, once, 0 * once, frame * once, seen_from))

    def joined(self, other: Self) -> Self:
        """These and others, ids ascending; none may be in both."""
        whole = super().joined(other)
        return whole if ascending(whole.ids) else whole.select(np.argsort(whole.ids, kind="stable"))

    def in_world(self, T: Array) -> LandmarkTable:
        """The same in another world frame; `T` (4, 4) transforms coordinates to it."""
        return replace(self, seen_from=transform(T, self.seen_from))
