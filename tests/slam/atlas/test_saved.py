"""Keyframes in the file of a map: all comes back, and what cannot be is refused in one line."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from slam.atlas.keyframes import Keyframe, Loop
from slam.atlas.map_io import SavedMap, decode, encode, map_arrays, map_of
from slam.errors import SlamError
from slam.geometry.se3 import exp


def keyframe(seed: int) -> Keyframe:
    rng = np.random.default_rng(seed)
    count = 5 + seed
    points = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(2, 9, count)])
    P = np.diag(rng.uniform(1e-4, 1e-2, 6))
    return Keyframe(
        -1, float(seed), exp(rng.normal(size=6)), P, 0.1 * P, rng.normal(size=(6, 3)), 2.0 * seed,
        float(np.median(points[:, 2])), points.astype(np.float32), rng.normal(size=(count, 16)).astype(np.float16),
        np.sign(rng.normal(size=count)).astype(np.int8), np.arange(-1, count - 1),
    )  # fmt: skip


KEYFRAMES = tuple(keyframe(seed) for seed in range(4))
POSES = np.array([exp(0.1 * np.full(6, k)) for k in range(4)])
LOOPS = (Loop(0, 2, exp(np.arange(6) / 9), np.eye(6), 20), Loop(1, 3, exp(np.arange(6) / 7), 2 * np.eye(6), 30))


def saved(keyframes: tuple[Keyframe, ...]) -> SavedMap:
    once = np.ones(1, np.int64)
    return SavedMap(
        0 * once, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 16), np.float32), once.astype(np.int8), once, once,
        keyframes=keyframes, keyframe_poses=POSES[: len(keyframes)], loops=LOOPS if keyframes else (),
    )  # fmt: skip


@pytest.mark.parametrize("keyframes", [KEYFRAMES, ()])
def test_all_comes_back(keyframes: tuple[Keyframe, ...]):
    read = decode(encode(saved(keyframes)), "a.map")
    found = read.keyframes
    assert len(found) == len(keyframes)
    np.testing.assert_array_equal(read.keyframe_poses, POSES[: len(keyframes)])
    for one, other in zip(keyframes, found):
        assert other.correction is None
        for field in fields(Keyframe)[:-1]:
            np.testing.assert_allclose(getattr(one, field.name), getattr(other, field.name), atol=1e-12)
    assert len(read.loops) == (2 if keyframes else 0)
    for loop, again in zip(LOOPS, read.loops):
        for field in fields(Loop):
            np.testing.assert_array_equal(getattr(loop, field.name), getattr(again, field.name))
    assert encode(saved(found)) == encode(saved(keyframes))


def test_new_landmarks_get_ids_that_no_keyframe_has():
    assert saved(KEYFRAMES).next_id == 7
    assert saved(()).next_id == 1


@pytest.mark.parametrize(("name", "value"), [
    ("keyframe_stamps", np.zeros(3)),
    ("keyframe_stamps", np.full(4, np.nan)),
    ("keyframe_poses", np.tile(2 * np.eye(4), (4, 1, 1))),
    ("keyframe_poses", np.full((4, 4, 4), 1e300)),
    ("keyframe_covariances", np.tile(-np.eye(6), (4, 1, 1))),
    ("keyframe_steps", np.tile(np.triu(np.ones((6, 6))), (4, 1, 1))),
    ("keyframe_depths", np.zeros(4)),
    ("keyframe_features", np.array([5, 6, 7, 9])),
    ("keyframe_features", np.array([-5, 16, 7, 8])),
    ("place_points", np.full((26, 3), np.inf, np.float32)),
    ("place_descriptors", np.zeros((26, 8), np.float16)),
    ("place_landmarks", np.full(26, -2)),
    ("keyframe_odometry", np.tile(2 * np.eye(4), (4, 1, 1))),
    ("keyframe_shares", np.zeros((4, 5, 3))),
    ("loop_pairs", np.array([[0, 2], [1, 4]])),
    ("loop_pairs", np.array([[0, 2], [3, 3]])),
    ("loop_inliers", np.zeros(3)),
    ("loop_covariances", np.zeros((2, 6, 6)) - np.eye(6)),
    ("loop_motions", np.zeros((2, 4, 4))),
])  # fmt: skip
def test_what_cannot_be_is_refused(name: str, value: np.ndarray):
    arrays = map_arrays(saved(KEYFRAMES))
    assert len(map_of(arrays, {}, "a.map").keyframes) == 4
    with pytest.raises(SlamError, match=r"^a\.map: ") as error:
        map_of(arrays | {name: value.astype(arrays[name].dtype)}, {}, "a.map")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["keyframe_covariances", "keyframe_poses", "loop_motions"])
def test_an_empty_atlas_has_nothing_but_empty_arrays(name: str):
    arrays = map_arrays(saved(()))
    assert map_of(arrays, {}, "a.map").keyframes == ()
    for value in (np.array(1.0), np.zeros((3, 0))):
        with pytest.raises(SlamError, match=f"a.map: {name}"):
            map_of(arrays | {name: value}, {}, "a.map")
