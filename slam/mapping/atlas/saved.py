"""Keyframes as arrays for a file, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from slam.checks import FARTHEST_POSITION, MOST_ID
from slam.errors import SlamError
from slam.geometry.se3 import nearest_rotation
from slam.mapping.atlas.keyframes import Keyframe

#: Arrays of a file: numbers of each keyframe (K,), then features, those of one keyframe after those of another.
KEYFRAME_TYPES = {
    "keyframe_stamps": np.float64, "keyframe_poses": np.float64, "keyframe_covariances": np.float64,
    "keyframe_steps": np.float64, "keyframe_travelled": np.float64, "keyframe_depths": np.float64,
    "keyframe_features": np.int64, "place_points": np.float32, "place_descriptors": np.float16,
    "place_laplacian": np.int8, "place_landmarks": np.int64,
}  # fmt: skip

_LARGEST = 1e12  # entry of a covariance [rad², m²]
_TURNED = 1e-6  # by which a rotation matrix may be none


def to_arrays(keyframes: Sequence[Keyframe]) -> dict[str, np.ndarray]:
    """The arrays of keyframes, see `KEYFRAME_TYPES`."""
    k = keyframes
    columns = [
        [f.stamp for f in k], [f.T_odom_left for f in k], [f.covariance for f in k], [f.step_covariance for f in k],
        [f.travelled for f in k], [f.depth for f in k], [len(f) for f in k],
    ]  # fmt: skip
    shapes = [(-1,), (-1, 4, 4), (-1, 6, 6), (-1, 6, 6), (-1,), (-1,), (-1,)]
    numbers = [np.array(column, float).reshape(shape) for column, shape in zip(columns, shapes)]
    width = k[0].descriptors.shape[1] if k else 0
    none = [np.zeros((0, 3)), np.zeros((0, width)), np.zeros(0), np.zeros(0)]
    names = ("points", "descriptors", "laplacian", "landmarks")
    parts = [np.concatenate([empty, *(getattr(f, name) for f in k)]) for name, empty in zip(names, none)]
    return {name: a.astype(kind) for (name, kind), a in zip(KEYFRAME_TYPES.items(), [*numbers, *parts])}


def from_arrays(arrays: Mapping[str, np.ndarray], width: tuple[int, ...], source: str) -> tuple[Keyframe, ...]:
    """The keyframes of arrays.

    Args:
        arrays: by the names of `KEYFRAME_TYPES`, of these types.
        width: length of the descriptors of the map that they belong to (1,).
        source: where they were read from, for messages.

    Raises:
        SlamError: the arrays do not fit together, or a value is impossible.
    """
    stamps, poses, covariances, steps, travelled, depths, count, points, descriptors, laplacian, landmarks = (
        arrays[name] for name in KEYFRAME_TYPES
    )
    n, total = len(stamps) if stamps.ndim else -1, int(count.sum()) if count.ndim == 1 else -1
    shapes = [(n,), (n, 4, 4), (n, 6, 6), (n, 6, 6), (n,), (n,), (n,), (total, 3), (total, *width), (total,), (total,)]
    if [a.shape for a in arrays.values()] != shapes and not (n == total == 0):
        raise SlamError(f"{source}: the arrays of the keyframes do not fit together")
    if (count < 0).any() or (landmarks < -1).any() or (landmarks > MOST_ID).any():
        raise SlamError(f"{source}: a keyframe has an impossible number")
    limits = [_LARGEST, FARTHEST_POSITION, _LARGEST, _LARGEST, FARTHEST_POSITION, FARTHEST_POSITION]
    for name, limit in zip(KEYFRAME_TYPES, limits):
        if not (np.abs(arrays[name]) <= limit).all():
            raise SlamError(f"{source}: {name} is not finite, or far too large")
    if not (np.abs(points) <= FARTHEST_POSITION).all() or not np.isfinite(descriptors).all() or (depths <= 0).any():
        raise SlamError(f"{source}: a feature of a keyframe is not finite, or far too large")
    if any(_no_covariance(P) for P in (*covariances, *steps)):
        raise SlamError(f"{source}: the covariance of a keyframe is none")
    if any(np.abs(nearest_rotation(T[:3, :3]) - T[:3, :3]).max() > _TURNED for T in poses):
        raise SlamError(f"{source}: the pose of a keyframe is none")
    begin = np.concatenate([[0], np.cumsum(count)]).astype(int)
    parts = [slice(a, b) for a, b in pairwise(begin)]
    return tuple(
        Keyframe(
            -1, float(stamps[i]), poses[i], covariances[i], steps[i], float(travelled[i]),
            float(depths[i]), points[s], descriptors[s], laplacian[s], landmarks[s],
        )
        for i, s in enumerate(parts)
    )  # fmt: skip


def _no_covariance(P: np.ndarray) -> bool:
    """Whether a matrix (6, 6) is not symmetric, or has a negative eigenvalue beyond rounding."""
    largest = np.abs(P).max()
    return bool(np.abs(P - P.T).max() > 1e-6 * largest or np.linalg.eigvalsh(P).min() < -1e-6 * largest)
