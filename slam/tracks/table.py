"""The table of tracks: each point that is followed, or is in the map, has one row of it for as long as it lasts.

The landmarks of the map, the members of each body, and what is not decided yet are selections of the rows. A frame's
step changes the table in place: `Tracks.begun` makes a copy for it, which a step that fails leaves behind. Landmarks,
and what waits for a depth, are then as they were; what is followed is not copied, so it is forgotten.
"""
# ruff: noqa: RUF009  (what a column is called with is a description, and no value that rows would share)

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, IndexArray, StereoFeatures
from slam.geometry.arrays import Table
from slam.geometry.se3 import Array
from slam.naming import count

STILL = -1  #: in place of a body's id: the still world
_ROOM = 1000  # cost: rows that a table begins with

#: Columns of `Tracks` that say what waits for a depth; all but the first one mean nothing where nothing does.
_WAITING = ("waiting_since", "look", "first_pixel", "first_pose", "first_covariance", "direction")


@dataclass(frozen=True, eq=False)
class Patch:
    """The image around a point, seen from a pose."""

    image: NDArray[np.float32]  # (S, S) float32
    centre: Array  # coordinates of the point within it (2,)
    size: float  # of the feature [px]
    body: int  # id of the body that the point is part of, `STILL` of the world
    T_left: Array  # pose of the left camera (4, 4) in that body, or in the world


def _column(dtype: Any, *shape: int, fill: Any = 0) -> Any:
    """A column with an array of this shape in each row; where it is not given, it is filled."""
    return field(default=None, metadata={"blank": (dtype, shape, fill)})


@dataclass(frozen=True, eq=False)
class LandmarkTable(Table):
    """What the map keeps of points, a row each; in a selection of landmarks alone ids ascend.

    Positions are the back end's alone.
    """

    ids: IdArray  # landmark ids (N,)
    descriptors: NDArray[np.float32]  # (N, D)
    laplacian: NDArray[np.int8]  # signs of the Laplacian (N,)
    seen: IdArray = _column(np.int64)  # number of frames in which it was measured (N,)
    in_view: IdArray = _column(np.int64)  # number of frames in which it should have been detected or was (N,)
    missed: IdArray = _column(np.int64)  # number of such frames since it was last measured (N,)
    last_seen: IdArray = _column(np.int64)  # frame index (N,)
    seen_from: Array = _column(float, 3, fill=np.nan)  # camera at first sight (N, 3) [m], in the world; NaN: unknown
    out_of_view: IdArray = _column(np.int64)  # frames outside of the image since last measured (N,)
    # frames since it was last measured (N,), of those in which some landmark was measured and this one not withheld
    # as possibly moving
    unseen: IdArray = _column(np.int64)
    # of those long out of view: frames up to the last in which it was found, in succession, without counting (N,)
    returning: IdArray = _column(np.int64)
    patches: NDArray[np.object_] = _column(object, fill=None)  # `Patch` at first sight (N,), or None

    def __post_init__(self) -> None:
        for name, column in list(vars(self).items()):
            if column is None:
                dtype, shape, fill = self.__dataclass_fields__[name].metadata["blank"]
                object.__setattr__(self, name, np.full((len(self.ids), *shape), fill, dtype))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({count(int((self.ids >= 0).sum()), 'landmark')}, {self.descriptors.shape[1]}-D)"

    def rows(self, ids: IdArray) -> IndexArray:
        """Row numbers of ids that are in the map."""
        return np.searchsorted(self.ids, ids)

    def has_patch(self, rows: IndexArray, body: int = STILL) -> BoolArray:
        """Which of the rows (K,) have a patch as part of a body, or of the world."""
        return np.array([patch is not None and patch.body == body for patch in self.patches[rows]], bool)

    def long_out_of_view(self, after: int) -> BoolArray:
        """Which (N,) were outside of the image for `after` frames, or are of an earlier run."""
        return np.asarray((self.last_seen < 0) | (self.out_of_view >= after))

    def count_returning(self, ids: IdArray) -> None:
        """Count a frame in which some landmarks (M,) long out of view were found without counting, in place."""
        rows = self.rows(ids)
        successive = self.returning[rows] + 1
        self.returning[:] = 0
        self.returning[rows] = successive

    def renew(
        self, rows: IndexArray, features: StereoFeatures, feature_rows: IndexArray, weight: float, camera: Array,
        rematch_after: int,
    ) -> None:  # fmt: skip
        """Landmarks (K,) were measured by features, from a `camera` at (3,) [m]: change how they look, in place.

        `weight` is that of the new descriptors in the landmarks' own: 1 keeps the newest, 0 the first. Landmarks seen
        again after `rematch_after` frames outside the image count as first seen now, from there.
        """
        look = (1 - weight) * self.descriptors[rows] + weight * features.descriptors[feature_rows]
        self.descriptors[rows] = look / np.maximum(np.linalg.norm(look, axis=1, keepdims=True), 1e-6)
        again = self.long_out_of_view(rematch_after)[rows]
        self.seen_from[rows[again]] = camera
        self.descriptors[rows[again]] = features.descriptors[feature_rows[again]]


@dataclass(frozen=True, eq=False)
class Tracks(LandmarkTable):
    """All rows: `ids` are −1 where a row is no landmark, `number` where it is not followed as part of a body or a
    candidate, `waiting_since` where it does not wait for a depth; a row with all three is unused.

    Every measurement of what is followed is kept as a point in world coordinates with its information: the point ``p``
    that the pixels say, relative to the track's own anchor, and ``A = Jᵀ J / σ²``; `slam.bodies.fits` fits them.
    """

    number: IdArray = _column(np.int64, fill=-1)  # of the track (N,), never used twice; −1 for what is not followed
    row: IndexArray = _column(np.intp, fill=-1)  # row of the feature in this frame (N,), −1 where not found
    look: NDArray[np.float32] = _column(np.float32, 0)  # descriptor as last found (N, D)
    body: IdArray = _column(np.int64, fill=-1)  # id of the body that it belongs to (N,), −1 for none
    unfound: IdArray = _column(np.int64)  # frames since a feature was last found that looks like it (N,)
    anchor: Array = _column(float, 3)  # origin of the track's own coordinates, in world axes (N, 3)
    A: Array = _column(float, 0, 3, 3)  # information (N, W, 3, 3), zero without measurement; slot ``frame % W``
    p: Array = _column(float, 0, 3)  # the point that the pixels say (N, W, 3), relative to the anchor
    dof: NDArray[np.int8] = _column(np.int8, 0)  # numbers measured (N, W): 3, 2 or 0
    position: Array = _column(float, 3)  # where it is now, in world coordinates (N, 3)
    covariance: Array = _column(float, 3, 3)  # of the position (N, 3, 3)
    velocity: Array = _column(float, 3)  # (N, 3) [m/s], zero for those that a fixed point explains
    velocity_covariance: Array = _column(float, 3, 3)  # (N, 3, 3), of those that have one
    # number of frames in which it was part of a moving group, less those since in which it was not (N,)
    streak: IdArray = _column(np.int64)
    doubtful: BoolArray = _column(bool)  # not still for certain (N,)
    local: Array = _column(float, 3)  # point in the body's coordinates (N, 3)
    local_information: Array = _column(float, 3, 3)  # its information (N, 3, 3)
    misfit: IdArray = _column(np.int64)  # how often lately it disagreed with its body (N,)
    sure: BoolArray = _column(bool)  # whether its motion with the body is certain (N,)
    # whether it was removed from a body (N,): then it needs proof of its motion to become a member again
    expelled: BoolArray = _column(bool)
    # whether its feature stays at its pixel while the camera stands (N,): it belongs to no body
    still: BoolArray = _column(bool)
    # frames for which, as a landmark, it is in doubt since it parted from the rest (N,), see `slam.bodies.finder`
    parted: IdArray = _column(np.int64)
    # frame in which a feature without depth was first seen, as long as it waits for a second view (N,); −1 for others
    waiting_since: IdArray = _column(np.int64, fill=-1)
    first_pixel: Array = _column(float, 2)  # left pixel of such a feature at first sight (N, 2)
    first_pose: Array = _column(float, 4, 4)  # T_world_left then (N, 4, 4)
    first_covariance: Array = _column(float, 6, 6)  # of that pose by its own frame (N, 6, 6)
    direction: Array = _column(float, 3)  # in which it was last seen (N, 3), in world axes

    @classmethod
    def empty(cls, dimensions: int, window: int = 0, rows: int = _ROOM) -> Tracks:
        """A table of unused rows, for descriptors of `dimensions` numbers and windows of so many frames."""
        looks, signs = np.zeros((2, rows, dimensions), np.float32), np.zeros(rows, np.int8)
        A, p, dof = np.zeros((rows, window, 3, 3)), np.zeros((rows, window, 3)), np.zeros((rows, window), np.int8)
        return cls(np.full(rows, -1), looks[0], signs, look=looks[1], A=A, p=p, dof=dof)

    def begun(self, new: int, window: int) -> Tracks:
        """A copy for another frame: in it there is room for so many `new` rows, and nothing is found yet.

        The columns of landmarks and of what waits for a depth are copied; those of what is followed are shared with the
        copy, unless it has windows of another number of frames.
        """
        waiting = _WAITING if (self.waiting_since >= 0).any() else _WAITING[:1]
        kept = {name: getattr(self, name).copy() for name in (*LandmarkTable.__dataclass_fields__, *waiting)}
        same = self.dof.shape[1] == window
        tracks = copy(self) if same else Tracks.empty(self.descriptors.shape[1], window, len(self))
        vars(tracks).update(kept)
        missing = new - int((~self.used).sum())
        if missing > 0:
            tracks = tracks.joined(Tracks.empty(self.descriptors.shape[1], window, max(len(self), missing)))
        tracks.row[:] = -1
        return tracks

    def with_landmarks(self, landmarks: LandmarkTable) -> Tracks:
        """A copy with more landmarks, which are not in it yet."""
        tracks = self.begun(len(landmarks), self.dof.shape[1])
        rows = np.flatnonzero(~tracks.used)[: len(landmarks)]
        for name in LandmarkTable.__dataclass_fields__:
            getattr(tracks, name)[rows] = getattr(landmarks, name)
        vars(tracks).pop("mapped", None)
        return tracks

    @property
    def used(self) -> BoolArray:
        """Which rows are in use (N,)."""
        return (self.ids >= 0) | (self.number >= 0) | (self.waiting_since >= 0)

    @property
    def found(self) -> BoolArray:
        """Which are followed, and were found in this frame (N,)."""
        return (self.row >= 0) & (self.number >= 0)

    @cached_property
    def mapped(self) -> IndexArray:
        """Rows of the landmarks (M,), by ascending id; found again after landmarks have joined or left."""
        rows = np.flatnonzero(self.ids >= 0)
        return np.asarray(rows[np.argsort(self.ids[rows], kind="stable")])

    def landmarks(self) -> LandmarkTable:
        """The rows `mapped`, as they are now."""
        rows = self.mapped
        return LandmarkTable(*(getattr(self, name)[rows] for name in LandmarkTable.__dataclass_fields__))

    def rows(self, ids: IdArray) -> IndexArray:
        """Row numbers of landmarks (K,), by their ids."""
        mapped = self.mapped
        return mapped[np.searchsorted(self.ids[mapped], ids)]

    def count(self, rows: IndexArray) -> IdArray:
        """Number of measurements of tracks in the window (M,)."""
        measured = (self.dof.take(rows, axis=0) != 0).astype(np.float32)
        return (measured @ np.ones(measured.shape[1], np.float32)).astype(np.int64)  # a sum takes thrice as long

    def set_features(self, rows: IndexArray, features: IndexArray) -> None:
        """Rows (K,) are found as these features, in place; of rows alike to the bit, the first has the feature."""
        features, first = np.unique(features, return_index=True)
        self.row[rows[first]] = features

    def enter_landmarks(
        self, frame: int, ids: IdArray, features: StereoFeatures, rows: IndexArray, camera: Array
    ) -> None:
        """Features `rows` (K,) become landmarks, seen from `camera` (3,), in place.

        The tracks that they continue are theirs; where there is none, or it is another landmark's, a row begins.
        """
        of_feature, own = np.full(len(features), -1), np.flatnonzero((self.row >= 0) & (self.ids < 0))
        of_feature[self.row[own]] = own
        at = of_feature[rows]
        at[at < 0] = np.flatnonzero(~self.used)[: int((at < 0).sum())]
        new = LandmarkTable(ids, features.descriptors[rows], features.laplacian[rows])
        new.seen[:], new.in_view[:], new.last_seen[:], new.seen_from[:] = 1, 1, frame, camera
        self.row[at], self.waiting_since[at] = rows, -1
        for name in LandmarkTable.__dataclass_fields__:
            getattr(self, name)[at] = getattr(new, name)
        vars(self).pop("mapped", None)

    def wait(
        self, frame: int, features: StereoFeatures, rows: IndexArray, directions: Array, T_world_left: Array,
        covariance: Array,
    ) -> None:  # fmt: skip
        """Features `rows` (K,) without depth begin to wait for a second view, in place.

        They are seen in `directions` (K, 3) in world axes, from a pose (4, 4) whose covariance by its own frame is
        (6, 6).
        """
        at = np.flatnonzero(~self.used)[: len(rows)]
        self.row[at], self.waiting_since[at] = rows, frame
        self.look[at], self.laplacian[at] = features.descriptors[rows], features.laplacian[rows]
        self.first_pixel[at], self.direction[at] = features.uv_left[rows], directions
        self.first_pose[at], self.first_covariance[at] = T_world_left, covariance

    def erase_landmarks(self, rows: IndexArray) -> None:
        """Landmarks (K,) leave the map, in place; their tracks go on."""
        self.ids[rows], self.parted[rows] = -1, 0
        vars(self).pop("mapped", None)

    def begin(self, rows: IndexArray, numbers: IdArray, features: StereoFeatures, points: Array) -> None:
        """Begin to follow rows (K,) that have a feature each, at `points` (K, 3) in world coordinates, in place."""
        self.number[rows], self.unfound[rows], self.expelled[rows], self.parted[rows] = numbers, 0, False, 0
        self.anchor[rows] = self.position[rows] = points
        self.forget_past(rows)
        self.look[rows], self.laplacian[rows] = (x[self.row[rows]] for x in (features.descriptors, features.laplacian))

    def give_up(self, rows: IndexArray) -> None:
        """Follow rows no longer, in place; landmarks among them stay in the map."""
        self.number[rows] = self.row[rows] = self.body[rows] = -1
        self.dof[rows] = 0

    def forget_past(self, rows: IndexArray) -> None:
        """Make tracks free and without measurements, in place."""
        self.body[rows], self.misfit[rows], self.streak[rows], self.doubtful[rows] = -1, 0, 0, False
        self.patches[rows[self.ids[rows] < 0]] = None  # a body's coordinates may have changed once it is found again
        for array in (self.A, self.p, self.dof, self.velocity):
            array[rows] = 0
