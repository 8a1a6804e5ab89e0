"""Streets along a path: house fronts on both sides, trees and parked cars, the same ones wherever it comes back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from slam.data import IdArray
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.worlds.drives import EYE, SAME_ROAD, STEP, Road, around_blocks, interpolated, level, read_path, sampled
from slam.worlds.geometry import DOWN, Parts, Rectangle, crate, cuboid, rectangle
from slam.worlds.paths import placed
from slam.worlds.surfaces import Facade, Material

ASIDE = 9.0  #: from a road's middle to the house fronts [m]
STRETCH = 48.0  #: streets are built in stretches of this length [m], so that one can be like another
_HOUSES = 4  # on each side of a stretch
_NARROWEST = 3.0  # of a house front [m]
_BENT = 0.5  # most that the road turns along one front [rad]
_FOUNDATION = 0.3  # of house fronts below the lowest ground before them [m]
_EVEN = 0.2  # a town with no greater differences in height is level [m]
_TREES, _CARS, _CABINETS = 4, 5, 2  # on each side of a stretch
#: What stands beside a road: how far from its middle [m], and of a post its size [m], material and seed.
_BESIDE: dict[str, tuple[float, tuple[float, float, float], str, int]] = {
    "trees": (7.6, (0.35, 0.35, 4.0), "wood", 10),
    "cabinets": (8.2, (1.0, 0.5, 1.4), "poster", 20),  # full of bills
    "cars": (6.2, (0, 0, 0), "", 30),
}
_CLEAR = 2.6  # nothing stands so near to where the camera drives [m]
_AROUND = 16  # samples ahead and behind between which a road is straight where something stands at its side
_TILE = 12.0  # edges of the ground's parts [m]
_LAP = 0.3  # by which these overlap where the ground is not level [m]
_SMOOTHED = 6.0  # standard deviation of the mean that gives the ground's height [m]


#: The two boxes of a car: size, lowest corner [m], and materials of its back, its front and its sides.
_CAR = (
    ((1.75, 4.3, 0.75), (-0.875, -2.15, 0.2), ("car_back", "car_front", "car_side")),
    ((1.5, 2.3, 0.55), (-0.75, -1.35, 0.95), ("cabin_end", "cabin_end", "cabin_side")),
)


def car(T: Array, seed: int, body: int = 0) -> list[Rectangle]:
    """A car of two boxes; its frame: origin on the ground in its middle, y ahead."""
    out = []
    for size, corner, (rear, fore, side) in _CAR:
        x, y, z = size
        sides = {"front": (rear, x, z), "back": (fore, x, z), "left": (side, y, z), "right": (side, y, z)}
        faces = {face: Material(a, b, name, seed, 12, (0.05, 0.25)) for face, (name, a, b) in sides.items()}
        faces["top"] = Material(x, y, "car_top", seed, 1, (0.05, 0.2))
        out += cuboid(faces, size, corner, body, T)
    return out


def post(T: Array, size: tuple[float, float, float], material: str, seed: int) -> list[Rectangle]:
    """A box that stands on the ground; its frame: origin on the ground in its middle."""
    looks = Material(0, 0, material, 10 * seed, 12, (0.05, 0.25))
    corner = (-size[0] / 2, -size[1] / 2, 0)
    return crate(size, looks, corner, T_body_box=T, sides=("front", "back", "left", "right"))


def drive(values: Mapping[str, Any]) -> Parts:
    """A town along the path of a file; raises SequenceError where the file is no path."""
    return _town(read_path(values["path"]), values)


def town(values: Mapping[str, Any]) -> Parts:
    """Streets around two blocks, driven again in the same direction and in the opposite one."""
    return _town(around_blocks(values["layout"]), values)


def _town(path: Trajectory, values: Mapping[str, Any]) -> Parts:
    """Streets along a path, in the path's own axes, and the drive along them."""
    R = level(path)  # to level axes
    streets = Streets(Road.along(path.positions @ R.T), values["layout"])
    drive = sampled(path, values)
    parts = [replace(r, origin=R.T @ r.origin, along=R.T @ r.along, down=R.T @ r.down) for r in streets.rectangles()]
    return Parts(drive.stamps, drive.poses, parts)


@dataclass(frozen=True, eq=False)
class Plan:
    """What stands on one side of a stretch."""

    widths: Array  # of its houses [m]
    heights: Array
    beside: Mapping[str, Array]  # distances of trees, cabinets and cars along the stretch [m]
    seed: int  # of their looks


@lru_cache(maxsize=4096)
def _plan(layout: int, stretch: int, side: int) -> Plan:
    """The plan of a stretch (from 0) and a side (−1 right, 1 left)."""
    rng = np.random.default_rng([layout, 51, stretch, side + 1])
    cuts = (np.arange(1, _HOUSES) + rng.uniform(-0.2, 0.2, _HOUSES - 1)) * STRETCH / _HOUSES
    edges = np.concatenate([[0.0], np.round(cuts, 2), [STRETCH]])
    cars, posts = ((np.arange(n) + rng.uniform(0.3, 0.7, n)) * STRETCH / n for n in (_CARS, _TREES + _CABINETS))
    posts = rng.permutation(posts)
    heights = np.round(rng.uniform(7, 12, _HOUSES), 2)
    beside = {"trees": posts[:_TREES], "cabinets": posts[_TREES:], "cars": cars[rng.random(_CARS) < 0.7]}
    return Plan(np.diff(edges), heights, beside, int(rng.integers(1 << 24)) * 100)


class Streets:
    """Streets along a road; `layout` is the seed of what stands where."""

    def __init__(self, road: Road, layout: int) -> None:
        self._road, self._layout = road, layout
        self._tree = cKDTree(road.xy)
        self._drives = cKDTree(road.drives[:, :2])
        near = self._drives.query_ball_point(road.xy, SAME_ROAD + STEP)
        heights = road.drives[:, 2] - EYE
        self._low = np.array([heights[rows].min() for rows in near])
        self._high = np.array([heights[rows].max() for rows in near])
        self._foundation = _FOUNDATION
        if self._high.max() - self._low.min() < _EVEN:
            self._low = self._high = np.full(len(near), np.median(heights))
            self._foundation = 0.0
        self._stretch = np.floor((road.way - road.way[0]) / STRETCH).astype(int)

    def rectangles(self) -> list[Rectangle]:
        """Everything, in level axes."""
        return [*self.houses(), *self.beside("trees", "cabinets"), *self.ground(), *self.beside("cars")]

    def houses(self) -> Iterator[Rectangle]:
        """House fronts along both sides of every road, and across both ends of the path."""
        for side in (1, -1):
            for run in self._runs(side):
                yield from self._fronts(run, side)
        yield from self._ends()

    def _runs(self, side: int) -> Iterator[IdArray]:
        """Successive samples of the road with a house front beside them: no road runs there."""
        edge = self._road.xy + side * ASIDE * self._road.left
        free = self._tree.query(edge)[0] > ASIDE - 0.02
        rows = np.flatnonzero(free)
        step = np.linalg.norm(np.diff(edge[rows], axis=0), axis=1)
        apart = (np.diff(self._road.way[rows]) > 1.5 * STEP) | (step > 4 * STEP)
        yield from (run for run in np.split(rows, np.flatnonzero(apart) + 1) if len(run) > 1)

    def _fronts(self, run: IdArray, side: int) -> Iterator[Rectangle]:
        way = self._road.way[run]
        edge = self._road.xy[run] + side * ASIDE * self._road.left[run]
        for a, b, part in self._pieces(way[0], way[-1], side):
            ends = interpolated(np.array([a, b]), way, edge)
            before = run[(way >= a) & (way <= b)]
            if not len(before):
                continue
            stretch, along = divmod((a + b) / 2 - self._road.way[0], STRETCH)
            plan = self._plan(int(stretch), side)
            house = min(int(np.searchsorted(np.cumsum(plan.widths), along)), _HOUSES - 1)
            width = float(np.linalg.norm(ends[1] - ends[0]))
            if abs(width - plan.widths[house]) < 0.25:
                width = float(plan.widths[house])  # as it is wherever the same house stands
            spread = float((self._high - self._low)[before].max())
            height = float(plan.heights[house]) + (float(np.ceil(spread)) if spread > 0.5 else 0.0)
            front = Facade(round(width, 2), height, plan.seed + house + 4 * part)
            start, end = ends if side > 0 else ends[::-1]
            top = float(self._low[before].min()) - self._foundation + height
            yield rectangle(front, (*start, top), (*(end - start), 0), DOWN, occludes=True)

    def _pieces(self, first: float, last: float, side: int) -> Iterator[tuple[float, float, int]]:
        """From where to where each house front reaches [m along the path], and its number where a house is bent."""
        zero, found = self._road.way[0], [first]
        for stretch in range(int((first - zero) // STRETCH), int((last - zero) // STRETCH) + 1):
            plan = self._plan(stretch, side)
            found += (zero + stretch * STRETCH + np.cumsum([0.0, *plan.widths[:-1]])).tolist()
        inside = [edge for edge in found if first + _NARROWEST < edge < last - _NARROWEST]
        for a, b in pairwise([first, *inside, last]):
            start, end = (self._road.left[np.abs(self._road.way - w).argmin()] for w in (a, b))
            parts = int(np.ceil(np.arccos(np.clip(start @ end, -1, 1)) / _BENT + 1e-9))
            cuts = np.linspace(a, b, parts + 1).tolist()
            yield from ((c, d, part) for part, (c, d) in enumerate(pairwise(cuts)))

    def _plan(self, stretch: int, side: int) -> Plan:
        """What stands on a side of a stretch."""
        return _plan(self._layout, min(stretch, int(self._stretch[-1])), side)

    def _ends(self) -> Iterator[Rectangle]:
        """House fronts across the road behind the start and beyond the end, unless other roads run there."""
        for row, to_left in ((0, 1), (-1, -1)):
            middle, left = self._road.xy[row], self._road.left[row]
            rows = self._tree.query_ball_point(middle, 2 * ASIDE)
            if np.abs(self._road.way[rows] - self._road.way[row]).max() <= 3 * ASIDE:
                plan = self._plan(int(self._stretch[row]), 1)
                front = Facade(2 * ASIDE, float(plan.heights[0]), plan.seed + 50 + row)
                start = middle - to_left * ASIDE * left
                top = float(self._low[row]) - self._foundation + front.height
                yield rectangle(front, (*start, top), (*(to_left * left), 0), DOWN, occludes=True)

    def beside(self, *kinds: str) -> Iterator[Rectangle]:
        """What stands at both sides: trees, switch cabinets or parked cars."""
        for what in kinds:
            for stretch in np.unique(self._stretch).tolist():
                for side in (1, -1):
                    plan = self._plan(stretch, side)
                    for number, along in enumerate(plan.beside[what].tolist()):
                        aside, size, material, seed = _BESIDE[what]
                        T = self._pose(self._road.way[0] + stretch * STRETCH + along, side, aside)
                        seed += plan.seed + number
                        if T is not None:
                            yield from car(T, seed) if what == "cars" else post(T, size, material, seed)

    def _pose(self, way: float, side: int, aside: float) -> Array | None:
        """Pose (4, 4) on the ground at a road's side, y along the traffic there; None where it would be in the way."""
        row = int(np.abs(self._road.way - way).argmin())
        if abs(self._road.way[row] - way) > STEP:
            return None
        left = self._road.left[row]
        along = np.array([left[1], -left[0]])
        xy = self._road.xy[row] + (way - self._road.way[row]) * along + side * aside * left
        ahead, behind = min(row + _AROUND, len(self._road.left) - 1), max(row - _AROUND, 0)
        bends = float(self._road.left[ahead] @ self._road.left[behind]) < 0.97  # by more than 15°
        if self._tree.query(xy)[0] < aside - 0.3 or self._drives.query(xy)[0] < _CLEAR or bends:
            return None
        heading = float(np.arctan2(-along[0], along[1])) + (np.pi if side > 0 else 0.0)
        return placed((*xy, self._low[row]), (heading, 0, 0))

    def ground(self) -> Iterator[Rectangle]:
        """Square parts of the ground under all roads, as high and as steep as the roads there."""
        around = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]) * ASIDE
        cells = np.unique(np.floor((self._road.xy[:, None] + around) / _TILE).reshape(-1, 2).astype(int), axis=0)
        corners = cells[:, None] + np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        used, which = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
        heights = np.array([self._height(xy) for xy in used * _TILE])[which].reshape(-1, 4)
        for number, (cell, h) in enumerate(zip(cells, heights)):
            slope_x, slope_y = (h[1] + h[3] - h[0] - h[2]) / (2 * _TILE), (h[2] + h[3] - h[0] - h[1]) / (2 * _TILE)
            edge = _TILE + 2 * _LAP * bool(np.ptp(h) > 0)  # it overlaps its neighbours a little
            xy = (cell + 0.5) * _TILE + np.array([-edge, edge]) / 2
            texture = Material(edge, edge, "asphalt", 100 * self._layout + number, 0.3, (0.05, 0.3))
            along, down = np.array([1, 0, slope_x]) * edge, np.array([0, -1, -slope_y]) * edge
            yield Rectangle(np.array([*xy, h.mean() + (slope_y - slope_x) * edge / 2]), along, down, texture)

    def _height(self, xy: Array) -> float:
        """Height of the ground at a place (2,) [m]: the mean of the roads around it, near ones count most."""
        rows = np.array(self._tree.query_ball_point(xy, 3 * _TILE))
        distance = np.linalg.norm(self._road.xy[rows] - xy, axis=1)
        weight = np.exp(-((distance / _SMOOTHED) ** 2) / 2) + 1e-9
        return float(weight @ self._low[rows] / weight.sum())
