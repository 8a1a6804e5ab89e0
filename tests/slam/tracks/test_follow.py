from dataclasses import replace

import numpy as np
import pytest

from slam.data import Prediction, StereoFeatures
from slam.geometry import se3
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import Windows, follow, match_everywhere, match_near
from tests.slam.scene import RIG, Cloud, features_at

CONFIG = AssociationConfig()
WIDE = CONFIG.wide_d_match, CONFIG.wide_ratio


def windows(c):
    return Windows(c.window_sigmas, c.d_match, c.ratio, c.window_max, c.window_min)


def predicted(cloud, T, offset=(0.0, 0.0), sigma=2.0):
    """A prediction of all points in view, off by some pixels."""
    left, right = RIG.project(se3.transform(se3.inverse(T), cloud.points))
    ids = np.flatnonzero(RIG.left.in_image(left))
    S = np.tile(np.eye(2) * sigma**2, (len(ids), 1, 1))
    return Prediction(0.0, T, np.eye(6), ids, left[ids] + offset, right[ids], S)


def found(cloud, prediction, features, config=CONFIG):
    ids = prediction.ids
    expected = prediction.uv_left, prediction.innovation
    return follow(*expected, cloud.descriptors[ids], cloud.laplacian[ids], features, windows(config))


def test_every_landmark_finds_its_own_feature():
    cloud = Cloud()
    features, ids = cloud.features(np.eye(4), 0.0, noise=0.5)
    prediction = predicted(cloud, np.eye(4))
    matches = found(cloud, prediction, features)
    assert len(matches) == len(ids)
    np.testing.assert_array_equal(prediction.ids[matches.tracks], ids[matches.features])


@pytest.mark.parametrize("sigma", [0.5, 4.0, 30.0, 300.0])
def test_windows_are_the_innovations_ellipses(sigma):
    """A feature is found if it lies in the ellipse, whatever the size and shape of that."""
    rng = np.random.default_rng(int(sigma))
    A = sigma * rng.normal(size=(300, 2, 2))
    S = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(2)
    offset = np.einsum("nij,nj->ni", np.linalg.cholesky(S), rng.normal(size=(300, 2))) * rng.uniform(0, 5, (300, 1))
    squared = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(S), offset)
    look, sign, none = np.eye(1, 8, dtype=np.float32), np.ones(1, np.int8), np.full((1, 2), np.nan)
    within = windows(AssociationConfig(window_min=1e-3, window_max=1e4))
    features = [features_at(uv[None], none, look) for uv in offset]
    inside = np.array([len(follow(np.zeros((1, 2)), P[None], look, sign, f, within)) for P, f in zip(S, features)])
    clear = np.abs(np.sqrt(squared) - 5.0) > 1e-3  # float32 at the very edge
    assert 30 < inside.sum() < 270
    np.testing.assert_array_equal(inside[clear], (squared <= 25.0)[clear])


def test_looks_are_sought_among_points_that_are_near_enough():
    """Within so many metres and standard deviations; and what is no candidate is no rival either."""
    cloud = Cloud()
    features, ids = cloud.features(np.eye(4), 0.0)
    matches = match_everywhere(cloud.descriptors, cloud.laplacian, features, *WIDE)
    np.testing.assert_array_equal(matches.tracks, ids[matches.features])
    points, none, off = cloud.points[ids], np.zeros(len(ids)), np.array([0.0, 0.3, 0.4])
    places, variances = points + off, none.copy()
    points[3] = np.nan
    variances[5:] = 0.03**2  # 0.4 + 4 0.03 m are enough
    variances[:5], places[:5] = 0.02**2, points[:5] + off
    places[4], places[3] = points[4], points[4]  # 3 would be at 4 as well, but does not look like it
    tracks = cloud.descriptors[ids], cloud.laplacian[ids], places, variances
    matches = match_near(*tracks, features, points, none, (0.4, 4.0), *WIDE)
    assert matches.tracks.tolist() == matches.features.tolist() == list(range(4, len(ids)))
    matches = match_near(*tracks, features, points, none + 0.03**2 - variances, (0.4, 4.0), *WIDE)
    assert matches.tracks.tolist() == np.delete(np.arange(len(ids)), 3).tolist()


def test_larger_window_asks_for_a_better_descriptor():
    cloud = Cloud()
    features, ids = cloud.features(np.eye(4), 0.0)
    prediction = predicted(cloud, np.eye(4), offset=(8.0, 0.0))
    # Descriptors 0.5 away: good enough for the smallest window (0.55), not for the larger one (0.4).
    blurred = features.descriptors + 0.5 * np.roll(cloud.descriptors[ids], 1, axis=1)
    distance = np.linalg.norm(blurred / np.linalg.norm(blurred, axis=1, keepdims=True) - cloud.descriptors[ids], axis=1)
    blurred = blurred[(distance > 0.4) & (distance < 0.55)]
    keep = np.flatnonzero((distance > 0.4) & (distance < 0.55))
    assert len(keep) > 20
    worse = features.select(keep)
    worse = replace(worse, descriptors=(blurred / np.linalg.norm(blurred, axis=1, keepdims=True)).astype(np.float32))
    assert len(found(cloud, prediction, worse)) == 0
    assert len(found(cloud, predicted(cloud, np.eye(4)), worse)) == len(keep)


def test_no_greedy_theft():
    """Two landmarks want one feature: it goes to the one that it fits better, wherever that stands in the list."""
    cloud = Cloud(2)
    cloud.points[:] = [[0, 0, 3], [0.01, 0, 3]]
    cloud.descriptors[1] = cloud.descriptors[0] + 0.2 * cloud.descriptors[1]
    cloud.descriptors[1] /= np.linalg.norm(cloud.descriptors[1])
    cloud.laplacian[:] = 1
    features, ids = cloud.features(np.eye(4), 0.0)
    only_second = features.select(np.flatnonzero(ids == 1))
    matches = found(cloud, predicted(cloud, np.eye(4)), only_second)
    assert matches.tracks.tolist() == [1]


def test_tracks_that_look_alike_to_the_bit_share_a_feature():
    look, sign = np.eye(1, 8, dtype=np.float32), np.ones(1, np.int8)
    feature = features_at(np.zeros((1, 2)), np.full((1, 2), np.nan), look)
    many = np.zeros((500, 2)), np.tile(np.eye(2), (500, 1, 1)), look.repeat(500, axis=0), sign.repeat(500)
    matches = follow(*many, feature, windows(CONFIG))
    assert matches.tracks.tolist() == list(range(500)) and not matches.features.any()


@pytest.mark.parametrize("change", ["ambiguous", "of the other sign", "nothing"])
def test_what_cannot_be_matched_is_left_alone(change):
    cloud = Cloud(1)
    features, _ = cloud.features(np.eye(4), 0.0)
    flipped = replace(features, laplacian=(-features.laplacian).astype(np.int8))
    ambiguous = features.select(np.array([0, 0]))
    shown = {"ambiguous": ambiguous, "of the other sign": flipped, "nothing": StereoFeatures.empty(0.0, 32)}[change]
    assert len(found(cloud, predicted(cloud, np.eye(4)), shown)) == 0
    assert len(match_everywhere(cloud.descriptors, cloud.laplacian, shown, *WIDE)) == 0
    assert len(match_everywhere(cloud.descriptors[:0], cloud.laplacian[:0], features, *WIDE)) == 0
