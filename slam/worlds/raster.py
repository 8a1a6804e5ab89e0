"""Pictures of a world: textured rectangles drawn in perspective with a depth buffer, supersampled.

Each rectangle is cut into tiles. A tile's texture reaches the picture by one homography, taken from the version of the
texture whose texels are as large as a sample; averaging the samples of a pixel then gives the pixel's area. Nothing is
finer than the samples, so no aliasing is left for a detector to find.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from slam.camera import PinholeCamera
from slam.se3 import Array
from slam.worlds.geometry import Rectangle, RectangleArrays
from slam.worlds.textures.ripmap import Ripmap

NEAR = 0.02  #: what is nearer than this is not drawn [m]
_OVERLAP = 1e-4  # tiles reach over their edges by this share, so that no sample falls between two of them


@dataclass(frozen=True)
class Tiles:
    """The tiles of all rectangles.

    Attributes:
        arrays: tiles as rectangles in their body frames.
        source: the rectangle that each is part of (T,).
        start, end: the part of the texture that each shows: x, y as shares of its size (T, 2).
    """

    arrays: RectangleArrays
    source: np.ndarray
    start: Array
    end: Array

    @classmethod
    def cut(cls, rectangles: Sequence[Rectangle], size: float) -> Tiles:
        """Cut rectangles into tiles of about `size` [m]."""
        tiles, source, start, end = [], [], [], []
        for index, r in enumerate(rectangles):
            n = _pieces(float(np.linalg.norm(r.along)), float(np.linalg.norm(r.down)), size)
            for i in range(n[0]):
                for j in range(n[1]):
                    corner = r.origin + (i / n[0]) * r.along + (j / n[1]) * r.down
                    tiles.append(Rectangle(corner, r.along / n[0], r.down / n[1], r.texture, r.body))
                    source.append(index)
                    start.append((i / n[0], j / n[1]))
                    end.append(((i + 1) / n[0], (j + 1) / n[1]))
        return cls(RectangleArrays.of(tiles), np.array(source, int), np.array(start), np.array(end))


def _pieces(along: float, down: float, size: float) -> tuple[int, int]:
    """Into how many pieces to cut edges of these lengths [m]: long ones run away from the camera, and need more."""
    shorter = 3 * size
    a, d = (size, shorter) if along >= down else (shorter, size)
    return max(1, round(along / a)), max(1, round(down / d))


class View(NamedTuple):
    """An undistorted view to draw: camera matrix (3, 3) in samples, and size in samples."""

    K: Array
    width: int
    height: int


@dataclass(frozen=True)
class Lens:
    """How one camera's pixels come from an undistorted view.

    Attributes:
        view: the undistorted view.
        maps: where each sample of the camera's image lies in the view, x and y; None where it lies in its own place.
        supersample: samples per pixel along each axis.
    """

    view: View
    maps: tuple[np.ndarray, np.ndarray] | None
    supersample: int

    @classmethod
    def of(cls, camera: PinholeCamera, supersample: int) -> Lens:
        """The lens of a camera. A sample's centre is at ((i + ½) / supersample − ½) pixels."""
        s = supersample
        width, height = camera.width * s, camera.height * s
        K = camera.K
        K[:2] *= s
        K[:2, 2] += (s - 1) / 2
        if not camera.has_distortion:
            return cls(View(K, width, height), None, s)
        y, x = np.mgrid[:height, :width]
        uv = np.stack([x.ravel(), y.ravel()], axis=1) / s - (s - 1) / (2 * s)
        rays = camera.normalise(uv)
        rays = np.where(np.isfinite(rays), rays, 0.0)
        low, high = rays.min(axis=0), rays.max(axis=0)
        margin = 2.0
        K[:2, 2] = margin - low * (K[0, 0], K[1, 1])
        size = np.ceil((high - low) * (K[0, 0], K[1, 1]) + 2 * margin).astype(int) + 1
        places = (rays * (K[0, 0], K[1, 1]) + K[:2, 2]).astype(np.float32).reshape(height, width, 2)
        return cls(View(K, *size), (places[..., 0].copy(), places[..., 1].copy()), s)

    def expose(self, samples: np.ndarray) -> np.ndarray:
        """The camera's image from samples of the view: distorted, and averaged over each pixel."""
        if self.maps is not None:
            samples = cv2.remap(samples, *self.maps, cv2.INTER_LINEAR)
        size = samples.shape[1] // self.supersample, samples.shape[0] // self.supersample
        return cv2.resize(samples, size, interpolation=cv2.INTER_AREA)


def draw(
    tiles: Tiles, textures: Callable[[int], Ripmap], T_world_body: Array, T_world_camera: Array, view: View,
    background: Sequence[int], channels: int,
) -> np.ndarray:  # fmt: skip
    """Samples of a view (H, W[, 3]) uint8.

    Args:
        tiles: what to draw.
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
    nearness = np.zeros((view.height, view.width), np.float32)
    placed = place(tiles, T_world_body, T_world_camera, view)
    for i in range(len(placed.rows)):
        _draw_tile(placed, i, textures, picture, nearness)
    return picture


@dataclass(frozen=True)
class PlacedTiles:
    """Tiles in a view, nearest first, a row each.

    Attributes:
        source: the rectangle that each is part of (T,).
        M: (T, 3, 3) takes a sample's (x, y, 1) to shares of the whole texture.
        span: how far along and down the whole texture a sample reaches, as shares of it (T, 2).
        nearest: 1 / depth of the nearest corner (T,).
        rows: first row of the view that may be covered, and the row after the last (T, 2).
        first, last: first and last sample covered in each row of the view (T, H) int16.
        in_row, in_column: their sum is a sample's 1 / depth (T, H), (T, W) float32.
    """

    source: np.ndarray
    M: Array
    span: Array
    nearest: Array
    rows: np.ndarray
    first: np.ndarray
    last: np.ndarray
    in_row: np.ndarray
    in_column: np.ndarray


def place(tiles: Tiles, T_world_body: Array, T_world_camera: Array, view: View) -> PlacedTiles:
    """The tiles that may be seen in a view."""
    R, c = T_world_camera[:3, :3], T_world_camera[:3, 3]
    world = tiles.arrays.placed(T_world_body)
    rows = _in_frustum(world, R, c, view)
    edges = np.stack([world.along[rows], world.down[rows], world.origin[rows] - c], axis=2)
    H = view.K @ (R.T @ edges)  # take (s, t, 1) to depth · (x, y, 1)
    corners = _corners_before(H)
    nearest = 1 / corners[..., 2].min(axis=1)
    order = np.argsort(-nearest, kind="stable")
    outline = corners[order, :, :2] / corners[order, :, 2:]
    low = np.maximum(np.ceil(outline.min(axis=1) - 0.1), 0).astype(int)
    high = np.minimum(np.floor(outline.max(axis=1) + 0.1) + 1, (view.width, view.height)).astype(int)
    kept = np.flatnonzero((low < high).all(axis=1))
    order, outline, low, high = order[kept], outline[kept], low[kept], high[kept]
    rows = rows[order]
    Q = np.linalg.inv(H[order])  # take (x, y, 1) to (s, t, 1) / depth
    share = tiles.end[rows] - tiles.start[rows]
    S = np.zeros_like(Q)
    S[:, 0, 0], S[:, 1, 1], S[:, 2, 2] = share[:, 0], share[:, 1], 1.0
    S[:, :2, 2] = tiles.start[rows]
    span = share * _span(Q, np.clip(outline, low[:, None], high[:, None]))
    first, last = _covered(Q, view)
    extent = np.stack([low[:, 1], high[:, 1]], axis=1)
    in_row = Q[:, 2, 1, None] * np.arange(view.height) + Q[:, 2, 2, None]
    in_column = Q[:, 2, 0, None] * np.arange(view.width)
    return PlacedTiles(
        tiles.source[rows], S @ Q, span, nearest[order], extent, first, last,
        in_row.astype(np.float32), in_column.astype(np.float32),
    )  # fmt: skip


def _covered(Q: Array, view: View) -> tuple[np.ndarray, np.ndarray]:
    """First and last sample that tiles cover in each row of the view (T, H) int16; last < first where none."""
    s, t, n = Q[:, 0], Q[:, 1], Q[:, 2]
    edges = np.stack([s, n - s, t, n - t], axis=1) + _OVERLAP * n[:, None]
    a, b, c = np.moveaxis(edges, 2, 0)[..., None]  # inside, a·x + b·y + c ≥ 0 for all four
    a = np.where(a == 0, 1e-300, a)
    crossing = -(b * np.arange(view.height) + c) / a
    first = np.ceil(np.where(a > 0, crossing, 0.0).max(axis=1))
    last = np.floor(np.where(a > 0, float(view.width), crossing).min(axis=1))
    return np.clip(first, 0, view.width).astype(np.int16), np.clip(last, -1, view.width - 1).astype(np.int16)


def _in_frustum(world: RectangleArrays, R: Array, c: Array, view: View) -> np.ndarray:
    """Rows of tiles whose front faces a camera (pose R, c) and whose surrounding sphere reaches into the view."""
    offset = world.origin - c
    middle = (offset + (world.along + world.down) / 2) @ R
    fx, fy, cx, cy = view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
    walls = np.array([[fx, 0, cx], [-fx, 0, view.width - cx], [0, fy, cy], [0, -fy, view.height - cy]])
    walls /= np.linalg.norm(walls, axis=1, keepdims=True)  # inward normals of the planes that bound the view
    inside = ((offset * world.normal).sum(axis=1) < -1e-6) & (middle[:, 2] > NEAR - world.radius)
    inside &= (middle @ walls.T > -world.radius[:, None]).all(axis=1)
    return np.flatnonzero(inside)


_SQUARE = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 1, 1]])


def _corners_before(H: Array) -> Array:
    """Corners (M, 5, 3) as depth · (x, y, 1) of the parts of tiles that lie before the camera; the last may repeat.

    A tile of which nothing does gets points at the nearest depth drawn, outside of every view.
    """
    corners = _SQUARE @ np.swapaxes(H, 1, 2)
    for i in np.flatnonzero((corners[..., 2] < NEAR).any(axis=1)):
        part = _cut_near(corners[i, :4])
        if len(part) < 3:
            part = np.array([[-1e6, -1e6, NEAR]])
        corners[i] = part[np.minimum(np.arange(5), len(part) - 1)]
    return corners


def _cut_near(polygon: Array) -> Array:
    """The part of a polygon (M, 3) whose last coordinate is at least NEAR."""
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        if a[2] >= NEAR:
            out.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            out.append(a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(out).reshape(-1, 3)


def _span(Q: Array, outline: Array) -> Array:
    """How far s and t run (M, 2) per sample: the geometric mean of the least and the most at the corners (M, 5, 2)."""
    points = np.concatenate([outline, np.ones((*outline.shape[:2], 1))], axis=2)
    p = points @ np.swapaxes(Q, 1, 2)
    n = np.maximum(p[..., 2:], 1e-9)[..., None]
    gradient = (Q[:, None, :2, :2] - (p[..., :2, None] / n) * Q[:, None, 2:, :2]) / n
    span = np.sqrt((gradient**2).sum(axis=3))
    return np.sqrt(span.min(axis=1) * span.max(axis=1))


def _draw_tile(
    tiles: PlacedTiles, i: int, textures: Callable[[int], Ripmap], picture: np.ndarray, nearness: np.ndarray
) -> None:
    """Draw a tile where it is nearer than what is there."""
    y0, y1 = int(tiles.rows[i, 0]), int(tiles.rows[i, 1])
    x0, x1 = int(tiles.first[i, y0:y1].min()), int(tiles.last[i, y0:y1].max()) + 1
    if x0 >= x1:
        return
    behind = nearness[y0:y1, x0:x1]
    if behind.min() >= tiles.nearest[i]:
        return
    x = np.arange(x0, x1, dtype=np.int16)
    inside = x >= tiles.first[i, y0:y1, None]
    inside &= x <= tiles.last[i, y0:y1, None]
    near = tiles.in_column[i, x0:x1] + tiles.in_row[i, y0:y1, None]
    inside &= near > behind
    if not inside.any():
        return
    mask = inside.view(np.uint8)
    cv2.copyTo(near, mask, behind)
    level = textures(int(tiles.source[i])).level(tiles.span[i])
    rows, columns = level.shape[:2]
    M = np.array([[columns, 0, -0.5], [0, rows, -0.5], [0, 0, 1.0]]) @ tiles.M[i]  # from samples to texels
    M[:, 2] += M[:, :2] @ (x0, y0)
    drawn = cv2.warpPerspective(
        level, M, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    cv2.copyTo(drawn, mask, picture[y0:y1, x0:x1])
