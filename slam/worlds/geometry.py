"""What a world is made of: textured rectangles, boxes put together from them, and rays against them.

World axes follow paper B's experiments: x right, y forward (away from the first camera), z up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from slam.data import BoolArray, IdArray
from slam.geometry.se3 import Array, transform


class Texture(Protocol):
    """What is painted on a rectangle: its layout is known without painting it.

    Attributes:
        width, height: size [m].
    """

    @property
    def width(self) -> float: ...  # noqa: D102

    @property
    def height(self) -> float: ...  # noqa: D102

    def marks(self) -> Array:
        """Points (M, 3) where something stands out: x, y from the top-left corner, and its size [m]."""
        ...


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A textured rectangle, seen from its front only.

    Attributes:
        origin: its texture's top-left corner (the outer edge of the first texel) in the body frame (3,) [m].
        along: its upper edge (3,) [m], the way texture rows run.
        down: its left edge (3,) [m], the way texture columns run.
        texture: what is painted on it.
        body: 0 for the still world, else the object that it is part of.
        occludes: whether it may hide other rectangles of the world (walls of a convex room cannot).
    """

    origin: Array
    along: Array
    down: Array
    texture: Texture
    body: int = 0
    occludes: bool = False

    def points(self, xy: Array) -> Array:
        """Points (N, 3) in the body frame of texture places (N, 2) [m] from the top-left corner."""
        unit_along = self.along / np.linalg.norm(self.along)
        unit_down = self.down / np.linalg.norm(self.down)
        return self.origin + xy[:, :1] * unit_along + xy[:, 1:2] * unit_down

    @property
    def normal(self) -> Array:
        """Unit normal (3,), out of the front."""
        n = np.cross(self.down, self.along)
        return n / np.linalg.norm(n)


def rectangle(
    texture: Texture, origin: Iterable[float], along: Iterable[float], down: Iterable[float],
    body: int = 0, occludes: bool = False,
) -> Rectangle:  # fmt: skip
    """A rectangle of its texture's size; `along` and `down` need only be directions, at right angles."""
    a, d = np.array(list(along), float), np.array(list(down), float)
    a *= texture.width / np.linalg.norm(a)
    d *= texture.height / np.linalg.norm(d)
    return Rectangle(np.array(list(origin), float), a, d, texture, body, occludes)


def in_parts(whole: Rectangle) -> list[Rectangle]:
    """A rectangle's parts beside each other, if its texture has any (`parts()`, from the left); else itself."""
    parts: list[Texture] = getattr(whole.texture, "parts", list)()
    if not parts:
        return [whole]
    left = np.cumsum([0.0, *(p.width for p in parts)]) / whole.texture.width
    return [
        replace(whole, origin=whole.origin + a * whole.along, along=(b - a) * whole.along, texture=p)
        for a, b, p in zip(left, left[1:], parts)
    ]


def cuboid(
    faces: Mapping[str, Texture], size: Iterable[float], corner: Iterable[float] = (0, 0, 0),
    body: int = 0, T_body_box: Array | None = None,
) -> list[Rectangle]:  # fmt: skip
    """The outer faces of a box with edges `size` (3,) along x, y, z from its lowest corner.

    Args:
        faces: textures by face name: front (−y), back (+y), left (−x), right (+x), top (+z), bottom (−z).
        size: lengths [m] along the box's x, y and z axes.
        corner: its corner with the lowest coordinates, in box axes.
        body: the object that it is part of.
        T_body_box: pose (4, 4) of the box axes in the body frame; identity if None.
    """
    x, y, z = np.array(list(size), float)
    layout = {
        "front": ((0, 0, z), (1, 0, 0), (0, 0, -1)),
        "back": ((x, y, z), (-1, 0, 0), (0, 0, -1)),
        "left": ((0, y, z), (0, -1, 0), (0, 0, -1)),
        "right": ((x, 0, z), (0, 1, 0), (0, 0, -1)),
        "top": ((0, y, z), (1, 0, 0), (0, -1, 0)),
        "bottom": ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    }
    T = np.eye(4) if T_body_box is None else T_body_box
    lowest = np.array(list(corner), float)
    out = []
    for name, texture in faces.items():
        origin, along, down = (np.array(v, float) for v in layout[name])
        start = transform(T, (origin + lowest)[None])[0]
        out.append(rectangle(texture, start, T[:3, :3] @ along, T[:3, :3] @ down, body, True))
    return out


class Parts(NamedTuple):
    """What a scene describes of its world.

    Attributes:
        stamps, poses: of the left camera (N,) [s], (N, 4, 4).
        rectangles: every surface.
        objects: poses of the moving objects (B, N, 4, 4), or None.
    """

    stamps: Array
    poses: Array
    rectangles: list[Rectangle]
    objects: Array | None = None


@dataclass(frozen=True, eq=False)
class RectangleArrays:
    """Many rectangles as arrays, a row each, in one frame.

    Attributes:
        origin, along, down, normal: see `Rectangle` (Q, 3).
        body: see `Rectangle` (Q,).
    """

    origin: Array
    along: Array
    down: Array
    normal: Array
    body: IdArray

    @classmethod
    def of(cls, rectangles: Iterable[Rectangle]) -> RectangleArrays:
        """Stack rectangles, each in its own body frame."""
        rows = list(rectangles)
        origin, along, down, normal = (
            np.array([getattr(r, name) for r in rows], float).reshape(-1, 3)
            for name in ("origin", "along", "down", "normal")
        )
        return cls(origin, along, down, normal, np.array([r.body for r in rows], np.int64))

    def placed(self, T_world_body: Array) -> RectangleArrays:
        """In world coordinates, for body poses (B + 1, 4, 4) whose row 0 is the identity."""
        moving = np.flatnonzero(self.body)
        if not len(moving):
            return self
        T = T_world_body[self.body[moving]]
        turned = [column.copy() for column in (self.origin, self.along, self.down, self.normal)]
        for column in turned:
            column[moving] = (T[:, :3, :3] @ column[moving, :, None])[..., 0]
        origin, along, down, normal = turned
        origin[moving] += T[:, :3, 3]
        return RectangleArrays(origin, along, down, normal, self.body)

    def select(self, rows: np.ndarray) -> RectangleArrays:
        """These rows."""
        return RectangleArrays(self.origin[rows], self.along[rows], self.down[rows], self.normal[rows], self.body[rows])

    def __len__(self) -> int:
        return len(self.body)

    @cached_property
    def middle(self) -> Array:
        """Middles (Q, 3)."""
        return self.origin + (self.along + self.down) / 2

    @cached_property
    def radius(self) -> Array:
        """Half diagonals (Q,)."""
        return np.linalg.norm(self.along + self.down, axis=1) / 2

    @cached_property
    def inverse_edges(self) -> tuple[Array, Array]:
        """``along / |along|²`` and ``down / |down|²`` (Q, 3): their products with an offset run from 0 to 1 inside."""
        return (
            self.along / (self.along**2).sum(axis=1, keepdims=True),
            self.down / (self.down**2).sum(axis=1, keepdims=True),
        )


def hidden(centre: Array, points: Array, occluders: RectangleArrays) -> BoolArray:
    """Which points (P, 3) an occluder's front hides from a camera at `centre` (3,), all in world coordinates."""
    rays = points - centre
    rows = _between(centre, rays, occluders)
    if not len(rows):
        return np.zeros(len(points), bool)
    chosen = occluders.select(rows)
    offset = chosen.origin - centre
    along, down = chosen.inverse_edges
    height = (chosen.normal * offset).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = height / (rays @ chosen.normal.T)  # the ray meets the plane at centre + t · ray (P, Q)
        u = t * (rays @ along.T) - (offset * along).sum(axis=1)
        v = t * (rays @ down.T) - (offset * down).sum(axis=1)
        inside = (np.abs(u - 0.5) < 0.5) & (np.abs(v - 0.5) < 0.5)
        return (inside & (np.abs(t - 0.5) < 0.499)).any(axis=1)


def _between(centre: Array, rays: Array, occluders: RectangleArrays) -> np.ndarray:
    """Rows of occluders that face the camera and may lie between it and a point: their spheres meet the rays' cone."""
    if not len(rays):
        return np.zeros(0, int)
    offset = occluders.middle - centre
    distance = np.sqrt(np.einsum("ij,ij->i", offset, offset)) + 1e-12
    length = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    unit = rays / length[:, None]
    axis = unit.mean(axis=0)
    axis /= np.linalg.norm(axis)
    widest = np.arccos(np.clip((unit @ axis).min(), -1, 1))
    angle = np.arccos(np.clip((offset @ axis) / distance, -1, 1))
    angle -= np.arcsin(np.minimum(occluders.radius / distance, 1.0))
    facing = np.einsum("ij,ij->i", occluders.normal, offset) < -1e-9
    near = distance - occluders.radius < length.max()
    return np.flatnonzero(facing & near & ((angle < widest) | (distance < occluders.radius)))


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The landmarks of a world, a row each; the row is the id.

    Attributes:
        positions: in the frame of the object that they sit on, which is the world for object 0 (P, 3) [m].
        normals: outward unit normals of their surfaces, in the same frame (P, 3).
        surface: index of the rectangle that they lie on (P,).
        object: id of the object, 0 for the still world (P,).
        size: diameter of what is painted there (P,) [m].
        looks: which landmark it looks like, usually itself (P,).
    """

    positions: Array
    normals: Array
    surface: IdArray
    object: IdArray
    size: Array = field(repr=False)
    looks: IdArray = field(repr=False)

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, rows: IdArray) -> Landmarks:
        """These rows; `surface` and `looks` stay as they are."""
        return Landmarks(*(getattr(self, f.name)[rows] for f in fields(self)))

    def world_positions(self, T_world_body: Array) -> Array:
        """Positions (P, 3) in the world, for body poses (B + 1, 4, 4) whose row 0 is the identity."""
        out = self.positions.copy()
        moving = np.flatnonzero(self.object)
        if len(moving):
            T = T_world_body[self.object[moving]]
            out[moving] = (T[:, :3, :3] @ out[moving, :, None])[..., 0] + T[:, :3, 3]
        return out


def place_landmarks(
    rectangles: Iterable[Rectangle], density: float, rng: np.random.Generator, alike: bool = False
) -> Landmarks:
    """Choose landmarks among the marks of all rectangles: at most `density` per square metre, at random.

    Marks smaller than 1 mm or within 5 mm of the border are left out. With `alike`, the same marks are chosen where a
    texture comes again, and they look like those of the first time.
    """
    chosen: dict[Texture, tuple[Array, int]] = {}
    columns: list[list[np.ndarray]] = [[], [], [], [], [], []]
    count = 0
    for index, r in enumerate(rectangles):
        if not alike or r.texture not in chosen:
            chosen[r.texture] = _chosen_marks(r.texture, density, rng), count
        marks, first = chosen[r.texture]
        n = len(marks)
        normals, looks = np.tile(r.normal, (n, 1)), np.arange(first, first + n)
        rows = (r.points(marks[:, :2]), normals, np.full(n, index), np.full(n, r.body), marks[:, 2], looks)
        for column, part in zip(columns, rows):
            column.append(part)
        count += n
    positions, normals, surface, body, size, looks = (np.concatenate(c) for c in columns)
    return Landmarks(positions, normals, surface.astype(np.int64), body.astype(np.int64), size, looks.astype(np.int64))


def _chosen_marks(texture: Texture, density: float, rng: np.random.Generator) -> Array:
    """Marks (M, 3) of a texture that are landmarks."""
    marks = texture.marks()
    inside = (marks[:, :2] > 0.005).all(axis=1) & (marks[:, 0] < texture.width - 0.005)
    marks = marks[inside & (marks[:, 1] < texture.height - 0.005) & (marks[:, 2] > 1e-3)]
    wanted = min(len(marks), round(density * texture.width * texture.height))
    return marks[np.sort(rng.permutation(len(marks))[:wanted])]
