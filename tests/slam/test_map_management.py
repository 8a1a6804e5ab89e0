from __future__ import annotations

import numpy as np
import pytest

from slam.data import StereoFeatures
from slam.errors import ConfigurationError
from slam.landmarks import LandmarkRows
from slam.map_management import MapConfig, bad_landmarks, new_landmarks, surplus_landmarks
from tests.slam.scene import RIG

CONFIG = MapConfig(target_in_view=20, separation=5.0)


def features_at(uv, depth=3.0, response=None):
    uv = np.asarray(uv, float)
    n = len(uv)
    right = uv - [RIG.left.fu * RIG.baseline / depth, 0]
    d = np.eye(16, dtype=np.float32)[np.arange(n) % 16]
    response = np.ones(n) if response is None else np.asarray(response, float)
    return StereoFeatures(0.0, uv, right, np.ones(n), np.zeros(n), response, np.ones(n, np.int8), d)


def chosen(features, occupied=(), config=CONFIG, free=None):
    free = np.ones(len(features), bool) if free is None else free
    return new_landmarks(features, free, np.asarray(occupied, float).reshape(-1, 2), RIG, 1.0, config)


def rows_with(**columns):
    n = len(next(iter(columns.values())))
    base = {name: np.zeros(n, np.int64) for name in ("seen", "in_view", "missed", "first_seen", "last_seen")}
    base.update({k: np.asarray(v) for k, v in columns.items()})
    return LandmarkRows(np.arange(n), np.zeros((n, 16), np.float32), np.ones(n, np.int8), **base)


def test_as_many_as_wanted_and_the_strongest_of_a_cell():
    rng = np.random.default_rng(0)
    uv = rng.uniform((10, 10), (310, 230), (300, 2))
    features = features_at(uv, response=rng.random(300))
    new = chosen(features)
    assert len(new) == 20
    gaps = np.linalg.norm(uv[new][:, None] - uv[new][None], axis=2) + 1e9 * np.eye(20)
    assert gaps.min() >= 5.0


def test_empty_regions_come_first():
    left = [(20.0 + 8 * i, 100.0 + 8 * j) for i in range(5) for j in range(5)]
    right = [(300.0, 100.0), (300.0, 110.0)]
    features = features_at(left + right, response=[10.0] * 25 + [0.1] * 2)
    config = MapConfig(target_in_view=8, separation=5.0, grid=(2, 1))
    assert {25, 26} <= set(chosen(features, occupied=[(10, 10)] * 4, config=config).tolist())


def test_features_on_landmarks_and_without_depth_are_left_out():
    features = features_at([(50, 50), (100, 100), (200, 100), (250, 50)])
    features.uv_right[2] = np.nan
    free = np.array([True, True, True, False])
    assert chosen(features, occupied=[(51, 51)], free=free).tolist() == [1]


def test_uncertain_depth_is_left_out():
    # f B = 36 px m: at 3 m the disparity is 12 px and 1.4 px of noise are 12 %; at 6 m they are 24 %.
    assert len(chosen(features_at([(100, 100)], depth=3.0))) == 1
    assert len(chosen(features_at([(100, 100)], depth=6.0))) == 0


def test_enough_landmarks_in_view_need_no_more():
    features = features_at([(100, 100)])
    assert len(chosen(features, occupied=np.full((20, 2), 200.0))) == 0


def test_erase_what_is_missed_or_seldom_seen():
    config = MapConfig(erase_missed=5, erase_share=0.3)
    rows = rows_with(seen=[9, 9, 2, 2, 1], in_view=[10, 14, 10, 5, 1], missed=[1, 5, 1, 3, 0])
    assert bad_landmarks(rows, config).tolist() == [False, True, True, False, False]


def test_out_of_view_is_never_missed():
    rows = rows_with(seen=[3], in_view=[3], missed=[0], last_seen=[7])
    features = features_at(np.zeros((0, 2)))
    none = np.zeros(0, np.int64)
    for frame in range(100):
        rows = rows.after_frame(frame, none, none, features, none)
    assert not bad_landmarks(rows, CONFIG).any()


def test_counting_a_frame():
    rows = rows_with(seen=[1, 1, 1], in_view=[1, 1, 1], missed=[0, 2, 0])
    features = features_at([(1, 1), (2, 2)])
    rows = rows.after_frame(8, np.array([0, 1]), np.array([1, 2]), features, np.array([1, 0]))
    assert rows.in_view.tolist() == [2, 2, 2]
    assert rows.missed.tolist() == [1, 0, 0]
    assert rows.seen.tolist() == [1, 2, 2]
    assert rows.last_seen.tolist() == [0, 8, 8]
    np.testing.assert_array_equal(rows.descriptors[1], features.descriptors[1])


def test_the_longest_unseen_give_way():
    config = MapConfig(target_in_view=3, max_landmarks=3)
    rows = rows_with(last_seen=[5, 1, 9, 3, 7], seen=[2, 2, 2, 2, 2])
    assert surplus_landmarks(rows, config).tolist() == [False, True, False, True, False]


def test_the_never_confirmed_give_way_first():
    config = MapConfig(target_in_view=3, max_landmarks=3)
    rows = rows_with(last_seen=[5, 1, 9, 3, 9], seen=[1, 4, 1, 4, 2])
    assert surplus_landmarks(rows, config).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(
    "change", [{"target_in_view": 1}, {"max_landmarks": 10}, {"grid": (0, 1)}, {"max_depth_error": 2.0}]
)
def test_settings_out_of_range(change):
    with pytest.raises(ConfigurationError):
        MapConfig(**change)
