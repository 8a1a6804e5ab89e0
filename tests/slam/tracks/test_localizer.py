"""A lost or carried camera is found again: by a place of the atlas, or by the map, where several frames agree."""

from itertools import groupby

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.data import Prediction, StereoFeatures
from slam.geometry import se3
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.tracks.config import AssociationConfig, MapConfig
from slam.tracks.localizer import Localizer, Search, jump
from slam.tracks.step import TrackingState
from slam.tracks.table import LandmarkTable
from tests.slam.scene import BACKENDS, RIG, Cloud, path

T_TRUE = se3.exp(np.array([0.02, 0.3, -0.01, 0.2, 0.05, 0.4]))


def scene() -> tuple[LandmarkTable, np.ndarray, StereoFeatures]:
    """Landmarks of which fifteen each look alike, their positions, and the features of a later frame."""
    cloud = Cloud(150)
    kind = np.arange(150) % 10
    cloud.descriptors, cloud.laplacian = cloud.descriptors[kind], cloud.laplacian[kind]
    start, ids = cloud.features(np.eye(4), 0.0)
    landmarks = LandmarkTable(np.arange(len(ids)), start.descriptors, start.laplacian)
    return landmarks, cloud.points[ids], cloud.features(T_TRUE, 1.0, 0.2)[0]


def prediction(positions: np.ndarray, deviation: float, window: float) -> Prediction:
    """The camera has hardly moved, so it seems; where landmarks are is known to within a window [px]."""
    left, right = RIG.project(positions)
    view = np.flatnonzero(RIG.left.in_image(left))
    innovation = np.tile(window**2 * np.eye(2), (len(view), 1, 1))
    return Prediction(1.0, np.eye(4), deviation**2 * np.eye(6), view, left[view], right[view], innovation)


def search(expected: Prediction, landmarks: LandmarkTable, positions: np.ndarray, features: StereoFeatures) -> Search:
    localizer = Localizer(RIG, AssociationConfig(), EstimatorModels(pixel_sigma=0.5))
    return Search(localizer, expected, landmarks, positions, features, 0)


def test_an_allowed_place_is_believed_at_once_where_landmarks_are_found_around_it():
    landmarks, positions, features = scene()
    expected = prediction(positions, 0.2, 400.0)
    assert jump(expected, T_TRUE) < AssociationConfig().max_jump
    alone, _ = search(expected, landmarks, positions, features).localize(TrackingState())
    assert not len(alone)
    found, _ = search(expected, landmarks, positions, features).localize(TrackingState(), lambda: T_TRUE)
    assert len(found) > 30
    assert not found.kidnapped
    assert np.abs(se3.log(se3.inverse(T_TRUE) @ found.T_world_left)).max() < 0.01


@pytest.mark.parametrize(("shown", "frames"), [(60, 1), (2, AssociationConfig().kidnapped_after)])
def test_few_landmarks_of_long_ago_count_when_several_frames_show_them(shown, frames):
    """A few out of many agree by chance with the pose that all others give, as if the path had no drift."""
    cloud = Cloud(150)
    start, ids = cloud.features(np.eye(4), 0.0)
    old = np.arange(len(ids)) < 60
    away = np.where(old, AssociationConfig.rematch_after, 0)
    landmarks = LandmarkTable(np.arange(len(ids)), start.descriptors, start.laplacian, out_of_view=away)
    features = start.select(np.flatnonzero(~old | (np.arange(len(ids)) < shown)))
    expected = prediction(cloud.points[ids], 0.01, 5.0)
    for frame in range(frames):
        matches = search(expected, landmarks, cloud.points[ids], features).match()
        counts = shown * (frame == frames - 1)
        assert len(matches) == (~old).sum() + counts
        assert old[matches.ids].sum() == counts
        landmarks.count_returning(matches.returning)
    assert not landmarks.returning.any()


MAP = MapConfig(target_in_view=40, max_depth_error=0.3, restart_after=12)
CONFIG = SystemConfig(models=EstimatorModels(pixel_sigma=0.5), map=MAP)


def run(backend, poses):
    cloud, system, results, points = Cloud(150), StereoSlam(RIG, None, backend, config=CONFIG), [], []
    for k, T in enumerate(poses):
        features, ids = cloud.features(T, k / 30, 0.3)
        results.append(system.process_features(features))
        points.append(ids)
    return system, results, points


def states(results):
    return [(name, len(list(group))) for name, group in groupby(r.status.value for r in results)]


def right_share(results, points):
    """Share of associations with the point that the landmark was made of."""
    owner, right, total = {}, 0, 0
    for result, ids in zip(results, points):
        right += sum(owner[i] == ids[row] for i, row in zip(result.matched.tolist(), result.matched_features))
        total += len(result.matched)
        owner.update({i: ids[row] for i, row in zip(result.added.tolist(), result.added_features)})
    return right / total


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_carried_camera_is_believed_when_three_frames_agree(backend):
    """The way it was carried is no motion: the back end begins again in the map, and the path keeps every frame."""
    jump = se3.exp(np.array([0, 0.3, 0, 0.4, 0, 0.2]))
    poses = [*path(25), *(T @ jump for T in path(60)[25:])]
    system, results, points = run(backend, poses)
    needed = CONFIG.association.kidnapped_after - 1
    assert states(results) == [("started", 1), ("tracked", 24), ("predicted", needed), ("tracked", 35 - needed)]
    assert results[25].reason.endswith("landmarks agree on a pose too far from the prediction to be believed at once")
    errors = np.linalg.norm(system.trajectory().positions - np.array(poses)[:, :3, 3], axis=1)
    assert len(errors) == 60
    assert errors[25 + needed :].max() < 0.02  # as before
    steps = np.diff([r.estimate.T_world_left[:3, 3] for r in results[25 + needed :]], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.03  # the jump has left no velocity behind
    assert right_share(results, points) == 1


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_shaken_camera_with_sharp_images_is_tracked(backend):
    """Each frame is far beyond what the prediction allows, but most of what is in view agrees.

    The largest error is the median of three shakes: that of one is the frame with least to agree on, as chance has it
    (0.01 to 0.05 m over six).
    """
    largest = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        poses = path(60)
        for k in range(21, 60):
            poses[k] = poses[k] @ se3.exp(0.02 * rng.normal(size=6) * (1, 1.5, 1, 0.5, 0.5, 0.5))
        system, results, points = run(backend, poses)
        assert states(results) == [("started", 1), ("tracked", 59)]
        assert right_share(results, points) == 1
        errors = np.linalg.norm(system.trajectory().positions - np.array(poses)[:, :3, 3], axis=1)
        largest.append(errors.max())
    assert np.median(largest) < 0.03
