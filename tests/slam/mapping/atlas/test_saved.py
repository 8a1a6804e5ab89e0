"""Keyframes in the file of a map: all comes back, and what cannot be is refused in one line."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from slam.errors import SlamError
from slam.geometry.se3 import exp
from slam.mapping.atlas.atlas import Atlas
from slam.mapping.atlas.keyframes import Keyframe
from slam.mapping.atlas.saved import KEYFRAME_TYPES, from_arrays, to_arrays
from slam.mapping.map_io import SavedMap, decode, encode


def keyframe(seed: int) -> Keyframe:
    rng = np.random.default_rng(seed)
    count = 5 + seed
    points = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(2, 9, count)])
    P = np.diag(rng.uniform(1e-4, 1e-2, 6))
    return Keyframe(
        -1, float(seed), exp(rng.normal(size=6)), P, 0.1 * P, 2.0 * seed, float(np.median(points[:, 2])),
        points.astype(np.float32), rng.normal(size=(count, 16)).astype(np.float16),
        np.sign(rng.normal(size=count)).astype(np.int8), np.arange(-1, count - 1),
    )  # fmt: skip


KEYFRAMES = tuple(keyframe(seed) for seed in range(4))


def saved(keyframes: tuple[Keyframe, ...]) -> SavedMap:
    once = np.ones(1, np.int64)
    return SavedMap(
        0 * once, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 16), np.float32), once.astype(np.int8), once, once,
        keyframes=keyframes,
    )  # fmt: skip


@pytest.mark.parametrize("keyframes", [KEYFRAMES, ()])
def test_all_comes_back(keyframes: tuple[Keyframe, ...]):
    found = decode(encode(saved(keyframes)), "a.map").keyframes
    assert len(found) == len(keyframes)
    for one, other in zip(keyframes, found):
        for field in fields(Keyframe):
            np.testing.assert_allclose(getattr(one, field.name), getattr(other, field.name), atol=1e-12)
    assert encode(saved(found)) == encode(saved(keyframes))


def test_new_landmarks_get_ids_that_no_keyframe_has():
    assert saved(KEYFRAMES).next_id == 7
    assert saved(()).next_id == 1


def test_an_atlas_of_an_earlier_run_is_where_it_was():
    atlas = Atlas.of_earlier_run(KEYFRAMES)
    np.testing.assert_array_equal(atlas.positions(), [k.T_odom_left[:3, 3] for k in KEYFRAMES])
    assert all(k.frame == -1 for k in atlas.keyframes)
    assert atlas.summary() == {"keyframes": 4, "closed": 0, "refused": 0}


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
])  # fmt: skip
def test_what_cannot_be_is_refused(name: str, value: np.ndarray):
    arrays = to_arrays(KEYFRAMES)
    assert len(from_arrays(arrays, (16,), "a.map")) == 4
    with pytest.raises(SlamError, match=r"^a\.map: ") as error:
        from_arrays(arrays | {name: value.astype(KEYFRAME_TYPES[name])}, (16,), "a.map")
    assert "\n" not in str(error.value)
