import numpy as np
import pytest

from slam.config import SystemConfig
from slam.system import StereoSlam
from slam.tracks.config import MapConfig
from slam.tracks.mapper import MapView, depth_is_known, new_landmarks, surplus_landmarks, take_census
from slam.tracks.table import LandmarkTable
from tests.slam.scene import RIG, features_at

CONFIG = MapConfig(target_in_view=20, separation=5.0)


def at_depth(uv, depth=3.0, response=None):
    uv = np.asarray(uv, float)
    right = uv - np.outer(RIG.left.fu * RIG.baseline / depth * np.ones(len(uv)), [1, 0])
    return features_at(uv, right, np.eye(16, dtype=np.float32)[np.arange(len(uv)) % 16], response=response)


def chosen(features, occupied=(), config=CONFIG, free=None):
    free = np.ones(len(features), bool) if free is None else free
    deep = depth_is_known(RIG, features, np.arange(len(features)), 1.0, config.max_depth_error)
    return new_landmarks(features, free & deep, np.asarray(occupied, float).reshape(-1, 2), RIG, config)


def test_features_of_uncertain_depth_do_not_become_landmarks():
    uv = np.stack(np.meshgrid(np.arange(60, 300, 40), np.arange(40, 200, 40)), axis=-1).reshape(-1, 2)
    far = np.arange(len(uv)) % 2 == 1
    system = StereoSlam(RIG, None, "ekf", config=SystemConfig(map=MapConfig(target_in_view=40)))
    system.process_features(at_depth(uv, np.where(far, 60.0, 3.0)))
    assert (system.estimate().positions[:, 2] < 4.0).all() and len(system.landmarks) == (~far).sum()


def rows_with(**columns):
    n = len(next(iter(columns.values())))
    base = {name: np.zeros(n, np.int64) for name in ("seen", "in_view", "missed", "last_seen")}
    base.update({k: np.asarray(v) for k, v in columns.items()})
    return LandmarkTable(np.arange(n), np.zeros((n, 16), np.float32), np.ones(n, np.int8), **base)


def test_empty_regions_come_first_and_none_lies_close_to_another():
    rng = np.random.default_rng(0)
    uv = rng.uniform((10, 10), (310, 230), (300, 2))
    new = chosen(at_depth(uv, response=rng.random(300)))
    gaps = np.linalg.norm(uv[new][:, None] - uv[new][None], axis=2) + 1e9 * np.eye(20)
    assert gaps.min() >= 5.0
    left = [(20.0 + 8 * i, 100.0 + 8 * j) for i in range(5) for j in range(5)]
    right = [(300.0, 100.0), (300.0, 110.0)]
    features = at_depth(left + right, response=np.repeat([10.0, 0.1], [25, 2]))
    config = MapConfig(target_in_view=8, separation=5.0, grid=(2, 1))
    assert {25, 26} <= set(chosen(features, occupied=[(10, 10)] * 4, config=config).tolist())


def test_features_on_landmarks_and_without_depth_are_left_out():
    features = at_depth([(50, 50), (100, 100), (200, 100), (250, 50)])
    features.uv_right[2] = np.nan
    free = np.array([True, True, True, False])
    assert chosen(features, occupied=[(51, 51)], free=free).tolist() == [1]
    # f B = 36 px m: at 3 m the disparity is 12 px and 1.4 px of noise are 12 %; at 6 m they are 24 %.
    assert len(chosen(at_depth([(100, 100)], depth=6.0))) == 0


def census(rows, config, positions=None, features=None, frame=9, expected=True, measured=(), withheld=()):
    """Which landmarks go, and which features are one of them, after a frame with the camera at the origin."""
    n = len(rows.ids)
    positions = np.zeros((n, 3)) if positions is None else positions  # none is in the image
    features = at_depth(np.zeros((0, 2))) if features is None else features
    view = MapView.of(RIG, np.eye(4), positions, features, 1.0)
    marks = (np.full(n, expected), np.isin(rows.ids, measured), np.isin(rows.ids, withheld))
    return [x.tolist() for x in take_census(rows, np.arange(n), view, *marks, frame, features, RIG, config)]


def in_image(n):
    """Points that are all in the image, far apart in depth."""
    return np.outer(2.0 + np.arange(n), [0.0, 0.0, 1.0])


def test_erase_what_is_missed_or_seldom_seen_and_none_where_nothing_takes_its_place():
    config = MapConfig(erase_missed=5, erase_share=0.3)
    columns = {"seen": [9, 9, 2, 2, 1], "in_view": [10, 14, 10, 5, 1], "missed": [1, 5, 1, 3, 0]}
    assert census(rows_with(**columns), config)[0] == [False, True, True, False, False]
    blind = at_depth([(1, 1)])
    blind.uv_right[:] = np.nan
    assert census(rows_with(**columns), config, features=blind)[0] == 5 * [False]


def test_frames_unseen_are_counted_though_the_others_are_seen_in_every_one():
    """Landmark 0 is out of view while 80 others are tracked; frames in which nothing is measured do not count."""
    others, config = np.arange(1, 81), MapConfig(confirmed=6)
    rows = rows_with(seen=np.full(81, 5))
    for frame in range(1, 7):
        assert not any(census(rows, config, frame=2 * frame - 1)[0])
        going = census(rows, config, frame=2 * frame, measured=others)[0]
    assert rows.unseen.tolist() == [6] + [0] * 80 and np.flatnonzero(going).tolist() == [0]
    # Of an earlier run: it stays until this run has seen it, unless the map forgets.
    old = {"seen": [5, 9], "last_seen": [-1, 12], "unseen": [9, 0]}
    assert census(rows_with(**old), MapConfig(confirmed=6, forget_after=13))[0] == [False, False]
    assert census(rows_with(**old), MapConfig(confirmed=6, forget_after=12))[0] == [True, False]


def test_what_is_held_back_is_neither_missed_nor_seen():
    rows = rows_with(seen=[5, 5, 5, 5], in_view=[5] * 4, missed=[4] * 4, unseen=[4] * 4, out_of_view=[4] * 4)
    points = in_image(4) * [[1], [1], [1], [-1]]
    going, _ = census(rows, MapConfig(confirmed=0), points, measured=[2], withheld=[0])
    assert [getattr(rows, name).tolist() for name in ("seen", "in_view", "missed", "unseen", "out_of_view")] == [
        [5, 5, 6, 5], [5, 6, 6, 5], [4, 5, 0, 4], [4, 5, 0, 5], [4, 4, 0, 5],
    ]  # fmt: skip
    assert going == [False, True, False, False] and rows.last_seen.tolist() == [0, 0, 9, 0]


@pytest.mark.parametrize(
    ("last_seen", "seen", "gone"),
    [([5, 1, 9, 3, 7], [2, 2, 2, 2, 2], [1, 3]), ([5, 1, 9, 3, 9], [1, 4, 1, 4, 2], [0, 1])],
)
def test_those_seen_once_and_the_longest_unseen_give_way(last_seen, seen, gone):
    surplus = surplus_landmarks(rows_with(last_seen=last_seen, seen=seen), MapConfig(target_in_view=3, max_landmarks=3))
    assert surplus.tolist() == gone


def test_out_of_view_the_map_is_thinned_to_the_best_seen():
    """Landmarks two metres behind, 10 cm apart, the last one 1 m from the others; the first three are out of view."""
    positions = np.array([[0, 0, 2], [0.1, 0, 2], [0.2, 0, 2], [0.3, 0, 2], [0.4, 0, 2], [1.4, 0, 2.0]]) * [1, 1, -1]

    def thinned(spacing=0.1, positions=positions, seen_from=0.0):
        rows = rows_with(seen=[3, 9, 4, 1, 1, 1], unseen=[5, 4, 3, 2, 1, 0], seen_from=np.full((6, 3), seen_from))
        return census(rows, MapConfig(spacing=spacing, erase_missed=2, confirmed=0), positions)[0]

    assert thinned() == [True, False, True, False, False, False]
    assert not any(thinned(spacing=0.0))
    assert not any(thinned(positions=positions * [3, 1, 1]))  # further apart than a tenth of the distance
    assert not any(thinned(seen_from=np.nan))


def like(features, rows, seen):
    """Landmarks that look like some of the features."""
    none = np.zeros(len(rows), np.int64)
    looks, signs = features.descriptors[rows], features.laplacian[rows]
    return LandmarkTable(np.arange(len(rows)), looks, signs, np.asarray(seen), none, none.copy(), none.copy())


def test_features_and_landmarks_that_are_a_landmark_already_are_known():
    features = at_depth([(100, 100), (200, 100), (250, 50)], depth=3.0)
    a, b, c = RIG.triangulate(features.uv_left, features.uv_right)
    # The first: 0.2 m deeper, within the uncertainty of 12 %. The second: as deep, but 20 px away. The third looks
    # like another feature.
    landmarks, positions = like(features, [0, 1, 1], [1, 1, 1]), np.array([a * 1.07, b + np.array([0.2, 0, 0]), c])
    assert census(landmarks, CONFIG, positions, features)[1] == [True, False, False]
    # Of those at one place the one seen less goes, else the younger; the last one lies deeper by 10 cm.
    landmarks, positions = like(features, [0, 0, 1, 1, 0], [5, 9, 4, 4, 3]), np.array([a, a + 0.01, b, b - 0.005, a])
    positions[4, 2] += 0.1
    assert census(landmarks, CONFIG, positions, features)[0] == [True, False, False, True, False]


def test_hidden_landmarks_are_not_expected():
    """Two landmarks at 6 m: one among features at 2 m, one among features as far as itself; one at the border."""
    uv = [(column + i, 100 + j) for column in (100, 220) for i in (-6, 0, 6) for j in (-6, 6)]
    both = at_depth(uv, np.repeat([2.0, 6.0], 6))
    rays = np.column_stack([RIG.left.normalise(np.array([(100.0, 100), (220, 100), (5, 100)])), np.ones(3)])
    rows = rows_with(seen=np.zeros(3, np.int64))
    census(rows, CONFIG, 6.0 * rays, both)
    assert rows.missed.tolist() == [0, 1, 0] and rows.out_of_view.tolist() == [0, 0, 0]
    census(rows, CONFIG, 6.0 * rays, both, expected=False)
    assert rows.missed.tolist() == rows.in_view.tolist() == [0, 1, 0]
