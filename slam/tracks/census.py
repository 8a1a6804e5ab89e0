"""The pass over all landmarks after a frame: which were seen or missed, and which have no place in the map any longer.

A landmark should have been detected if it lies inside the image by a margin, in a view similar to that of its first
sight, and is not hidden: most of the features around it are not clearly nearer than it is.

A landmark has no place in the map if it

- duplicates another one in view that was seen more often, or as often and is older. A feature's depth may differ from a
  landmark's by stereo's uncertainty, else their points have to be the same;
- is not continuously detected although in view (paper A, IV): missed too often in a row, seen in too small a share of
  the frames, or never confirmed; or was not seen for longer than a map remembers. Where no feature could take its
  place, it stays. Those of a loaded map stay until this run has seen them;
- has just gone out of view, and another landmark out of view was seen more often, see `MapConfig.spacing`; or is that
  other one. Those of a loaded map that this run has not seen yet are only such others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.chi_square import SIGMAS
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.arrays import Array
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import inverse, transform
from slam.runtime.compilation import helper, kernel
from slam.tracks.config import MapConfig
from slam.tracks.follow import first_column
from slam.tracks.table import LandmarkTable

_SAME_PIXELS = 6.0  # landmarks further apart in the image than this [px] are not the same


class MapView(NamedTuple):
    """The map and the frame's features as seen from one pose."""

    positions: Array  # of the landmarks (N, 3) in world coordinates [m]
    local: Array  # the same in left-camera coordinates (N, 3)
    uv_left: Array  # the landmarks' left pixels (N, 2), NaN behind the camera
    in_image: BoolArray  # which landmarks are in front of the camera and inside the left image (N,)
    points: Array  # the features in left-camera coordinates (F, 3), NaN without depth
    depth_sigma: Array  # standard deviations of the features' depths (F,) [m]


def view_from(
    rig: StereoRig, T_world_left: Array, positions: Array, features: StereoFeatures, pixel_sigma: float
) -> MapView:
    """Landmarks at `positions` (N, 3) and features, seen from a pose (4, 4)."""
    local = transform(inverse(T_world_left), positions)
    uv = rig.left.project(local)
    points = rig.triangulate(features.uv_left, features.uv_right)
    return MapView(positions, local, uv, rig.left.in_image(uv), points, rig.depth_deviation(points, pixel_sigma))


def take_census(
    table: LandmarkTable, rows: IndexArray, view: MapView, expected: BoolArray, measured: BoolArray,
    withheld: BoolArray, frame: int, features: StereoFeatures, rig: StereoRig, config: MapConfig,
) -> tuple[BoolArray, BoolArray]:  # fmt: skip
    """Count a frame for the landmarks at `rows` (N,), in place; which of them go, and which features (F,) are of one.

    `expected` (N,) says which can be expected in the frame, unless they are hidden or near the border; `measured` (N,)
    which were measured, and `withheld` (N,) which were kept from the update: for these the frame counts as neither
    missed nor seen.
    """
    t, c, f = table, config, features
    order = np.argsort(f.uv_left[:, 0], kind="stable")
    counts = t.seen, t.in_view, t.missed, t.last_seen, t.out_of_view, t.unseen
    seen = np.ascontiguousarray(f.uv_left), f.descriptors, f.laplacian, order
    size = float(rig.left.width), float(rig.left.height)
    limits = c.view_margin, c.occlusion_radius, c.same_distance, c.same_descriptor
    replaceable = bool(f.has_stereo.any() or not len(f))
    kept = c.erase_missed, c.erase_share, c.confirmed, c.forget_after, float(c.spacing)
    return _census(
        rows, counts, t.seen_from, t.descriptors, t.laplacian, tuple(view), expected, measured, withheld, frame, seen,
        size, limits, replaceable, kept,
    )  # fmt: skip


@kernel
def _census(
    rows, counts, seen_from, looks, signs, view, expected, measured, withheld, frame, features, size, limits,
    replaceable, kept,
):  # fmt: skip
    """`take_census`, of columns of the table and of the features; `limits` and `kept` are settings."""
    positions, local, uv, in_image, points, sigma = view
    feature_uv, feature_looks, feature_signs, order = features
    margin, radius, same_distance, same_look = limits
    _count(rows, counts, view, expected, measured, withheld, frame, feature_uv, order, size, margin, radius)
    seen, newest = counts[0], 0
    going, known = np.zeros(len(rows), np.bool_), np.zeros(len(feature_uv), np.bool_)
    for n in range(len(rows)):
        row = rows[n]
        newest = max(newest, counts[3][row])
        if not in_image[n]:
            continue
        for other in range(len(rows)):
            if (
                in_image[other] and gives_way(seen, rows, n, other)
                and abs(uv[n, 0] - uv[other, 0]) <= _SAME_PIXELS and abs(uv[n, 1] - uv[other, 1]) <= _SAME_PIXELS
                and distance(local[n], local[other]) < same_distance
                and signs[row] == signs[rows[other]] and distance(looks[row], looks[rows[other]]) < same_look
            ):  # fmt: skip
                going[n] = True
                break
        place = first_column(feature_uv, order, uv[n, 0] - _SAME_PIXELS)
        while place < len(order) and feature_uv[order[place], 0] <= uv[n, 0] + _SAME_PIXELS:
            f = order[place]
            place += 1
            if abs(feature_uv[f, 1] - uv[n, 1]) <= _SAME_PIXELS and feature_signs[f] == signs[row] and not known[f]:
                same = abs(points[f, 2] - local[n, 2]) < SIGMAS * sigma[f]
                same = same or distance(points[f], local[n]) < same_distance
                known[f] = same and distance(feature_looks[f], looks[row]) < same_look
    for n in range(len(rows)):
        going[n] = going[n] or (replaceable and _undetected(counts, rows[n], newest, kept))
    _thin_out(rows, counts, seen_from, positions, kept[0], kept[4], going)
    return going, known


@helper
def gives_way(seen, rows, one, other):
    """Whether of two landmarks the one goes: it was seen less, or as often and is younger."""
    return seen[rows[one]] < seen[rows[other]] or (seen[rows[one]] == seen[rows[other]] and one > other)


@helper
def distance(a, b):
    """Of two vectors."""
    total = (a[0] - b[0]) * (a[0] - b[0])
    for i in range(1, len(a)):
        total += (a[i] - b[i]) * (a[i] - b[i])
    return np.sqrt(total)


@helper
def _count(rows, counts, view, expected, measured, withheld, frame, feature_uv, order, size, margin, radius):
    """Count a frame in the columns of the table."""
    seen, in_view, missed, last_seen, out_of_view, unseen = counts
    _, local, uv, in_image, points, sigma = view
    any_measured = False
    for n in range(len(rows)):
        any_measured = any_measured or measured[n]
    for n in range(len(rows)):
        row, shown = rows[n], expected[n] and in_image[n] and not withheld[n]
        shown = shown and margin <= uv[n, 0] <= size[0] - 1 - margin and margin <= uv[n, 1] <= size[1] - 1 - margin
        shown = shown and not _hidden(uv[n], local[n, 2], radius, feature_uv, order, points, sigma)
        in_view[row] += shown or measured[n]
        missed[row] += shown
        out_of_view[row] += not in_image[n]
        unseen[row] += any_measured and not withheld[n]
        if measured[n]:
            seen[row] += 1
            last_seen[row] = frame
            missed[row] = out_of_view[row] = unseen[row] = 0


@helper
def _hidden(uv, depth, radius, feature_uv, order, points, sigma):
    """Whether most of the features around a landmark's pixel are clearly nearer than it is."""
    near, nearer = 0, 0
    place = first_column(feature_uv, order, uv[0] - radius)
    while place < len(order) and feature_uv[order[place], 0] <= uv[0] + radius:
        f = order[place]
        place += 1
        if abs(feature_uv[f, 1] - uv[1]) <= radius and np.isfinite(sigma[f]):
            near += 1
            # 0.9: a surface nearer than this share of a landmark's depth may hide it
            nearer += points[f, 2] + SIGMAS * sigma[f] < 0.9 * depth
    return radius > 0 and 2 * nearer > near


@helper
def _undetected(counts, row, newest, kept):
    """Whether a landmark is not continuously detected although in view, or forgotten."""
    seen, in_view, missed, last_seen, _, unseen = counts
    erase_missed, share, confirmed, forget_after, _ = kept
    rare = in_view[row] > erase_missed and seen[row] < share * in_view[row]
    unconfirmed = seen[row] < confirmed and unseen[row] > erase_missed and last_seen[row] >= 0
    forgotten = forget_after > 0 and newest - last_seen[row] > forget_after
    return missed[row] >= erase_missed or rare or unconfirmed or forgotten


@helper
def _thin_out(rows, counts, seen_from, positions, erase_missed, spacing, going):
    """Mark in `going` (N,) which landmarks out of view are redundant."""
    seen, _, _, last_seen, _, unseen = counts
    gone, reach = np.zeros(len(rows), np.bool_), np.zeros(len(rows))
    for n in range(len(rows)):
        gone[n] = unseen[rows[n]] > erase_missed and np.isfinite(seen_from[rows[n], 0])
        reach[n] = spacing * distance(positions[n], seen_from[rows[n]])
    for n in range(len(rows)):
        if not (gone[n] and unseen[rows[n]] <= 2 * erase_missed and last_seen[rows[n]] >= 0):
            continue
        for other in range(len(rows)):
            if gone[other] and other != n and distance(positions[n], positions[other]) < min(reach[n], reach[other]):
                going[n if gives_way(seen, rows, n, other) else other] = True
