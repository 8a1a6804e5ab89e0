"""Pictures of a world: textured rectangles drawn in perspective, supersampled.

First it is settled which rectangles may be seen, which samples each covers, and which one each sample shows. Then
each rectangle is painted where it is seen, in blocks of the view: its texture reaches a block by one homography, from
the version of the texture whose texels are as large as the samples there; averaging the samples of a pixel then gives
the pixel's area. Nothing is finer than the samples, so no aliasing is left for a detector to find. Where neighbouring
blocks show different versions, one passes gradually into the other: the same edge lies a little differently in the
texels of two versions, and a corner on a sharp seam between them would be drawn up to 0.1 px from its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.geometry import RectangleArrays

NEAR = 0.02  #: what is nearer than this is not drawn [m]
_REACH = 1e-4  # rectangles reach over their edges by this share, so that no sample falls between two that meet
_BLOCK = 160  # usual largest side of a block [samples]
_SMALLEST = 32  # no block is made smaller than this because the distance changes [samples]
_OVERLAP = 16  # width of the passage from one block to the next [samples]
_SOFTEN = 2**0.25  # texels are that much larger than samples: then the samples of a view miss nothing of them
_CHANGE = 2.0  # distance changes by about this factor within a block, and texels per sample by up to its square

#: Reductions are powers of the fourth root of two: neighbours are hardly less sharp than each other, so that a corner
#: on the seam between two of them stays in its place.
STEPS_PER_OCTAVE = 4


class Ripmap:
    """A texture (H, W[, 3]) uint8 and its reductions, each made when it is first asked for."""

    def __init__(self, picture: np.ndarray) -> None:
        self._size = picture.shape[1], picture.shape[0]
        self._levels: dict[tuple[int, ...], np.ndarray] = {(0, 0): picture}

    def level(self, span: Sequence[float]) -> np.ndarray:
        """The picture with texels about as wide and as high as `span` (2,), shares of the picture; none smaller."""
        reductions = (min(max(share * n, 1.0), float(n)) for share, n in zip(span, self._size))
        return self._level(tuple(round(STEPS_PER_OCTAVE * math.log2(r)) for r in reductions))

    def _level(self, steps: tuple[int, ...]) -> np.ndarray:
        """The picture reduced by so many steps along its rows and its columns, whatever was asked for before.

        It is made from one that is whole octaves, at least one and less than two, less reduced: an average of averages
        over as many texels as that is hardly less sharp than one over the full picture's.
        """
        found = self._levels.get(steps)
        if found is None:
            source = self._level(tuple(STEPS_PER_OCTAVE * max(0, k // STEPS_PER_OCTAVE - 1) for k in steps))
            size = [max(1, round(n * 2 ** (-k / STEPS_PER_OCTAVE))) for n, k in zip(self._size, steps)]
            found = self._levels[steps] = cv2.resize(source, size, interpolation=cv2.INTER_AREA)
        return found


def draw(
    rectangles: RectangleArrays, textures: Callable[[int], Ripmap], T_world_body: Array, T_world_camera: Array,
    view: View, background: Sequence[int],
) -> np.ndarray:  # fmt: skip
    """Samples of a view (H, W[, 3]) uint8 of rectangles in body frames, on a background of one grey value, or BGR.

    `T_world_body` has body poses (B + 1, 4, 4), row 0 the identity, and `T_world_camera` (4, 4) is the camera's.
    """
    picture = np.empty((view.height, view.width, len(background)), np.uint8)
    picture[:] = background
    picture = picture[..., 0] if len(background) == 1 else picture
    placed = place(rectangles, T_world_body, T_world_camera, view)
    labels = shown(placed, view)
    blocks = [block for i in range(len(placed)) for block in _blocks(placed, i, labels)]
    masks = [labels[b.outer[1] : b.outer[3], b.outer[0] : b.outer[2]] == b.which + 1 for b in blocks]
    seen = [number for number, mask in enumerate(masks) if mask.any()]
    which = np.array([blocks[b].which for b in seen], int)
    boxes, outer = (np.array([getattr(blocks[b], name) for b in seen], int).reshape(-1, 4) for name in ("box", "outer"))
    ripmaps = {i: textures(int(placed.source[i])) for i in np.unique(which).tolist()}
    spans = _spans(placed, which, boxes).tolist()
    versions = {b: ripmaps[i].level(span) for b, i, span in zip(seen, which.tolist(), spans)}
    M = _to_texels(placed.Q[which], outer, np.array([v.shape[:2] for v in versions.values()]).reshape(-1, 2))
    for (b, texels), H in zip(versions.items(), M):
        x0, y0, x1, y1 = blocks[b].outer
        drawn = cv2.warpPerspective(
            texels, H, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        there = picture[y0:y1, x0:x1]
        first = b - blocks[b].number
        left, above = (texels if n is None else versions.get(first + n, texels) for n in blocks[b].before)
        if left is not texels:  # a neighbour that is not seen leaves no seam
            _pass_over(there[:, :_OVERLAP], drawn[:, :_OVERLAP], axis=1)
        if above is not texels:
            _pass_over(there[:_OVERLAP], drawn[:_OVERLAP], axis=0)
        cv2.copyTo(drawn, masks[b].view(np.uint8), there)
    return picture


def _pass_over(old: np.ndarray, new: np.ndarray, axis: int) -> None:
    """Let an old strip pass gradually into a new one along an axis, written into the new one."""
    share = (np.arange(new.shape[axis], dtype=np.float32) + 0.5) / new.shape[axis]
    share = np.tile(share, (new.shape[0], 1)) if axis else np.repeat(share[:, None], new.shape[1], axis=1)
    new[:] = cv2.blendLinear(new, old, share, 1 - share)


class _Block(NamedTuple):
    """A block of the view, one of a grid that covers a rectangle where it is shown, row by row."""

    which: int  # the rectangle's row in `Placed`
    number: int  # in its grid
    before: tuple[int | None, int | None]  # numbers of the blocks to the left and above
    box: tuple[int, ...]  # x0, y0, x1, y1
    outer: tuple[int, ...]  # the same, wider by half the overlap, but not beyond the grid


def _blocks(placed: Placed, i: int, labels: np.ndarray) -> list[_Block]:
    (top, bottom), (left, right) = placed.rows[i].tolist(), placed.columns[i].tolist()
    if left >= right:
        return []
    x, y, w, h = cv2.boundingRect((labels[top:bottom, left:right] == i + 1).view(np.uint8))
    if not w:
        return []
    x, y, half, out = x + left, y + top, _OVERLAP // 2, []
    across, down = _cuts(placed, i, (x, y + h / 2), (w, 0)), _cuts(placed, i, (x + w / 2, y), (0, h))
    columns = len(across) - 1
    for r, (y0, y1) in enumerate(pairwise(down)):
        for c, (x0, x1) in enumerate(pairwise(across)):
            number = r * columns + c
            outer = max(x0 - half, 0), max(y0 - half, 0), min(x1 + half, w), min(y1 + half, h)
            before = number - 1 if c else None, number - columns if r else None
            corner = x, y, x, y
            box, wide = (tuple(a + b for a, b in zip(corner, side)) for side in ((x0, y0, x1, y1), outer))
            out.append(_Block(i, number, before, box, wide))
    return out


def _cuts(placed: Placed, i: int, start: tuple[float, float], side: tuple[float, float]) -> list[int]:
    """Where to cut a side of a rectangle's part of the view: from 0 to its length, in equal ratios of distance."""
    length = int(sum(side))
    at_start, slope = placed.Q[i, 2] @ (*start, 1), placed.Q[i, 2, :2] @ side
    far, near = placed.nearness[i]
    first, last = min(max(at_start, far), near), min(max(at_start + slope, far), near)
    ratio = last / first
    wanted = min(math.ceil(abs(math.log(ratio)) / math.log(_CHANGE)), length // _SMALLEST)
    count = max(wanted, -(-length // _BLOCK), 1)
    if abs(ratio - 1) < 1e-3:
        return [length * k // count for k in range(count + 1)]
    return [round(length * (ratio ** (k / count) - 1) / (ratio - 1)) for k in range(count + 1)]


def _spans(placed: Placed, which: np.ndarray, boxes: np.ndarray) -> Array:
    """The share of the texture, along and down it, that a texel of each block should be (N, 2)."""
    Q = placed.Q[which]
    x, y = boxes[:, [0, 2, 2, 0]] - [0, 1, 1, 0], boxes[:, [1, 1, 3, 3]] - [0, 0, 1, 1]
    p = np.stack([x, y, np.ones_like(x)], axis=2) @ np.swapaxes(Q, 1, 2)
    far, near = placed.nearness[which].T[..., None]
    n = np.clip(p[..., 2], far, near)  # corners of the block may lie outside of the rectangle
    st = np.clip(p[..., :2] / n[..., None], 0, 1)
    gradient = (Q[:, None, :2, :2] - st[..., None] * Q[:, None, 2:, :2]) / n[..., None, None]
    span = np.sqrt((gradient**2).sum(axis=3))
    return _SOFTEN * np.sqrt(span.min(axis=1) * span.max(axis=1))


def _to_texels(Q: Array, boxes: np.ndarray, shapes: np.ndarray) -> Array:
    """Homographies (N, 3, 3) from a block's own samples to texels of a picture with `shapes` (N, 2) rows, columns."""
    M = Q.copy()
    M[:, :, 2] += M[:, :, 0] * boxes[:, :1] + M[:, :, 1] * boxes[:, 1:2]
    M[:, 0] = M[:, 0] * shapes[:, 1:] - 0.5 * M[:, 2]
    M[:, 1] = M[:, 1] * shapes[:, :1] - 0.5 * M[:, 2]
    return M


class View(NamedTuple):
    """An undistorted view to draw: camera matrix (3, 3) in samples, and size in samples."""

    K: Array
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Placed:
    """Rectangles in a view, nearest first, a row each."""

    source: np.ndarray  # which rectangle of the world (P,)
    Q: Array  # takes a sample's (x, y, 1) to (s, t, 1) / depth; s, t are shares of its edges (P, 3, 3)
    nearness: Array  # 1 / depth of the farthest and of the nearest corner of the part before the camera (P, 2)
    rows: np.ndarray  # first that may be covered, and the one after the last (P, 2)
    columns: np.ndarray  # the same (P, 2)
    start: np.ndarray  # where the rows of a rectangle begin in `first` and `last` (P + 1,)
    first: np.ndarray  # first sample covered, a row of the view after the other (sum of rows,) int16
    last: np.ndarray  # last sample covered

    def __len__(self) -> int:
        return len(self.source)


def place(rectangles: RectangleArrays, T_world_body: Array, T_world_camera: Array, view: View) -> Placed:
    """The rectangles that may be seen in a view, of all in body frames; for the poses see `draw`."""
    R, c = T_world_camera[:3, :3], T_world_camera[:3, 3]
    world = rectangles.placed(T_world_body)
    source = _in_frustum(world, R, c, view)
    edges = np.stack([world.along[source], world.down[source], world.origin[source] - c], axis=2)
    H = view.K @ (R.T @ edges)  # take (s, t, 1) to depth · (x, y, 1)
    corners = _corners_before(H)
    outline = corners[..., :2] / corners[..., 2:]
    low = np.maximum(np.ceil(outline.min(axis=1) - 0.1), 0).astype(int)
    high = np.minimum(np.floor(outline.max(axis=1) + 0.1) + 1, (view.width, view.height)).astype(int)
    nearness = 1 / np.stack([corners[..., 2].max(axis=1), corners[..., 2].min(axis=1)], axis=1)
    order = np.argsort(-nearness[:, 1], kind="stable")
    order = order[(low < high).all(axis=1)[order]]
    Q = np.linalg.inv(H[order])
    rows = np.stack([low[order, 1], high[order, 1]], axis=1)
    start = np.concatenate([[0], np.cumsum(rows[:, 1] - rows[:, 0])])
    first, last = _covered(Q, rows, start, view.width)
    columns = np.zeros_like(rows)
    if len(order):
        columns[:, 0] = np.minimum.reduceat(first, start[:-1])
        columns[:, 1] = np.maximum(np.maximum.reduceat(last, start[:-1]) + 1, columns[:, 0])
    return Placed(source[order], Q, nearness[order], rows, columns, start, first, last)


def _in_frustum(world: RectangleArrays, R: Array, c: Array, view: View) -> np.ndarray:
    """Rectangles whose front faces a camera (pose R, c) and whose surrounding sphere reaches into the view."""
    offset = world.origin - c
    middle = (offset + (world.along + world.down) / 2) @ R
    fx, fy, cx, cy = view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
    walls = np.array([[fx, 0, cx], [-fx, 0, view.width - cx], [0, fy, cy], [0, -fy, view.height - cy]])
    walls /= np.linalg.norm(walls, axis=1, keepdims=True)  # inward normals of the planes that bound the view
    inside = ((offset * world.normal).sum(axis=1) < -1e-6) & (middle[:, 2] > NEAR - world.radius)
    inside &= (middle @ walls.T > -world.radius[:, None]).all(axis=1)
    return np.flatnonzero(inside)


_SQUARE = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def _corners_before(H: Array) -> Array:
    """Corners (M, 8, 3) as depth · (x, y, 1) of the parts of rectangles that lie before the camera; they may repeat.

    A rectangle of which nothing does gets points outside of every view.
    """
    corner = _SQUARE @ np.swapaxes(H, 1, 2)
    step = np.roll(corner, -1, axis=1) - corner
    before = corner[..., 2] >= NEAR
    crosses = before != np.roll(before, -1, axis=1)  # the edge from this corner to the next passes the nearest depth
    share = (NEAR - corner[..., 2]) / np.where(crosses, step[..., 2], 1.0)
    points = np.concatenate([corner, corner + share[..., None] * step], axis=1)
    valid = np.concatenate([before, crosses], axis=1)
    some = points[np.arange(len(H)), valid.argmax(axis=1)]
    some[~valid.any(axis=1)] = (-1e6, -1e6, NEAR)
    return np.where(valid[..., None], points, some[:, None])


def _covered(Q: Array, rows: np.ndarray, start: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last sample covered in each row of each rectangle (sum of rows,) int16; last < first where none."""
    s, t, n = Q[:, 0], Q[:, 1], Q[:, 2]
    edges = np.stack([s, n - s, t, n - t], axis=0) + _REACH * n
    a, b, c = np.moveaxis(edges, 2, 0)  # inside, a·x + b·y + c ≥ 0 for all four
    a = np.where(a == 0, 1e-300, a)
    begins = a > 0
    which = np.repeat(np.arange(len(Q)), np.diff(start))
    y = np.arange(start[-1]) - (start[:-1] - rows[:, 0])[which]
    first, last = np.zeros(len(y)), np.full(len(y), float(width))
    for bound, limit, chosen in ((first, np.maximum, begins), (last, np.minimum, ~begins)):
        slope = np.where(chosen, -b / a, 0.0)
        offset = np.where(chosen, -c / a, 0.0 if limit is np.maximum else float(width))
        for k in range(4):
            limit(bound, slope[k, which] * y + offset[k, which], out=bound)
    first, last = np.ceil(np.minimum(first, width)), np.floor(np.maximum(last, -1.0))
    return first.astype(np.int16), np.minimum(last, width - 1).astype(np.int16)


def shown(placed: Placed, view: View) -> np.ndarray:
    """Which rectangle each sample shows (H, W) uint8 or uint16: its row in `placed` plus 1, or 0 for none."""
    kind = np.uint8 if len(placed) < 256 else np.uint16
    result = np.zeros((view.height, view.width), kind)
    nearness = np.zeros((view.height, view.width), np.float32)
    x = np.arange(view.width, dtype=np.int16)
    in_column = (placed.Q[:, 2, 0, None] * np.arange(view.width)).astype(np.float32)
    in_row = (placed.Q[:, 2, 1, None] * np.arange(view.height) + placed.Q[:, 2, 2, None]).astype(np.float32)
    for i in range(len(placed)):  # nearest first, so that each overwrites only smaller numbers
        (y0, y1), (x0, x1) = placed.rows[i].tolist(), placed.columns[i].tolist()
        part = slice(placed.start[i], placed.start[i + 1])
        near = in_column[i, x0:x1] + in_row[i, y0:y1, None]
        there = nearness[y0:y1, x0:x1]
        seen = near > there
        seen &= x[x0:x1] >= placed.first[part, None]
        seen &= x[x0:x1] <= placed.last[part, None]
        if seen.any():
            cv2.copyTo(near, seen.view(np.uint8), there)
            numbers = result[y0:y1, x0:x1]
            np.maximum(numbers, seen.view(np.uint8) * kind(i + 1), out=numbers)
    return result
