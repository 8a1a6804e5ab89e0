"""Pictures of a world: textured rectangles drawn in perspective, supersampled.

First it is settled which rectangle each sample shows. Then each rectangle is painted where it is seen, in blocks of
the view: its texture reaches a block by one homography, from the version of the texture whose texels are as large as
the samples there; averaging the samples of a pixel then gives the pixel's area. Nothing is finer than the samples, so
no aliasing is left for a detector to find. Where neighbouring blocks show different versions, one passes gradually into
the other: the same edge lies a little differently in the texels of two versions, and a corner on a sharp seam between
them would be drawn up to 0.1 px from its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.geometry import RectangleArrays
from slam.worlds.placing import Placed, View, place, shown

_BLOCK = 160  # usual largest side of a block [samples]
_SMALLEST = 32  # no block is made smaller than this because the distance changes [samples]
_OVERLAP = 16  # width of the passage from one block to the next [samples]
_SOFTEN = 2**0.25  # texels are that much larger than samples: then the samples of a view miss nothing of them
_CHANGE = 2.0  # distance changes by about this factor within a block, and texels per sample by up to its square


#: Reductions are powers of the fourth root of two: neighbours are hardly less sharp than each other, so that a corner
#: on the seam between two of them stays in its place.
STEPS_PER_OCTAVE = 4


class Ripmap:
    """A texture and its reductions, each made when it is first asked for, from one about half as reduced.

    Attributes:
        picture: the full picture (H, W[, 3]) uint8.
    """

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture
        self._levels: dict[tuple[int, int], np.ndarray] = {(0, 0): picture}

    def level(self, span: Sequence[float]) -> np.ndarray:
        """The picture with texels about as wide and as high as `span` (2,), shares of the picture; none smaller."""
        size = self.picture.shape[1], self.picture.shape[0]
        return self._level(_step(span[0], size[0]), _step(span[1], size[1]))

    def _level(self, across: int, down: int) -> np.ndarray:
        """The picture reduced by so many steps along its rows and its columns.

        What it is made from depends on these alone, so that it is the same whatever was asked for before.
        """
        found = self._levels.get((across, down))
        if found is None:
            source = self._level(_source(across), _source(down))
            height, width = self.picture.shape[:2]
            size = [max(1, round(n * 2 ** (-k / STEPS_PER_OCTAVE))) for n, k in ((width, across), (height, down))]
            found = cv2.resize(source, size, interpolation=cv2.INTER_AREA)
            self._levels[across, down] = found
        return found


def _step(span: float, length: int) -> int:
    """The step whose texels are nearest to a share `span` of `length` texels; at least one is left."""
    reduction = min(max(span * length, 1.0), float(length))
    return round(STEPS_PER_OCTAVE * math.log2(reduction))


def _source(step: int) -> int:
    """The step from which another is made: whole octaves, at least one and less than two before it.

    An average of averages over as many texels as that is hardly less sharp than one over the full picture's.
    """
    return STEPS_PER_OCTAVE * max(0, step // STEPS_PER_OCTAVE - 1)


def draw(
    rectangles: RectangleArrays, textures: Callable[[int], Ripmap], T_world_body: Array, T_world_camera: Array,
    view: View, background: Sequence[int], channels: int,
) -> np.ndarray:  # fmt: skip
    """Samples of a view (H, W[, 3]) uint8.

    Args:
        rectangles: what to draw, in body frames.
        textures: the texture of a rectangle, by its index.
        T_world_body: body poses (B + 1, 4, 4), row 0 the identity.
        T_world_camera: the camera's pose (4, 4).
        view: the camera.
        background: BGR where nothing is.
        channels: 1 or 3.
    """
    shape = (view.height, view.width) if channels == 1 else (view.height, view.width, 3)
    colour = np.array(background if channels == 3 else round(float(np.mean(background))), np.uint8)
    picture = np.empty(shape, np.uint8)
    picture[:] = colour
    placed = place(rectangles, T_world_body, T_world_camera, view)
    _paint(placed, shown(placed, view), textures, picture)
    return picture


def _paint(placed: Placed, labels: np.ndarray, textures: Callable[[int], Ripmap], picture: np.ndarray) -> None:
    """Paint every rectangle where it is shown, in place."""
    blocks = _blocks(placed, labels)
    outer = blocks.outer()
    masks = [labels[y0:y1, x0:x1] == i + 1 for i, (x0, y0, x1, y1) in zip(blocks.which.tolist(), outer.tolist())]
    seen = np.flatnonzero([mask.any() for mask in masks])
    which = blocks.which[seen]
    low, high = _spans(placed, which, blocks.boxes[seen])
    ripmaps = {i: textures(int(placed.source[i])) for i in np.unique(which).tolist()}
    span = (_SOFTEN * np.sqrt(low * high)).tolist()
    versions = {b: ripmaps[i].level(s) for b, i, s in zip(seen.tolist(), which.tolist(), span)}
    M = _to_texels(placed.Q[which], outer[seen], np.array([v.shape[:2] for v in versions.values()]).reshape(-1, 2))
    before = blocks.before.tolist()
    for (b, texels), (x0, y0, x1, y1), H in zip(versions.items(), outer[seen].tolist(), M):
        drawn = cv2.warpPerspective(
            texels, H, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        there = picture[y0:y1, x0:x1]
        left, above = (versions.get(n, texels) for n in before[b])  # a neighbour that is not seen leaves no seam
        if left is not texels:
            _pass_over(there[:, :_OVERLAP], drawn[:, :_OVERLAP], axis=1)
        if above is not texels:
            _pass_over(there[:_OVERLAP], drawn[:_OVERLAP], axis=0)
        cv2.copyTo(drawn, masks[b].view(np.uint8), there)


def _pass_over(old: np.ndarray, new: np.ndarray, axis: int) -> None:
    """Let an old strip pass gradually into a new one along an axis, written into the new one."""
    share = (np.arange(new.shape[axis], dtype=np.float32) + 0.5) / new.shape[axis]
    share = np.tile(share, (new.shape[0], 1)) if axis else np.repeat(share[:, None], new.shape[1], axis=1)
    new[:] = cv2.blendLinear(new, old, share, 1 - share)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of the view: a grid of them for each rectangle that is shown, row by row.

    Attributes:
        which: the rectangle (N,).
        boxes: x0, y0, x1, y1 (N, 4).
        before: the blocks to the left and above (N, 2), or −1.
        reach: x0, y0, x1, y1 of the whole grid (N, 4).
    """

    which: np.ndarray
    boxes: np.ndarray
    before: np.ndarray
    reach: np.ndarray

    def outer(self) -> np.ndarray:
        """Boxes (N, 4) widened by half the overlap, not beyond their grid."""
        half = _OVERLAP // 2
        wide = self.boxes + np.array([-half, -half, half, half])
        return np.clip(wide, self.reach[:, [0, 1, 0, 1]], self.reach[:, [2, 3, 2, 3]])


def _blocks(placed: Placed, labels: np.ndarray) -> _Blocks:
    """Blocks that cover each rectangle where it is shown."""
    which: list[int] = []
    boxes: list[tuple[int, ...]] = []
    before: list[tuple[int, ...]] = []
    reach: list[tuple[int, ...]] = []
    for i in range(len(placed)):
        (top, bottom), (left, right) = placed.rows[i].tolist(), placed.columns[i].tolist()
        if left >= right:
            continue
        x, y, w, h = cv2.boundingRect((labels[top:bottom, left:right] == i + 1).view(np.uint8))
        if not w:
            continue
        x, y = x + left, y + top
        across, down = _cuts(placed, i, (x, y + h / 2), (w, 0)), _cuts(placed, i, (x + w / 2, y), (0, h))
        for r, (y0, y1) in enumerate(pairwise(down)):
            for c, (x0, x1) in enumerate(pairwise(across)):
                number = len(which)
                which.append(i)
                boxes.append((x + x0, y + y0, x + x1, y + y1))
                before.append((number - 1 if c else -1, number - len(across) + 1 if r else -1))
                reach.append((x, y, x + w, y + h))
    count = len(which)
    return _Blocks(
        np.array(which, int),
        np.array(boxes, int).reshape(count, 4),
        np.array(before, int).reshape(count, 2),
        np.array(reach, int).reshape(count, 4),
    )


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


def _spans(placed: Placed, which: np.ndarray, boxes: np.ndarray) -> tuple[Array, Array]:
    """The least and the most share of the texture, along and down it, that a sample of a block is (N, 2) each."""
    Q = placed.Q[which]
    x, y = boxes[:, [0, 2, 2, 0]] - [0, 1, 1, 0], boxes[:, [1, 1, 3, 3]] - [0, 0, 1, 1]
    p = np.stack([x, y, np.ones_like(x)], axis=2) @ np.swapaxes(Q, 1, 2)
    far, near = placed.nearness[which].T[..., None]
    n = np.clip(p[..., 2], far, near)  # corners of the block may lie outside of the rectangle
    st = np.clip(p[..., :2] / n[..., None], 0, 1)
    gradient = (Q[:, None, :2, :2] - st[..., None] * Q[:, None, 2:, :2]) / n[..., None, None]
    span = np.sqrt((gradient**2).sum(axis=3))
    return span.min(axis=1), span.max(axis=1)


def _to_texels(Q: Array, boxes: np.ndarray, shapes: np.ndarray) -> Array:
    """Homographies (N, 3, 3) from a block's own samples to texels of a picture with `shapes` (N, 2) rows, columns."""
    M = Q.copy()
    M[:, :, 2] += M[:, :, 0] * boxes[:, :1] + M[:, :, 1] * boxes[:, 1:2]
    M[:, 0] = M[:, 0] * shapes[:, 1:] - 0.5 * M[:, 2]
    M[:, 1] = M[:, 1] * shapes[:, :1] - 0.5 * M[:, 2]
    return M
