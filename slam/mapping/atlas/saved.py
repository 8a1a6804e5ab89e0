"""Keyframes and loops as arrays for a file, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from slam.checks import FARTHEST_POSITION, MOST_ID
from slam.errors import SlamError
from slam.geometry.se3 import Array, nearest_rotation
from slam.mapping.atlas.keyframes import Keyframe, Loop

#: Arrays of a file: scalars, poses and covariances by keyframe, features of all keyframes in succession, and loops.
ATLAS_TYPES = {
    "keyframe_stamps": np.float64, "keyframe_poses": np.float64, "keyframe_odometry": np.float64,
    "keyframe_covariances": np.float64, "keyframe_steps": np.float64, "keyframe_shares": np.float64,
    "keyframe_travelled": np.float64, "keyframe_depths": np.float64, "keyframe_features": np.int64,
    "place_points": np.float32, "place_descriptors": np.float16, "place_laplacian": np.int8,
    "place_landmarks": np.int64,
    "loop_pairs": np.int64, "loop_motions": np.float64, "loop_covariances": np.float64, "loop_inliers": np.int64,
}  # fmt: skip

_LARGEST = 1e12  # guard: entry of a covariance [rad², m²]
_TURNED = 1e-6  # guard: largest deviation from a rotation matrix
_LIMITS = {
    "keyframe_stamps": _LARGEST, "keyframe_poses": FARTHEST_POSITION, "keyframe_odometry": FARTHEST_POSITION,
    "keyframe_covariances": _LARGEST, "keyframe_steps": _LARGEST, "keyframe_shares": _LARGEST,
    "keyframe_travelled": FARTHEST_POSITION, "keyframe_depths": FARTHEST_POSITION, "place_points": FARTHEST_POSITION,
    "place_descriptors": np.float16(65504), "loop_motions": FARTHEST_POSITION, "loop_covariances": _LARGEST,
}  # fmt: skip


def to_arrays(keyframes: Sequence[Keyframe], poses: Array, loops: Sequence[Loop]) -> dict[str, np.ndarray]:
    """Keyframes, their poses in the map (K, 4, 4), and loops as arrays, see `ATLAS_TYPES`."""
    k = keyframes
    m = max((f.jacobian.shape[1] for f in k), default=0)
    shares = [f.jacobian if f.jacobian.shape[1] == m else np.zeros((6, m)) for f in k]
    columns = [
        [f.stamp for f in k], poses, [f.T_odom_left for f in k], [f.covariance for f in k],
        [f.step_covariance for f in k], shares, [f.travelled for f in k], [f.depth for f in k], [len(f) for f in k],
    ]  # fmt: skip
    shapes = [(), (4, 4), (4, 4), (6, 6), (6, 6), (6, m), (), (), ()]
    numbers = [np.array(column, float).reshape(len(k), *shape) for column, shape in zip(columns, shapes)]
    width = k[0].descriptors.shape[1] if k else 0
    none = [np.zeros((0, 3)), np.zeros((0, width)), np.zeros(0), np.zeros(0)]
    names = ("points", "descriptors", "laplacian", "landmarks")
    parts = [np.concatenate([empty, *(getattr(f, name) for f in k)]) for name, empty in zip(names, none)]
    n = len(loops)
    returns = [
        np.array([(x.first, x.second) for x in loops]).reshape(n, 2),
        np.array([x.T_first_second for x in loops]).reshape(n, 4, 4),
        np.array([x.covariance for x in loops]).reshape(n, 6, 6),
        np.array([x.inliers for x in loops]),
    ]
    return {name: a.astype(kind) for (name, kind), a in zip(ATLAS_TYPES.items(), [*numbers, *parts, *returns])}


def from_arrays(
    arrays: Mapping[str, np.ndarray], width: tuple[int, ...], source: str
) -> tuple[tuple[Keyframe, ...], Array, tuple[Loop, ...]]:
    """Keyframes, their poses in the map (K, 4, 4), and loops from arrays.

    Args:
        arrays: with the names and types of `ATLAS_TYPES`.
        width: length of the map's descriptors (1,).
        source: where they were read from, for messages.

    Raises:
        SlamError: the arrays do not fit together, or a value is impossible.
    """
    _require_fit(arrays, width, source)
    _require_possible(arrays, source)
    a = arrays
    begin = np.concatenate([[0], np.cumsum(a["keyframe_features"])]).astype(int)
    keyframes = tuple(
        Keyframe(
            -1, float(a["keyframe_stamps"][i]), a["keyframe_odometry"][i], a["keyframe_covariances"][i],
            a["keyframe_steps"][i], a["keyframe_shares"][i], float(a["keyframe_travelled"][i]),
            float(a["keyframe_depths"][i]), a["place_points"][s], a["place_descriptors"][s], a["place_laplacian"][s],
            a["place_landmarks"][s],
        )
        for i, s in enumerate(slice(x, y) for x, y in pairwise(begin))
    )  # fmt: skip
    loops = tuple(
        Loop(first, second, motion, covariance, inliers)
        for (first, second), motion, covariance, inliers in zip(
            a["loop_pairs"].tolist(), a["loop_motions"], a["loop_covariances"], a["loop_inliers"].tolist()
        )
    )
    return keyframes, a["keyframe_poses"], loops


def _require_fit(arrays: Mapping[str, np.ndarray], width: tuple[int, ...], source: str) -> None:
    """Raise SlamError where shapes do not fit together."""
    stamps, count, shares = (arrays[f"keyframe_{name}"] for name in ("stamps", "features", "shares"))
    n, total = len(stamps) if stamps.ndim else -1, int(count.sum()) if count.ndim == 1 else -1
    m, number = shares.shape[-1] if shares.ndim else -1, arrays["loop_inliers"].size
    shapes = [
        (n,), (n, 4, 4), (n, 4, 4), (n, 6, 6), (n, 6, 6), (n, 6, m), (n,), (n,), (n,),
        (total, 3), (total, *width), (total,), (total,), (number, 2), (number, 4, 4), (number, 6, 6), (number,),
    ]  # fmt: skip
    found = [arrays[name].shape for name in ATLAS_TYPES]
    empty = total == 0 and all(shape and shape[0] == 0 for shape in found)
    if found != shapes and not empty:
        raise SlamError(f"{source}: the arrays of the keyframes do not fit together")
    pairs = arrays["loop_pairs"].reshape(-1, 2)
    if (pairs < 0).any() or (pairs >= n).any() or (pairs[:, 0] >= pairs[:, 1]).any():
        raise SlamError(f"{source}: a loop is between keyframes that there are not")


def _require_possible(arrays: Mapping[str, np.ndarray], source: str) -> None:
    """Raise SlamError where a value is impossible."""
    landmarks, inliers = arrays["place_landmarks"], arrays["loop_inliers"]
    if (arrays["keyframe_features"] < 0).any() or (inliers < 0).any():
        raise SlamError(f"{source}: a keyframe or a loop has an impossible number")
    if (landmarks < -1).any() or (landmarks > MOST_ID).any():
        raise SlamError(f"{source}: a keyframe has an impossible landmark")
    for name, limit in _LIMITS.items():
        if not (np.abs(arrays[name]) <= limit).all():
            raise SlamError(f"{source}: {name} is not finite, or far too large")
    if (arrays["keyframe_depths"] <= 0).any():
        raise SlamError(f"{source}: a keyframe has features behind the camera")
    for name in ("keyframe_covariances", "keyframe_steps", "loop_covariances"):
        if any(_no_covariance(P) for P in arrays[name]):
            raise SlamError(f"{source}: {name} holds what is no covariance")
    for name in ("keyframe_poses", "keyframe_odometry", "loop_motions"):
        if any(np.abs(nearest_rotation(T[:3, :3]) - T[:3, :3]).max() > _TURNED for T in arrays[name]):
            raise SlamError(f"{source}: {name} holds what is no pose")


def _no_covariance(P: np.ndarray) -> bool:
    """Whether a matrix (6, 6) is not symmetric, or has a negative eigenvalue beyond rounding."""
    largest = np.abs(P).max()
    return bool(np.abs(P - P.T).max() > 1e-6 * largest or np.linalg.eigvalsh(P).min() < -1e-6 * largest)
