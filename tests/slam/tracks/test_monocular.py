"""Depth from two views of one moving camera, and running on left images alone."""

from dataclasses import fields, replace

import numpy as np
import pytest

from slam.atlas.map_io import SavedMap
from slam.config import SystemConfig
from slam.data import FrameStatus
from slam.geometry import se3
from slam.system import StereoSlam
from slam.tracks.monocular import depths_by_motion, frame_covariance, two_view_depth
from slam.tracks.table import Tracks
from tests.slam.scene import BACKENDS, RIG, Cloud, features_at

STEP = se3.exp(np.array([0.02, 0.05, -0.03, 0.3, 0.05, 0.1]))  # the camera now, in its coordinates then
NOISE = np.diag(np.repeat([1e-3, 5e-3], 3) ** 2)
SIGMA = 0.5


def views(rig, count, rng, noise=0.0, motion=(0, 0, 0, 0, 0, 0)):
    """Points (N, 3) before the camera now, and their pixels then and now."""
    local = np.column_stack([rng.uniform(-1, 1, count), rng.uniform(-0.7, 0.7, count), rng.uniform(2, 5, count)])
    then = rig.left.project(se3.transform(STEP @ se3.exp(np.array(motion, float)), local))
    now = rig.left.project(local)
    return local, then + noise * rng.standard_normal(then.shape), now + noise * rng.standard_normal(now.shape)


def test_the_covariance_fits_the_errors():
    """Pixel noise and an uncertain motion, drawn again each time: squared distances as χ² with three degrees."""
    rng, distances, misfits = np.random.default_rng(1), [], []
    for _ in range(150):
        motion = np.linalg.cholesky(NOISE) @ rng.standard_normal(6)
        local, then, now = views(RIG, 5, rng, SIGMA, motion)
        found = two_view_depth(RIG, then, now, STEP, NOISE, SIGMA)
        error = found.local - local
        distances.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariances), error).mean())
        misfits.append(found.misfit.mean())
    # the mean of 150 times 5 (correlated) values is sure to 10 %; depth is a little skew
    assert 2.5 < np.mean(distances) < 3.6
    assert 0.8 < np.mean(misfits) < 1.25


def test_what_cannot_be_told_is_not_good():
    local, then, now = views(RIG, 10, np.random.default_rng(2))
    found = two_view_depth(RIG, then, now, STEP, NOISE, SIGMA)
    np.testing.assert_allclose(found.local, local, atol=1e-6)
    assert found.good(0.2).all() and (found.misfit < 1e-6).all()
    turned = se3.exp(np.array([0.02, 0.05, -0.03, 0, 0, 0]))  # a camera that only turns sees no depth
    same = RIG.left.project(se3.transform(turned, local))
    assert not two_view_depth(RIG, same, now, turned, NOISE, SIGMA).good(0.2).any()
    assert (
        not two_view_depth(RIG, then + np.array([0, 30]), now, STEP, 1e-4 * NOISE, SIGMA).good(0.2).any()
    )  # off the line
    assert not two_view_depth(RIG, now, then, STEP, NOISE, SIGMA).good(0.2).any()  # rays meet behind the cameras
    assert len(two_view_depth(RIG, then[:0], now[:0], STEP, NOISE, SIGMA).good(0.2)) == 0


def test_a_frames_own_covariance_is_that_of_its_least_squares_pose():
    from slam.window.consensus import find_consensus

    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-2, 2, 40), rng.uniform(-1, 1, 40), rng.uniform(3, 6, 40)])
    z, _ = RIG.project_stereo(points)
    stereo = rng.random(40) < 0.5
    expected = frame_covariance(RIG, points, stereo, SIGMA)
    errors = []
    for _ in range(300):
        measured = z + SIGMA * rng.standard_normal(z.shape)
        measured[~stereo, 2] = np.nan
        found = find_consensus(RIG, points, measured, np.eye(4), threshold=1e3, hypotheses=1, seed=0)
        errors.append(se3.log(found.T_world_left))
    share = np.mean([e @ np.linalg.solve(expected, e) for e in errors]) / 6
    assert 0.85 < share < 1.15  # 300 draws of six degrees: sure to 3 %


def left_features(n, stamp, uv):
    """Features (n,) of the left image that look alike to the bit."""
    return features_at(uv, uv * np.nan, np.tile(np.eye(1, 8, dtype=np.float32), (n, 1)), stamp)


def test_a_feature_that_is_as_like_to_two_waiting_tracks_is_nobodys():
    """Two corners are seen, then one of them: it waits anew, and becomes one landmark in the frame after that."""
    points, tracks = np.array([[0.0, 0, 3], [0.06, 0, 3]]), Tracks.empty(8)
    for k, n in enumerate((2, 1, 1)):
        T = se3.exp(np.array([0, 0, 0, 0.06 * k, 0, 0]))
        features = left_features(n, k / 30, RIG.left.project(se3.transform(se3.inverse(T), points[:n])))
        tracks = tracks.begun(n, 0)
        rows, depths = depths_by_motion(RIG, tracks, features, np.arange(n), T, 1e-10 * np.eye(6), k, SIGMA, 0.5)
        assert rows.tolist() == ([0] if k == 2 else [])
    assert not (tracks.waiting_since >= 0).any()
    np.testing.assert_allclose(depths.local, [[-0.12, 0, 3]], atol=1e-6)
    tracks.enter_landmarks(1, np.array([7]), features, rows, np.zeros(3))
    assert tracks.landmarks().ids.tolist() == [7]


def map_of(cloud, rows=slice(None)):
    n = len(cloud.points[rows])
    return SavedMap(
        np.arange(n), cloud.points[rows], np.tile(1e-4 * np.eye(3), (n, 1, 1)), cloud.descriptors[rows],
        cloud.laplacian[rows], np.ones(n, np.int64), np.ones(n, np.int64),
    )  # fmt: skip


@pytest.mark.parametrize("backend", BACKENDS)
def test_left_images_alone_in_a_prior_map_go_on_beyond_it(backend):
    """A third of the points is known; the others join the map by two views, where they truly are."""
    cloud = Cloud(150)
    config = SystemConfig().with_settings(["map.monocular=true", "models.pixel_sigma=0.5"])
    system = StereoSlam(RIG, None, backend, config=config, prior_map=map_of(cloud, slice(0, 50)))
    owner: dict[int, int] = {}
    for k in range(40):
        T = se3.exp(np.array([0, 0, 0, 0.6 * k / 30, 0, 0]))  # sideways: forward motion shows little depth
        features, ids = cloud.features(T, k / 30, 0.3)
        result = system.process_features(replace(features, uv_right=features.uv_right * np.nan))
        assert result.status is FrameStatus.TRACKED
        assert np.linalg.norm(result.estimate.T_world_left[:3, 3] - T[:3, 3]) < 0.04
        owner.update(zip(result.added.tolist(), ids[result.added_features].tolist()))
    estimate = system.estimate()
    rows = np.flatnonzero(np.isin(estimate.ids, list(owner)))
    truth = cloud.points[[owner[i] for i in estimate.ids[rows].tolist()]]
    error = estimate.positions[rows] - truth
    distances = np.einsum("ni,nij,nj->n", error, np.linalg.inv(estimate.covariances[rows]), error)
    assert len(rows) > 20
    assert np.median(distances) < 6  # χ²₃: 2.4; they share the error of the camera's motion


@pytest.mark.parametrize("backend", BACKENDS)
def test_while_right_pixels_are_missing_landmarks_come_from_two_views_and_none_is_erased(backend):
    """Ten frames show a third of the points in both images, thirty show all of them in the left one alone."""
    made: dict[bool | None, list[int]] = {}
    for setting in (None, False) if backend == "ekf" else (None,):  # what the setting does no back end knows
        cloud, config = Cloud(150), SystemConfig().with_settings(["models.pixel_sigma=0.5"])
        system = StereoSlam(RIG, None, backend, config=replace(config, map=replace(config.map, monocular=setting)))
        made[setting], erased = [], 0
        for k in range(40):
            T = se3.exp(np.array([0, 0, 0, 0.6 * k / 30, 0, 0]))
            features, ids = cloud.features(T, k / 30, 0.3)
            if k < 10:
                rows = ids < 50
                columns = {f.name: getattr(features, f.name)[rows] for f in fields(features)[1:8]}
                features = replace(features, **columns)
            else:
                hidden = ids < 10  # they look like something else now
                descriptors = np.where(hidden[:, None], -features.descriptors, features.descriptors)
                features = replace(features, uv_right=features.uv_right * np.nan, descriptors=descriptors)
            result = system.process_features(features)
            assert k == 0 or result.status is FrameStatus.TRACKED
            if k >= 10:
                made[setting].append(len(result.added))
                erased += len(result.erased)
        assert erased < 5  # doubled ones may go; ten are hidden
    assert sum(made[None]) > 20
    assert not any(made.get(False, ()))
