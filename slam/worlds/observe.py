"""Features straight from projected landmarks: no image, no front end; for Monte-Carlo runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.worlds.geometry import hidden, turned, unit
from slam.worlds.world import World

#: A surface seen at a smaller angle than this (cosine from its normal) shows no feature.
FACING = 0.25

_MARGIN = 2.0  # no feature so near to the image's border [px]
_SMALLEST = 9.0  # no feature is smaller: SURF's first filter [px]
_VISIT = 60.0  # landmarks that change do so after as long a time [s]
_POOL = 4096  # errors of descriptors that are drawn beforehand
_COMMON = 1.2  # what all descriptors have in common, over what is each one's own
_DIRECTIONS = 6.0  # each further direction of descriptors that drift varies less, by 1 / e over so many
_DRIFTING = 0.6  # share of the variance of descriptors that changes with the direction of view
_FALSE = -1


@dataclass(frozen=True, eq=False)
class SimulatedFeatures:
    """Features with their truth, a row each."""

    features: StereoFeatures  # what a front end would say
    ids: IdArray  # landmark of each feature (N,), −1 for false features
    objects: IdArray  # object of each feature (N,), 0 for the still world, −1 for false features
    false_stereo: BoolArray  # true features whose right pixel is false (N,)

    def without(self, all_rows: bool, right: bool) -> SimulatedFeatures:
        """What is left in a frame that shows nothing, or that has no `right` image."""
        keep, features = np.arange(0 if all_rows else len(self.ids)), self.features
        if right:
            features = replace(features, uv_right=np.full_like(features.uv_right, np.nan))
        return SimulatedFeatures(features.select(keep), self.ids[keep], self.objects[keep], self.false_stereo[keep])


@dataclass(frozen=True, eq=False)
class VisibleLandmarks:
    """Landmarks that can be seen in one frame, a row each."""

    ids: IdArray  # landmarks (M,)
    points: Array  # in left-camera coordinates (M, 3) [m]
    uv_left: Array  # left pixels (M, 2)
    uv_right: Array  # right pixels (M, 2), NaN where the right camera does not see it
    size: Array  # diameters in the left image (M,) [px]


def visible_landmarks(world: World, frame: int) -> VisibleLandmarks:
    """Landmarks within reach, inside the left image, on surfaces that face the camera and not hidden."""
    T = world.T_world_left[frame]
    bodies = world.T_world_body(frame)
    near = world.near(world.landmarks.positions, 0.0, world.landmarks.object, frame)
    landmarks = world.landmarks.select(near)
    positions = turned(landmarks.positions, landmarks.object, bodies) + bodies[landmarks.object, :3, 3]
    points = (positions - T[:3, 3]) @ T[:3, :3]
    rows = np.flatnonzero((points[:, 2] > world.reach[0]) & (points[:, 2] < world.reach[1]))
    offsets = positions[rows] - T[:3, 3]
    normals = turned(landmarks.normals[rows], landmarks.object[rows], bodies)
    facing = -(normals * offsets).sum(axis=1) > FACING * np.linalg.norm(offsets, axis=1)
    rows = rows[facing]
    uv_left, uv_right = world.rig.project(points[rows])
    inside = world.rig.left.in_image(uv_left, _MARGIN)
    rows, uv_left, uv_right = rows[inside], uv_left[inside], uv_right[inside]
    uv_right[~world.rig.right.in_image(uv_right, _MARGIN)] = np.nan
    every = world.occluders
    occluders = every.select(world.near(every.middle, every.radius, every.body, frame)).placed(bodies)
    if len(occluders):
        right_centre = T[:3, 3] - T[:3, :3] @ world.rig.b
        seen = ~hidden(T[:3, 3], positions[rows], occluders)
        rows, uv_left, uv_right = rows[seen], uv_left[seen], uv_right[seen]
        uv_right[hidden(right_centre, positions[rows], occluders)] = np.nan
    size = np.maximum(world.rig.left.fu * landmarks.size[rows] / points[rows, 2], _SMALLEST)
    return VisibleLandmarks(near[rows], points[rows], uv_left, uv_right, size)


def _views(world: World, frame: int, seen: VisibleLandmarks, source: IdArray) -> Array:
    """Unit vectors (N, 3) to the camera along, down and out of the landmarks' surfaces; zero for what is nothing.

    `source` are rows of `seen`, −1 for what is nothing.
    """
    views = np.zeros((len(source), 3))
    true = np.flatnonzero(source != _FALSE)
    ids = seen.ids[source[true]]
    surface, objects = world.landmarks.surface[ids], world.landmarks.object[ids]
    bodies = world.T_world_body(frame)
    to_camera = -seen.points[source[true]] @ world.T_world_left[frame, :3, :3].T
    arrays = world.arrays
    axes = (arrays.along[surface], arrays.down[surface], arrays.normal[surface])
    columns = [(unit(turned(axis, objects, bodies)) * to_camera).sum(axis=1) for axis in axes]
    views[true] = unit(np.stack(columns, axis=1))
    return views


def simulate(
    world: World, appearance: Appearance, values: Mapping[str, Any], frame: int, stamp: float, rng: np.random.Generator
) -> SimulatedFeatures:
    """Features of one frame, in random order, by the values of the options.

    The noise is isotropic on uL, vL and uR; vR follows from the epipolar geometry of the three, so that the noisy
    rays meet. A feature that noise takes out of the left image is not detected.
    """
    rig, seen = world.rig, visible_landmarks(world, frame)
    chance = rng.random((len(seen.ids), 3))
    rows = np.flatnonzero(chance[:, 0] < values["detect"])
    matched = np.isfinite(seen.uv_right[rows, 0]) & (chance[rows, 1] < values["stereo"])
    noise = values["sigma"] * rng.standard_normal((len(rows), 3))
    uv_left = seen.uv_left[rows] + noise[:, :2]
    uv_right = np.full_like(uv_left, np.nan)
    uv_right[matched] = _on_epipolar_line(rig, uv_left[matched], seen.uv_right[rows[matched]], noise[matched])
    false_stereo = matched & (chance[rows, 2] < values["outliers"] / 2)
    if false_stereo.any():  # somewhere near the left pixel's line
        uv_right[false_stereo, 0] = rng.uniform(0, np.maximum(uv_left[false_stereo, 0], 1.0))
        uv_right[false_stereo, 1] += rng.normal(0, 0.5, false_stereo.sum())
    others = [
        _false_pixels(rig, round(len(rows) * values["outliers"] / (1 - values["outliers"])), rng),
        _clutter(rig, seen, round(len(rows) * values["clutter"] / (1 - values["clutter"])), rng),
    ]
    uv_left, uv_right = (np.concatenate([own, *(o[i] for o in others)]) for i, own in enumerate((uv_left, uv_right)))
    uv_right[~rig.right.in_image(uv_right)] = np.nan
    order = rng.permutation(len(uv_left))
    order = order[rig.left.in_image(uv_left[order])]
    false = len(uv_left) - len(rows)
    source = np.concatenate([rows, np.full(false, _FALSE)])[order]
    false_stereo = np.concatenate([false_stereo, np.zeros(false, bool)])[order]
    ids, size = np.append(seen.ids, _FALSE)[source], np.append(seen.size, 12.0)[source]  # row −1 is the last one
    nothing = np.flatnonzero(ids == _FALSE)
    landmark = ids.copy()
    landmark[nothing] = rng.integers(0, max(len(world.landmarks), 1), len(nothing))
    views = _views(world, frame, seen, source) if appearance.drifting else None
    descriptors = appearance.describe(landmark, views, float(world.stamps[frame]), rng)
    descriptors[nothing] = appearance.of_nothing(len(nothing), rng)
    objects = world.landmarks.object[landmark]
    objects[nothing] = _FALSE
    features = StereoFeatures(
        stamp, uv_left[order], uv_right[order], size, np.zeros(len(ids)), appearance.response[landmark],
        appearance.laplacian[landmark], unit(descriptors),
    )  # fmt: skip
    return SimulatedFeatures(features, ids, objects, false_stereo)


def _on_epipolar_line(rig: StereoRig, uv_left: Array, uv_right: Array, noise: Array) -> Array:
    """Right pixels (M, 2) whose x is the true one and its noise, and whose y lies on the noisy left pixel's line.

    They are the projection of the point that is seen at exactly the noisy uL, vL and uR.
    """
    if rig.is_rectified:
        return np.stack([uv_right[:, 0] + noise[:, 2], uv_left[:, 1]], axis=1)
    found = np.column_stack([uv_right[:, 0] + noise[:, 2], uv_right[:, 1]])
    for _ in range(6):  # by a lens the depth depends on the row a little
        row = rig.project(rig.triangulate(uv_left, found))[1][:, 1]
        found[:, 1] = np.where(np.isfinite(row), row, uv_left[:, 1])
    return found


def _false_pixels(rig: StereoRig, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Left and right pixels of features that are nothing; half of them have a match."""
    uv_left = rng.random((count, 2)) * (rig.width - 1, rig.height - 1)
    uv_right = np.stack([uv_left[:, 0] * rng.random(count), uv_left[:, 1] + rng.normal(0, 1, count)], axis=1)
    uv_right[rng.random(count) < 0.5] = np.nan
    return uv_left, uv_right


def _clutter(rig: StereoRig, seen: VisibleLandmarks, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Left and right pixels (count, 2) of points near visible landmarks that are features in this frame alone."""
    if not count:
        return np.zeros((0, 2)), np.zeros((0, 2))
    rows = rng.integers(0, len(seen.ids), count)
    points = seen.points[rows] * (1 + 0.05 * rng.standard_normal((count, 1)))
    points[:, :2] += 0.03 * points[:, 2:] * rng.standard_normal((count, 2))
    return rig.project(points)


@dataclass(frozen=True, eq=False)
class Appearance:
    """What tells landmarks apart."""

    descriptors: NDArray[np.float32]  # what does not change with the direction of view (P, D); unit without drift
    laplacian: NDArray[np.int8]  # sign (P,)
    response: Array  # strength (P,)
    phase: IdArray  # where in its changes with the direction of view each one is, a whole number (P,)
    errors: NDArray[np.float32]  # a pool of errors of descriptors (E, D), of which every feature gets one
    common: Array  # mean of all descriptors (D,)
    spread: Array  # standard deviations of each one's own part (D,)
    waves: NDArray[np.float32]  # a pool of changes with the direction of view (E, 3, D); none without drift
    directions: Array  # along which that matters for each of the three, and how much (E, 3, 3) [rad/rad]
    change: float  # share of landmarks that look different when the camera comes back

    @property
    def drifting(self) -> bool:
        """Whether descriptors change with the direction of view."""
        return len(self.waves) > 0

    def describe(
        self, landmark: IdArray, views: Array | None, time: float, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Descriptors (N, D) of landmarks at a time [s], with noise, not of unit length.

        Where they drift, `views` are unit vectors (N, 3) to the camera in axes along, down and out of their surfaces.
        """
        visit = self._visit(landmark, time) if self.change > 0 else None
        like = landmark
        if visit is not None:
            changed = visit % 10_000 < 10_000 * (1 - np.sqrt(1 - self.change))  # at each of two visits
            like = np.where(changed, visit // 10_000 % len(self.descriptors), landmark)
        clean = self.descriptors[like]
        if views is not None:
            phase = self.phase[like]
            seen = np.einsum("nij,nj->ni", self.directions[phase % _POOL], views)
            swing = np.sin(seen + phase[:, None]).astype(np.float32)
            clean = unit(clean + np.einsum("ni,nid->nd", swing, self.waves[phase % _POOL]))
        if visit is not None:
            clean = clean + self.errors[visit % _POOL]
        return clean + self.errors[rng.integers(0, _POOL, len(landmark))]

    def _visit(self, landmark: IdArray, time: float) -> IdArray:
        """Numbers (N,) drawn again for each landmark about once a minute, each at a time of its own."""
        own = landmark.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        minute = (time / _VISIT + (own >> np.uint64(40)).astype(float) / 2**24).astype(np.uint64)
        mixed = (own ^ (minute * np.uint64(0xC2B2AE3D27D4EB4F))) * np.uint64(0xFF51AFD7ED558CCD)
        return (mixed >> np.uint64(20)).astype(np.int64)

    def of_nothing(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Descriptors (count, D) of features that are no landmarks."""
        own = rng.standard_normal((count, len(self.common)), np.float32)
        return (self.common + own * self.spread).astype(np.float32) if self.drifting else own


def appearance(world: World, values: Mapping[str, Any]) -> Appearance:
    """Descriptors of all landmarks, by the values of the options.

    Unit descriptors about 0.9 apart on average, as SURF's are; a share `confusion` of the landmarks is but 0.15 away
    from another one. Those that drift are as far apart as SURF's on a drive through a town: also the nearest of some
    hundred ones, for which they vary less in some directions than in others.
    """
    rng = np.random.default_rng([values["layout"], 11])
    count, size = len(world.landmarks), values["descriptor"]
    drifts = values["descriptor_drift"] > 0
    common = rng.standard_normal(size)
    common *= _COMMON / np.linalg.norm(common)
    spread = np.exp(-np.arange(size) / _DIRECTIONS) if drifts else np.ones(size)
    spread /= np.linalg.norm(spread)
    own = rng.standard_normal((count, size))
    descriptors = common + np.sqrt(1 - _DRIFTING) * spread * own if drifts else unit(common + unit(own))
    phase = np.arange(count)
    twins = np.flatnonzero(rng.random(count) < values["confusion"])
    if count > 1:
        originals = (twins + rng.integers(1, count, len(twins))) % count
        near = descriptors[originals] + 0.15 * unit(rng.standard_normal((len(twins), size)))
        descriptors[twins] = near if drifts else unit(near)
        phase[twins] = originals
    laplacian = np.where(rng.random(count) < 0.5, 1, -1).astype(np.int8)
    errors = rng.standard_normal((_POOL, size)) * (values["descriptor_noise"] / np.sqrt(size))
    response = np.exp(rng.normal(6.5, 1.0, count))
    waves, directions = np.zeros((0, 3, size)), np.zeros((0, 3, 3))
    if drifts:
        # The pace of the waves [rad/rad] whose sum changes a descriptor by the drift per radian, while that is little.
        pace = values["descriptor_drift"] * np.sqrt((_COMMON**2 + 1) / _DRIFTING)
        directions = float(pace) * rng.standard_normal((_POOL, 3, 3))
        waves = rng.standard_normal((_POOL, 3, size)) * (spread * np.sqrt(_DRIFTING * 2 / 3))
    looks = world.landmarks.looks
    return Appearance(
        descriptors[looks].astype(np.float32), laplacian[looks], response[looks], phase[looks],
        errors.astype(np.float32), common, spread, waves.astype(np.float32), directions, values["change"],
    )  # fmt: skip
