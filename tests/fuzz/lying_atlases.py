"""Maps whose keyframes and loops fit together but are not true, and drives that close loops in them."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

import slam
from slam.geometry.se3 import Array, exp
from slam.geometry.trajectory import Trajectory
from slam.mapping.atlas.saved import from_arrays, to_arrays
from slam.mapping.map_io import SavedMap, decode, encode
from slam.sequences.base import Sequence
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.hostile import choose
from tests.slam.mapping.atlas.test_atlas import Odometry, system_for

_LAP, _AGAIN = 60, 14  # frames, 1 m apart
_SETTINGS = ("atlas.agreeing=1", "atlas.most_loops=2", "atlas.gate_sigmas=1e3", "atlas.on_disk=true")
_SCALED = (
    "loop_covariances", "keyframe_steps", "keyframe_covariances", "keyframe_depths", "keyframe_travelled",
    "place_points",
)  # fmt: skip
_PLACES = ("place_points", "place_descriptors", "place_laplacian", "place_landmarks")


@lru_cache(maxsize=1)
def _round() -> tuple[Sequence, SavedMap]:
    """A round in which a loop is closed, and its map."""
    step, poses = exp(np.array([0.0, 2 * np.pi / _LAP, 0.0, 0.0, 0.0, 1.0])), [np.eye(4)]
    for _ in range(_LAP + _AGAIN):
        poses.append(poses[-1] @ step)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "round.txt"
        Trajectory(0.1 * np.arange(len(poses)), np.array(poses)).write_tum(path)
        sequence = slam.open_sequence(f"synthetic:drive?path={path}&descriptor=16")
    system = system_for(sequence, Odometry(sequence.rig, sequence.ground_truth))
    for k in range(len(sequence)):
        system.process_features(sequence.observations(k))
    return sequence, system.snapshot()


def drive_in_a_lie(rng: np.random.Generator, folder: Path) -> None:
    """A map with false keyframes and loops, and a drive that begins anywhere in it."""
    sequence, known = _round()
    arrays = to_arrays(known.keyframes, known.keyframe_poses, known.loops)
    if not len(arrays["loop_inliers"]):
        raise Broken("no loop was closed in the map that is to be falsified")
    for _ in range(int(rng.integers(1, 4))):
        _falsify(rng, arrays)
    keyframes, poses, loops = from_arrays(arrays, (16,), "a.map")
    false = replace(known, keyframes=keyframes, keyframe_poses=poses, loops=loops)
    backend = choose(rng, ("ekf", "ekf", "smoother"))
    config = system_for(sequence, backend, (choose(rng, _SETTINGS),)).config
    system = slam.StereoSlam(sequence.rig, None, backend, config=config, prior_map=false)
    first = int(rng.integers(0, _LAP))
    for k in range(first, first + _AGAIN):
        result = system.process_features(sequence.observations(k))
        if result.status.value == "tracked":
            _require_sound(result.estimate.T_world_left, result.estimate.covariance)
    if not np.isfinite(system.trajectory().poses).all():
        raise Broken("a pose of the path is not finite")
    decode(encode(system.snapshot()), "a.map")


def _require_sound(T: Array, covariance: Array) -> None:
    """Raise where a pose is not finite or its covariance is no covariance."""
    if not (np.isfinite(T).all() and np.isfinite(covariance).all()):
        raise Broken("a pose is not finite")
    deviations = np.sqrt(np.diag(covariance))
    if np.linalg.eigvalsh(covariance / np.outer(deviations, deviations))[0] < -1e-9:
        raise Broken("a covariance is not positive definite")


def _falsify(rng: np.random.Generator, arrays: dict[str, np.ndarray]) -> None:
    """One of the arrays changed so that they still fit together."""
    kind, n = int(rng.integers(9)), len(arrays["keyframe_stamps"])
    if kind == 0:
        name = choose(rng, _SCALED)
        with np.errstate(over="ignore"):
            arrays[name] = (arrays[name] * choose(rng, (0, -1, *10.0 ** np.arange(-14, 12)))).astype(arrays[name].dtype)
    elif kind == 1:
        for motion in arrays["loop_motions"]:
            motion[:3, 3] += 10.0 ** rng.integers(-3, 7) * rng.standard_normal(3)
    elif kind == 2:
        for motion in arrays["loop_motions"]:
            motion[:] = motion @ exp(10.0 ** rng.integers(-3, 1) * rng.standard_normal(6))
    elif kind == 3:
        pairs = np.sort(rng.integers(0, n, (int(10 ** rng.uniform(0, 3)), 2)), axis=1)
        arrays["loop_pairs"] = pairs[pairs[:, 0] < pairs[:, 1]]
        rows = rng.integers(0, len(arrays["loop_inliers"]), len(arrays["loop_pairs"]))
        for name in ("loop_motions", "loop_covariances", "loop_inliers"):
            arrays[name] = arrays[name][rows] if len(arrays[name]) else arrays[name]
    elif kind == 4:
        arrays["keyframe_shares"] = 10.0 ** rng.integers(-3, 9) * rng.standard_normal((n, 6, int(rng.integers(30))))
    elif kind == 5:
        arrays["place_landmarks"][:] = choose(rng, (-1, 0, 5, 2**53))
    elif kind == 6:
        arrays["keyframe_poses"] = choose(rng, (np.tile(np.eye(4), (n, 1, 1)), arrays["keyframe_poses"][::-1].copy()))
    elif kind == 7:
        arrays["keyframe_features"][:] = 0
        arrays |= {name: arrays[name][:0] for name in _PLACES}
    else:
        arrays["place_descriptors"][:] = choose(rng, (0, 6e4, -6e4, 1e-4))


SUBJECTS = (
    Subject("lying atlases", "maps with false keyframes and loops, and drives in them", "sound results or one line",
            drive_in_a_lie, quiet=False, short=12),
)  # fmt: skip
