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
from itertools import pairwise
from typing import NamedTuple

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
    """Samples of a view (H, W[, 3]) uint8.

    Args:
        rectangles: what to draw, in body frames.
        textures: the texture of a rectangle, by its index.
        T_world_body: body poses (B + 1, 4, 4), row 0 the identity.
        T_world_camera: the camera's pose (4, 4).
        view: the camera.
        background: what is where nothing is: one grey value, or BGR.
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
    """The blocks of a rectangle."""
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
