"""A place seen again is the most similar one, and gives the pose between both views; another place gives none."""

from dataclasses import replace

import numpy as np
import pytest

from slam.atlas.config import AtlasConfig
from slam.atlas.keyframes import Keyframe, covariance_growth
from slam.atlas.loop_closer import view_has_changed
from slam.atlas.places import PlaceIndex
from slam.atlas.verification import refined_pose, verify
from slam.calibration import RigModel
from slam.calibration.model import Revision, RigCorrection
from slam.data import StereoFeatures
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, exp, inverse, log, transform
from slam.models import EstimatorModels
from slam.tracks.config import AssociationConfig
from slam.tracks.localizer import Localizer
from slam.tracks.mapper import depth_is_known
from tests.slam.scene import features_at

SIGMA = 0.5
CAMERA = PinholeCamera(300.0, 300.0, 320.0, 180.0, 640, 360)
RIG = StereoRig(CAMERA, CAMERA, np.eye(3), np.array([-0.5, 0.0, 0.0]))
LOCALIZER = Localizer(RIG, AssociationConfig(), EstimatorModels(pixel_sigma=SIGMA))


def world(seed: int) -> tuple[Array, Array]:
    """Points (300, 3) [m] before the first camera, and unit descriptors."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-10, 10, 300), rng.uniform(-3, 3, 300), rng.uniform(6, 20, 300)])
    descriptors = rng.normal(size=(300, 16))
    return points, (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)


def view(T_world_left: Array, points: Array, descriptors: Array, seed: int) -> StereoFeatures:
    """What a camera at a pose sees of the points, with noise."""
    rng = np.random.default_rng(seed)
    left, right = RIG.project(transform(inverse(T_world_left), points))
    seen = RIG.left.in_image(left) & RIG.right.in_image(right)
    left = left[seen] + rng.normal(0, SIGMA, (seen.sum(), 2))
    right = np.column_stack([right[seen, 0] + rng.normal(0, SIGMA, seen.sum()), left[:, 1]])
    return features_at(left, right, descriptors[seen])


def keyframe(features: StereoFeatures) -> Keyframe:
    """The frame as a keyframe."""
    nothing = np.full(len(features), -1)
    rows = np.flatnonzero(depth_is_known(RIG, features, np.arange(len(features)), SIGMA, 0.2))
    points = RIG.triangulate(features.uv_left[rows], features.uv_right[rows])
    return Keyframe(
        0, 0.0, np.eye(4), np.eye(6), np.zeros((6, 6)), np.zeros((6, 0)), 0.0, float(np.median(points[:, 2])),
        points.astype(np.float32), features.descriptors[rows].astype(np.float16), features.laplacian[rows],
        nothing[rows],
    )  # fmt: skip


MOVED = exp(np.array([0.02, 0.1, -0.01, 0.4, -0.1, 1.0]))


def test_the_pose_of_a_place_seen_again():
    nees = []
    for seed in range(20):
        points, descriptors = world(seed)
        old = keyframe(view(np.eye(4), points, descriptors, 2 * seed))
        measured = view(MOVED, points, descriptors, 2 * seed + 1)
        found = verify(old, measured, (0, 1), RIG, LOCALIZER, seed)
        assert found is not None and found.inliers > 50
        error = log(inverse(found.T_first_second) @ MOVED)
        assert np.linalg.norm(error[3:]) < 0.15 and np.linalg.norm(error[:3]) < 0.01
        nees.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(nees) < 6.0  # features do not slide here, which the covariance allows for


def test_an_old_keyframe_is_corrected_by_what_is_known_of_the_rig_now():
    model, error = RigModel(RIG), np.zeros(len(RigModel.names))
    error[[model.names.index("left_f"), model.names.index("right_f")]] = 0.01
    nothing, known = RigCorrection(model, 0 * error), RigCorrection(model, error)
    points, descriptors = world(0)
    old = keyframe(wrong(view(np.eye(4), points, descriptors, 0), nothing, known))
    old = replace(old, correction=nothing)
    seen = view(MOVED, points, descriptors, 1)
    errors = []
    for one in (old, old.corrected(known, RIG)):
        found = verify(one, seen, (0, 1), RIG, LOCALIZER, 1)
        assert found is not None
        errors.append(np.linalg.norm(log(inverse(MOVED) @ found.T_first_second)[3:]))
    assert errors[1] < 0.02 < 0.06 < errors[0]


def wrong(features: StereoFeatures, nothing: RigCorrection, known: RigCorrection) -> StereoFeatures:
    """Features as a rig measures them whose error is not corrected."""
    z = Revision(known, nothing).rows(np.column_stack([features.uv_left, features.uv_right[:, 0]]))
    return replace(features, uv_left=z[:, :2].copy(), uv_right=z[:, [2, 1]].copy())


@pytest.mark.parametrize("count", [40, 120])
def test_features_that_slid_make_it_less_sure(count: int):
    """From another viewpoint each feature is found at another point of its surface, by three times the pixel noise."""
    nees, narrow = [], []
    for seed in range(60):
        rng, points = np.random.default_rng(seed), world(seed)[0][:count]
        moved, _ = RIG.project_stereo(transform(inverse(MOVED), points), jacobian=False)
        good = np.isfinite(moved).all(axis=1)
        slid = moved + rng.normal(0, 3 * SIGMA, moved.shape)
        T, P = refined_pose(RIG, points[good], slid[good], MOVED, SIGMA)
        error = log(inverse(T) @ MOVED)
        nees.append(error @ np.linalg.solve(P, error))
        T, P = refined_pose(RIG, points[good], moved[good], MOVED, SIGMA)
        narrow.append(error @ np.linalg.solve(P, error))
    assert np.mean(narrow) > 12  # by the pixels' and the depths' noise alone
    assert 3.5 < np.mean(nees) < 9.0


def test_another_place_is_not_the_same():
    old = keyframe(view(np.eye(4), *world(0), 0))
    for seed in range(1, 11):
        assert verify(old, view(MOVED, *world(seed), seed), (0, 1), RIG, LOCALIZER, seed) is None


def test_matches_in_one_spot_are_not_enough(monkeypatch):
    _, descriptors = world(0)
    rng = np.random.default_rng(0)
    spot = np.column_stack([rng.uniform(0, 0.5, 300), rng.uniform(0, 0.5, 300), rng.uniform(9, 10, 300)])
    old, seen = keyframe(view(np.eye(4), spot, descriptors, 0)), view(MOVED, spot, descriptors, 1)
    assert verify(old, seen, (0, 1), RIG, LOCALIZER, 0) is None
    monkeypatch.setattr(AtlasConfig, "spread", 0.0)
    assert verify(old, seen, (0, 1), RIG, LOCALIZER, 0) is not None


@pytest.mark.parametrize(("motion", "changed"), [
    (np.zeros(6), False),
    ([0, 0, 0, 0, 0, 5.0], True),
    ([0, 0, 0, 0, 0, 0.5], False),
    ([0, 1.0, 0, 0, 0, 0], True),
])  # fmt: skip
def test_a_keyframe_where_the_view_has_changed(motion: list[float], changed: bool):
    old = keyframe(view(np.eye(4), *world(0), 0))
    assert view_has_changed(old, exp(np.array(motion, float)), RIG) == changed


def test_what_was_added_is_never_negative():
    a, b = np.random.default_rng(0).normal(size=(2, 6, 6))
    P, Q = a @ a.T, b @ b.T
    np.testing.assert_allclose(covariance_growth(P + Q, P), Q, atol=1e-10)
    assert np.linalg.eigvalsh(covariance_growth(P, P + 0.5 * Q)).max() < 1e-10
    assert np.abs(covariance_growth(P, P)).max() == 0
    P[2] = P[:, 2] = 0.0  # as where two huge covariances were subtracted
    assert np.isfinite(covariance_growth(P, Q)).all()
    assert np.abs(covariance_growth(0 * P, 0 * P)).max() == 0


def test_a_keyframe_whose_points_tell_no_pose_is_no_place_seen_again():
    old, seen = keyframe(view(np.eye(4), *world(0), 0)), view(MOVED, *world(0), 1)
    assert verify(old, seen, (0, 1), RIG, LOCALIZER, 0) is not None
    false = replace(old, points=-old.points)  # behind the camera
    assert verify(false, seen, (0, 1), RIG, LOCALIZER, 0) is None


def similar_places(count: int) -> np.ndarray:
    """Places (count, 200, 16) like shelves of books: all show the same few kinds of features, in other variations."""
    rng = np.random.default_rng(5)
    kinds = rng.normal(size=(4, 16))
    variations = kinds[rng.integers(0, 4, (count, 200))] + 0.8 * rng.normal(size=(count, 200, 16))
    return (variations / np.linalg.norm(variations, axis=2, keepdims=True)).astype(np.float32)


def test_the_first_places_are_found_as_well_as_later_ones():
    """From elsewhere: 30 of a place's 200 descriptors, somewhat changed, and as many more of another place."""
    every, index = similar_places(90), PlaceIndex()
    for some in every[:70]:
        index = index.with_new(some.astype(np.float16))
    ranks = []
    for k in range(70):
        rng = np.random.default_rng(k)
        same = every[k][rng.choice(200, 30, replace=False)] + 0.1 * rng.normal(size=(30, 16))
        seen = np.concatenate([same, every[70 + k % 20, :170]]).astype(np.float32)
        order = np.argsort(-index.similarity(seen), kind="stable")
        ranks.append(int(np.flatnonzero(order == k)[0]))
    compared = np.array(ranks) < 8  # as many are compared in detail
    assert compared[:16].mean() > 0.75  # 0.94; of words from the first keyframes alone 0.56
    assert compared.mean() > 0.75
