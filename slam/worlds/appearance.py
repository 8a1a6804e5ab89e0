"""What tells landmarks apart: their descriptors, and how these change with noise and with the direction of view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.data import IdArray
from slam.geometry.se3 import Array
from slam.worlds.geometry import unit
from slam.worlds.world import World

_VISIT = 60.0  # landmarks that change do so after as long a time [s]
_POOL = 4096  # errors of descriptors that are drawn beforehand
_COMMON = 1.2  # what all descriptors have in common, over what is each one's own
_DIRECTIONS = 6.0  # each further direction of descriptors that drift varies less, by 1 / e over so many
_DRIFTING = 0.6  # share of the variance of descriptors that changes with the direction of view


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
        """Descriptors (N, D) of landmarks, with noise, not of unit length.

        Args:
            landmark: which ones (N,).
            views: unit vectors (N, 3) to the camera in axes along, down and out of their surfaces; where they drift.
            time: of the frame [s].
            rng: of the noise.
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
