"""True depth and object of every pixel, by casting a ray through each pixel's centre: exact for every camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.data import BoolArray
from slam.geometry.camera import PinholeCamera
from slam.geometry.se3 import Array
from slam.worlds.geometry import RectangleArrays
from slam.worlds.world import World

_NEAR = 0.02
_WIDER = 1.4  # lens distortion may widen the view by less than this factor


class TruthImages(NamedTuple):
    """Truth of every pixel of the left image.

    Attributes:
        depth: distance along the optical axis (H, W) float32 [m]; 0 where nothing is.
        objects: object (H, W) int32; 0 for the still world, and where nothing is.
    """

    depth: np.ndarray
    objects: np.ndarray


def truth_images(world: World, frame: int) -> TruthImages:
    """Depth and objects in one frame's left image."""
    camera = world.rig.left
    T = world.T_world_left[frame]
    placed = world.arrays.placed(world.T_world_body(frame))
    rays = pixel_rays(camera)
    nearness = np.zeros((camera.height, camera.width))
    objects = np.zeros((camera.height, camera.width), np.int32)
    facing = ((placed.origin - T[:3, 3]) * placed.normal).sum(axis=1) < -1e-9
    for row in np.flatnonzero(facing & _may_be_seen(placed, T, camera)):
        _cast(placed, int(row), T, camera, rays, nearness, objects)
    with np.errstate(divide="ignore"):
        depth = np.where(nearness > 0, 1 / nearness, 0.0)
    return TruthImages(depth.astype(np.float32), objects)


def _may_be_seen(placed: RectangleArrays, T_world_camera: Array, camera: PinholeCamera) -> BoolArray:
    """Rectangles whose surrounding sphere reaches into a pyramid somewhat wider than the view."""
    middle = (placed.middle - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    x = _WIDER * max(camera.u0, camera.width - camera.u0) / camera.fu
    y = _WIDER * max(camera.v0, camera.height - camera.v0) / camera.fv
    walls = np.array([[1, 0, x], [-1, 0, x], [0, 1, y], [0, -1, y]])
    walls /= np.linalg.norm(walls, axis=1, keepdims=True)  # inward normals
    return np.asarray((middle @ walls.T > -placed.radius[:, None]).all(axis=1) & (middle[:, 2] > -placed.radius))


def pixel_rays(camera: PinholeCamera) -> Array:
    """Rays (H, W, 3) with z = 1 through the pixels' centres, in camera axes."""
    v, u = np.mgrid[: camera.height, : camera.width]
    ab = camera.normalise(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    return np.column_stack([ab, np.ones(len(ab))]).reshape(camera.height, camera.width, 3)


def _cast(
    placed: RectangleArrays, row: int, T_world_camera: Array, camera: PinholeCamera, rays: Array, nearness: Array,
    objects: np.ndarray,
) -> None:  # fmt: skip
    """Enter one rectangle where it is nearer than what is there, in place."""
    R, c = T_world_camera[:3, :3], T_world_camera[:3, 3]
    edges = np.column_stack([placed.along[row], placed.down[row], placed.origin[row] - c])
    P = R.T @ edges
    box = _box(P, camera)
    if box is None:
        return
    y, x = box
    st = rays[y, x] @ np.linalg.inv(P).T  # (s, t, 1) / depth
    s, t, near = st[..., 0], st[..., 1], st[..., 2]
    shown = (s >= 0) & (s <= near) & (t >= 0) & (t <= near) & (near > nearness[y, x]) & (near < 1 / _NEAR)
    nearness[y, x][shown] = near[shown]
    objects[y, x][shown] = placed.body[row]


def _box(P: Array, camera: PinholeCamera) -> tuple[slice, slice] | None:
    """Rows and columns of the image that a rectangle may cover: all of them where it reaches behind the camera."""
    around = np.linspace(0, 1, 17)
    zero, one = np.zeros(17), np.ones(17)
    s, t = np.concatenate([around, one, around, zero]), np.concatenate([zero, around, one, around])
    points = np.column_stack([s, t, np.ones(len(s))]) @ P.T
    if (points[:, 2] <= 0).all():
        return None
    everywhere = slice(0, camera.height), slice(0, camera.width)
    if (points[:, 2] < 0.1).any() or (np.abs(points[:, :2]) > 3 * points[:, 2:]).any():
        return everywhere
    uv = camera.project(points)
    (x0, y0), (x1, y1) = np.floor(uv.min(axis=0)) - 3, np.ceil(uv.max(axis=0)) + 4
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, camera.width), min(y1, camera.height)
    return None if x0 >= x1 or y0 >= y1 else (slice(int(y0), int(y1)), slice(int(x0), int(x1)))
