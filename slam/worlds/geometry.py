"""What a world is made of: textured rectangles, boxes put together from them, and rays against them.

World axes follow paper B's experiments: x right, y forward (away from the first camera), z up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from slam.data import BoolArray, IdArray
from slam.geometry.arrays import Table
from slam.geometry.se3 import Array, transform
from slam.worlds.surfaces import Material

RIGHT, LEFT, FORWARD, BACK, UP, DOWN = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


class Texture(Protocol):
    """What `slam.worlds.painting.paint` paints on a rectangle, in metres; its layout is known without painting it."""

    @property
    def width(self) -> float: ...  # noqa: D102

    @property
    def height(self) -> float: ...  # noqa: D102

    def marks(self) -> Array:
        """Points (M, 3) where something stands out: x, y from the top-left corner, and its size [m]."""
        ...


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A textured rectangle, seen from its front only."""

    origin: Array  # its texture's top-left corner (the outer edge of the first texel) in the body frame (3,) [m]
    along: Array  # its upper edge (3,) [m], the way texture rows run
    down: Array  # its left edge (3,) [m], the way texture columns run
    texture: Texture
    body: int = 0  # 0 for the still world, else the object that it is part of
    occludes: bool = False  # whether it may hide other rectangles of the world (walls of a convex room cannot)

    @property
    def normal(self) -> Array:
        """Unit normal (3,), out of the front."""
        n = np.cross(self.down, self.along)
        return n / np.linalg.norm(n)

    def parts(self) -> list[Rectangle]:
        """Parts beside each other, if its texture has any (`parts()`, from the left); else itself."""
        parts: list[Texture] = getattr(self.texture, "parts", lambda: [self.texture])()
        left = np.cumsum([0.0, *(p.width for p in parts)]) / self.texture.width
        return [
            replace(self, origin=self.origin + a * self.along, along=(b - a) * self.along, texture=p)
            for a, b, p in zip(left, left[1:], parts)
        ]


def unit(rows: Array) -> Array:
    """Rows (N, D) scaled to unit length."""
    return rows / np.sqrt(np.einsum("ij,ij->i", rows, rows))[:, None]


def rectangle(
    texture: Texture, origin: Sequence[float] | Array, along: Sequence[float] | Array, down: Sequence[float] | Array,
    body: int = 0, occludes: bool = False,
) -> Rectangle:  # fmt: skip
    """A rectangle of its texture's size; `along` and `down` need only be directions, at right angles."""
    a, d = np.array(along, float), np.array(down, float)
    a *= texture.width / np.linalg.norm(a)
    d *= texture.height / np.linalg.norm(d)
    return Rectangle(np.array(origin, float), a, d, texture, body, occludes)


#: Faces of a box: the corner where the texture begins (shares of its edges), the ways of the texture's rows and
#: columns, and the axes along which it is wide and high.
FACES = {
    "front": ((0, 0, 1), RIGHT, DOWN, (0, 2)),
    "back": ((1, 1, 1), LEFT, DOWN, (0, 2)),
    "left": ((0, 1, 1), BACK, DOWN, (1, 2)),
    "right": ((1, 0, 1), FORWARD, DOWN, (1, 2)),
    "top": ((0, 1, 1), RIGHT, BACK, (0, 1)),
    "bottom": ((0, 0, 0), RIGHT, FORWARD, (0, 1)),
}


def cuboid(
    faces: Mapping[str, Texture], size: Sequence[float] | Array, corner: Sequence[float] | Array = (0, 0, 0),
    body: int = 0, T_body_box: Array | None = None,
) -> list[Rectangle]:  # fmt: skip
    """The outer faces of a box of lengths `size` (3,) [m], with its lowest `corner` in its own axes.

    Textures are by face name: front (−y), back (+y), left (−x), right (+x), top (+z), bottom (−z). `T_body_box` is the
    pose (4, 4) of the box axes in the body frame; identity if None.
    """
    T, out = np.eye(4) if T_body_box is None else T_body_box, []
    for name, texture in faces.items():
        share, along, down, _ = FACES[name]
        start = transform(T, (np.multiply(share, size) + corner)[None])[0]
        out.append(rectangle(texture, start, T[:3, :3] @ along, T[:3, :3] @ down, body, True))
    return out


def crate(
    size: Sequence[float] | Array, looks: Material, corner: Sequence[float] | Array = (0, 0, 0), body: int = 0,
    T_body_box: Array | None = None, sides: Iterable[str] = FACES,
) -> list[Rectangle]:  # fmt: skip
    """The `sides` of a box, each a piece of its own like `looks`; thin ones are left out. See `cuboid`."""
    faces = {}
    for i, side in enumerate(sides):
        wide, high = (size[axis] for axis in FACES[side][3])
        if min(wide, high) > 0.01:
            faces[side] = replace(looks, width=wide, height=high, seed=looks.seed + i)
    return cuboid(faces, size, corner, body, T_body_box)


class Parts(NamedTuple):
    """What a scene describes of its world."""

    stamps: Array  # (N,) [s]
    poses: Array  # of the left camera (N, 4, 4)
    rectangles: list[Rectangle]  # every surface
    objects: Array | None = None  # poses of the moving objects (B, N, 4, 4)


@dataclass(frozen=True, eq=False)
class RectangleArrays(Table):
    """Many rectangles as arrays, a row each, in one frame; see `Rectangle`."""

    origin: Array  # (Q, 3)
    along: Array
    down: Array
    normal: Array
    body: IdArray  # (Q,)

    @classmethod
    def of(cls, rectangles: Iterable[Rectangle]) -> RectangleArrays:
        """Stack rectangles, each in its own body frame."""
        rows = list(rectangles)
        vectors = [np.array([getattr(r, f.name) for r in rows], float).reshape(-1, 3) for f in fields(cls)[:4]]
        origin, along, down, normal = vectors
        return cls(origin, along, down, normal, np.array([r.body for r in rows], np.int64))

    def placed(self, T_world_body: Array) -> RectangleArrays:
        """In world coordinates, for body poses (B + 1, 4, 4) whose row 0 is the identity."""
        vectors = (self.origin, self.along, self.down, self.normal)
        origin, along, down, normal = (turned(v, self.body, T_world_body) for v in vectors)
        return RectangleArrays(origin + T_world_body[self.body, :3, 3], along, down, normal, self.body)

    @cached_property
    def middle(self) -> Array:
        """Middles (Q, 3)."""
        return self.origin + (self.along + self.down) / 2

    @cached_property
    def radius(self) -> Array:
        """Half diagonals (Q,)."""
        return np.linalg.norm(self.along + self.down, axis=1) / 2


def turned(vectors: Array, bodies: IdArray, T_world_body: Array) -> Array:
    """Vectors (N, 3) in the frames of bodies (N,), in world axes; those of the still world (body 0) stay exactly."""
    moving = np.flatnonzero(bodies)
    if not len(moving):
        return vectors
    out = vectors.copy()
    out[moving] = (T_world_body[bodies[moving], :3, :3] @ vectors[moving, :, None])[..., 0]
    return out


def hidden(centre: Array, points: Array, occluders: RectangleArrays) -> BoolArray:
    """Which points (P, 3) an occluder's front hides from a camera at `centre` (3,), all in world coordinates."""
    rays, may = points - centre, (occluders.normal * (occluders.origin - centre)).sum(axis=1) < -1e-9
    ahead = rays.sum(axis=0)
    if (rays @ ahead > 0).all():  # then what is wholly behind hides nothing
        may &= (occluders.middle - centre) @ ahead >= -occluders.radius * np.linalg.norm(ahead)
    chosen = occluders.select(np.flatnonzero(may))
    offset = chosen.origin - centre
    along, down = (edge / (edge**2).sum(axis=1, keepdims=True) for edge in (chosen.along, chosen.down))
    height = (chosen.normal * offset).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = height / (rays @ chosen.normal.T)  # the ray meets the plane at centre + t · ray (P, Q)
        u = t * (rays @ along.T) - (offset * along).sum(axis=1)  # shares of the edges: 0 to 1 inside
        v = t * (rays @ down.T) - (offset * down).sum(axis=1)
        inside = (np.abs(u - 0.5) < 0.5) & (np.abs(v - 0.5) < 0.5)
        return (inside & (np.abs(t - 0.5) < 0.499)).any(axis=1)


@dataclass(frozen=True, eq=False)
class Landmarks(Table):
    """The landmarks of a world, a row each; the row is the id."""

    positions: Array  # in the frame of the object that they sit on, which is the world for object 0 (P, 3) [m]
    normals: Array  # outward unit normals of their surfaces, in the same frame (P, 3)
    surface: IdArray  # index of the rectangle that they lie on (P,)
    object: IdArray  # id of the object, 0 for the still world (P,)
    size: Array = field(repr=False)  # diameter of what is painted there (P,) [m]
    looks: IdArray = field(repr=False)  # which landmark it looks like, usually itself (P,)


def place_landmarks(
    rectangles: Iterable[Rectangle], density: float, rng: np.random.Generator, alike: bool = False
) -> Landmarks:
    """Choose landmarks among the marks of all rectangles: at most `density` per square metre, at random.

    Marks smaller than 1 mm or within 5 mm of the border are left out. With `alike`, the same marks are chosen where a
    texture comes again, and they look like those of the first time.
    """
    chosen: dict[Texture, tuple[Array, int]] = {}
    rows, count = [], 0
    for index, r in enumerate(rectangles):
        if not alike or r.texture not in chosen:
            marks, size = r.texture.marks(), (r.texture.width - 0.005, r.texture.height - 0.005)
            marks = marks[((marks[:, :2] > 0.005) & (marks[:, :2] < size)).all(axis=1) & (marks[:, 2] > 1e-3)]
            wanted = min(len(marks), round(density * r.texture.width * r.texture.height))
            chosen[r.texture] = marks[np.sort(rng.permutation(len(marks))[:wanted])], count
        marks, first = chosen[r.texture]
        n = len(marks)
        along, down = (edge / np.linalg.norm(edge) for edge in (r.along, r.down))
        places = r.origin + marks[:, :1] * along + marks[:, 1:2] * down
        looks = np.arange(first, first + n)
        rows.append((places, np.tile(r.normal, (n, 1)), np.full(n, index), np.full(n, r.body), marks[:, 2], looks))
        count += n
    return Landmarks(*(np.concatenate(column) for column in zip(*rows)))
