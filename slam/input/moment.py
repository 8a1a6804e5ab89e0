"""Whether left and right images are of one moment, by rows of their features that follow the motion."""

from __future__ import annotations

import numpy as np

from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform

_LAG, _SIGMAS = 0.1, 5.0  # guard: lag of the right images [frames] that counts, and in standard deviations
_LEAST, _MOST = 15, 64  # guard: blocks of frames of which a lag is taken; cost: that are kept apart
#: guard: Lag in the last frames alone, of so many, as where an image is missing: a whole frame, of which rows that are
#: matched show .24 to .37. Over the recordings at hand it is .05 at most.
_SUDDEN, _RECENT = 0.2, 8
_STILL = 0.1  # guard: flow [px], root mean square, of a camera that hardly moves: rows are the same in all its frames
_FLOW = 4.0  # guard: flow [px] beyond which rows would differ by more than they are matched with


#: What to do about images of two moments.
ONE_MOMENT = "pair them by their times or numbers, and let one camera trigger the other"


class MomentWatch:
    """The lag of the right images, in frames, from the features and poses of successive frames.

    It is the regression of vertical disparities on the flow along columns from the frame before; how early they are,
    on that from the frame after. What errors of the calibration explain, which are the same in all frames, is taken
    out of both first: a camera that drives straight on moves rows in one way, too. It is taken of all frames, and of
    the last ones as they come. Sums are kept of blocks of frames, which are merged two by two when there are too many.
    `rig` is the rectified pair.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        # pose of the last frame, if that was measured, and its `_points`
        self._before: tuple[Array, tuple[Array, Array, Array]] | None = None
        self._blocks: list[Array] = []  # sums of products (2, 7, 7) [px²], late and early, see `_products`
        self._length, self._in_last = 1, 1  # frames of a block, and of the last one
        self._whole = np.zeros((2, 7, 7))  # sum of all blocks
        self._recent: list[Array] = []  # sums of products of the last frames
        self._sudden = np.zeros(2)  # largest lag of successive frames (2,), late and early

    def add(self, features: StereoFeatures, T_world_left: Array, measured: bool) -> None:
        """Take in a frame: features in rectified pixels, not corrected, and the pose (4, 4), if it was `measured`."""
        if not measured:
            self._before = None
            return
        before, self._before = self._before, (T_world_left, self._points(features))
        if before is None:
            return
        step = inverse(before[0]) @ T_world_left
        sums = np.stack([self._products(*self._before[1], step), self._products(*before[1], inverse(step))])
        if (sums[:, 1, 1] <= _STILL**2 * sums[:, 2, 2]).any():  # also without features
            return
        self._whole += sums
        self._recent.append(sums)
        if len(self._recent) == _RECENT:
            self._sudden = np.maximum(self._sudden, _lags(np.array(self._recent), self._whole, _SUDDEN))
            del self._recent[:2]  # cost: every second frame
        if self._blocks and self._in_last < self._length:
            self._blocks[-1] = self._blocks[-1] + sums
            self._in_last += 1
            return
        if len(self._blocks) == _MOST:
            self._blocks = [a + b for a, b in zip(self._blocks[::2], self._blocks[1::2])]
            self._length *= 2
        self._blocks.append(sums)
        self._in_last = 1

    @property
    def doubt(self) -> str:
        """What to say where rows differ as they do between images of two moments; empty where they do not."""
        lags = self._sudden
        if len(self._blocks) >= _LEAST:
            lags = np.maximum(lags, _lags(np.array(self._blocks), self._whole, _LAG))
        word = ("late", "early")[int(np.argmax(lags))] if lags.any() else ""
        return word and (
            "left and right image are not of one moment: rows of their features differ with the motion, as if right "
            f"images were {word} by a part of a frame or more; {ONE_MOMENT}"
        )

    def _points(self, features: StereoFeatures) -> tuple[Array, Array, Array]:
        """Features with a right pixel: points in the camera's axes (N, 3) [m], rows (N,), and columns (N, 7).

        The columns are the vertical disparity, one for the flow, and `_fields`.
        """
        rows = np.flatnonzero(features.has_stereo)
        left, right = features.uv_left[rows], features.uv_right[rows]
        columns, level = np.empty((len(rows), 7)), right.copy()
        level[:, 1] = left[:, 1]
        with np.errstate(all="ignore"):
            points = self._rig.triangulate(left, level)
            columns[:, 0], columns[:, 2:] = right[:, 1] - left[:, 1], np.stack(_fields(points), axis=1)
        return points, left[:, 1], columns

    def _products(self, points: Array, rows: Array, columns: Array, T_other_now: Array) -> Array:
        """Sums of products (7, 7) [px²] over features: of vertical disparities, of the flow, and of `_fields`.

        The flow is how many rows a still point moves in the left image from another frame to this one; `T_other_now`
        (4, 4) takes this frame's camera coordinates to the other's. A right image from between them is off by a share
        of it.
        """
        columns = columns.copy()
        with np.errstate(all="ignore"):
            columns[:, 1] = rows - self._rig.left.project(transform(T_other_now, points))[:, 1]
        columns = columns[np.isfinite(columns).all(axis=1) & (np.abs(columns[:, 1]) < _FLOW)]
        return np.asarray(columns.T @ columns)


def _lags(sums: Array, whole: Array, least: float) -> Array:
    """Lags (2,) [frames], late and early, by sums (N, 2, 7, 7), 0 for none that is certain and more than the `least`.

    Of the `whole` (2, 7, 7) run's sums is what errors of the calibration explain.
    """
    fields = whole[:, 2:, 2:] + 1e-9 * whole[:, 2, 2, None, None] * np.eye(5)  # numerics: invertible
    less = np.concatenate([np.stack([np.eye(2)] * 2), -np.linalg.solve(fields, whole[:, 2:, :2])], axis=1)
    products, squares = np.moveaxis((np.swapaxes(less, 1, 2) @ sums @ less)[..., 1], 2, 0)  # (N, 2) each
    total = np.maximum(squares.sum(axis=0), np.finfo(float).tiny)
    lag = -products.sum(axis=0) / total
    sigma = np.sqrt(np.square(products + lag * squares).sum(axis=0)) / total
    moves = total > _STILL**2 * sums[:, :, 2, 2].sum(axis=0)  # also besides what the calibration explains
    return np.where(moves & (lag > np.maximum(least, _SIGMAS * sigma)), lag, 0.0)


def _fields(points: Array) -> tuple[Array, ...]:
    """How vertical disparities (N,) of points in the camera's axes may be off by the calibration, up to factors.

    A right camera that is turned by a small angle, of another focal length or principal point, or higher or lower.
    """
    x, y, z = points.T
    x, y, one = x / z, y / z, np.ones(len(points))
    return one, x, y, x * y, one / z
