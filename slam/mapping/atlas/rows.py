"""Keyframe data for the path and the pose graph: one row per keyframe, in growing arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam.geometry.se3 import Array
from slam.mapping.atlas.keyframes import Keyframe

_LEAST = 64  # cost: rows allocated at first


@dataclass(frozen=True, eq=False)
class KeyframeRows:
    """Data of keyframes as arrays, see `slam.mapping.atlas.keyframes.Keyframe`; rows beyond `count` are unused.

    Attributes:
        count: number of keyframes.
        room: stamps (N,), poses (N, 4, 4), step covariances (N, 6, 6), Jacobians (N, 6, m) and distances
            travelled (N,).
    """

    count: int = 0
    room: tuple[Array, Array, Array, Array, Array] = field(
        default_factory=lambda: (
            np.zeros(0),
            np.zeros((0, 4, 4)),
            np.zeros((0, 6, 6)),
            np.zeros((0, 6, 0)),
            np.zeros(0),
        )
    )

    @property
    def stamps(self) -> Array:
        """(K,) [s]."""
        return self.room[0][: self.count]

    @property
    def poses(self) -> Array:
        """T_odom_left (K, 4, 4)."""
        return self.room[1][: self.count]

    @property
    def steps(self) -> Array:
        """Covariances (K, 6, 6) of the motions since the keyframe before."""
        return self.room[2][: self.count]

    @property
    def jacobian(self) -> Array:
        """Derivatives (K, 6, m) of the poses by the rig's errors; zero for keyframes of a run with other ones."""
        return self.room[3][: self.count]

    @property
    def travelled(self) -> Array:
        """(K,) [m]."""
        return self.room[4][: self.count]

    def with_new(self, keyframe: Keyframe) -> KeyframeRows:
        """A copy with one more keyframe.

        It shares its arrays with `self`, whose own rows stay unchanged. If two copies continue the same object, only
        the later one is valid.
        """
        k, room = self.count, self.room
        new = tuple(
            np.asarray(value, np.float64)
            for value in (
                keyframe.stamp, keyframe.T_odom_left, keyframe.step_covariance, keyframe.jacobian, keyframe.travelled,
            )
        )  # fmt: skip
        if k >= len(room[0]) or room[3].shape[1:] != keyframe.jacobian.shape:
            room = tuple(_with_room(rows, k, value.shape) for rows, value in zip(room, new))  # type: ignore[assignment]
        for rows, value in zip(room, new):
            rows[k] = value
        return KeyframeRows(k + 1, room)

    def inflated(self, first: int, last: int, factor: float) -> KeyframeRows:
        """A copy in which the motions after keyframe `first` up to `last` have covariances larger by a factor."""
        steps = self.room[2].copy()
        steps[first + 1 : last + 1] *= factor
        return KeyframeRows(self.count, (*self.room[:2], steps, *self.room[3:]))


def _with_room(rows: Array, count: int, shape: tuple[int, ...]) -> Array:
    """The first `count` rows in an array of twice the size; zero if the rows had another shape."""
    out = np.zeros((max(_LEAST, 2 * count), *shape))
    if rows.shape[1:] == shape:
        out[:count] = rows[:count]
    return out
