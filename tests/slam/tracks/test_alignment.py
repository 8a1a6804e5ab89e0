"""Features aligned to their first sight: the geometry, the bookkeeping, and what it is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.data import IdArray, ImagePair, Patches
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.tracks.alignment import Aligner, PatchAnchors, warps_of
from slam.tracks.localizer import LandmarkMatches
from slam.tracks.table import LandmarkTable

RIG = StereoRig.rectified_pair(260.0, 160.0, 120.0, 0.12, 320, 240)


def patches(count: int, value: float = 0.0) -> Patches:
    return Patches(np.full((count, 5, 5), value, np.float32), np.full((count, 2), 2.0), np.full(count, 15.0))


def rows(ids: IdArray, unseen: IdArray) -> LandmarkTable:
    empty = LandmarkTable.empty(4).with_new(0, ids, _features(len(ids)), np.arange(len(ids)))
    return replace(empty, unseen=unseen)


def _features(count: int) -> slam.StereoFeatures:
    z = np.zeros(count)
    looks = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    return slam.StereoFeatures(0.0, np.zeros((count, 2)), np.zeros((count, 2)), z, z, z, z.astype(np.int8), looks)


def test_warps_are_the_derivative_of_a_surface_that_faces_the_camera():
    rng = np.random.default_rng(2)
    now = se3.exp(rng.normal(0, 0.1, 6))
    then = se3.exp(rng.normal(0, 0.1, 6))
    points = np.column_stack([rng.uniform(-1, 1, (5, 2)), rng.uniform(4, 9, 5)])
    warps = warps_of(RIG.rectified, np.tile(then, (5, 1, 1)), now, points)
    local = se3.transform(se3.inverse(now), points)
    for k in range(2):
        side = np.zeros(3)
        side[k] = 1e-4
        moved = se3.transform(now, local + side * local[:, 2:] / RIG.left.fu)  # so many pixels beside it, at its depth
        places = [RIG.left.project(se3.transform(se3.inverse(then), p)) for p in (points, moved)]
        assert warps[:, :, k] == pytest.approx((places[1] - places[0]) / 1e-4, abs=1e-4)


def test_anchors_are_replaced_and_given_up():
    anchors = PatchAnchors.none().with_new(np.array([3, 7]), patches(2), np.eye(4))
    anchors = anchors.with_new(np.array([5, 7]), patches(2, 1.0), np.eye(4))
    assert anchors.ids.tolist() == [3, 5, 7]
    assert anchors.patches.images[:, 0, 0].tolist() == [0, 1, 1]
    known = anchors.known(rows(np.array([3, 4, 7]), np.array([0, 0, 50])))
    assert known.ids.tolist() == [3]  # 5 is not in the map, 7 was not measured for long
    assert not len(anchors.known(LandmarkTable.empty(4)))


SHIFT = np.array([1.0, 0.0])  # [px]


class Shifting:
    """Finds every patch a pixel to the right of where it is looked for, but for those of features without a size."""

    def extract(self, frame: slam.StereoFrame) -> slam.StereoFeatures:
        return slam.StereoFeatures.empty(frame.stamp)

    def patches(self, images, uv_left, size):
        return Patches(np.zeros((len(size), 5, 5), np.float32), np.full((len(size), 2), 2.0), size)

    def align(self, images, patches, warps, uv_left, uv_right):
        found = np.where(patches.size > 0, 1.0, np.nan)[:, None] * SHIFT
        return uv_left + found, uv_right + found


IDS = np.array([2, 5, 8, 9])
POINTS = np.array([[-1.0, 0.5, 6.0], [0.3, -0.4, 5.0], [0.8, 0.2, 7.0], [-0.2, -0.6, 4.0]])
SEEN = LandmarkMatches(IDS, np.array([3, 0, 2, 1]), np.eye(4))


def frame(right: bool = True) -> slam.StereoFeatures:
    """The points as features, in the order of `SEEN`, with images of no content."""
    uv = np.zeros((4, 2))
    uv[SEEN.rows] = RIG.left.project(POINTS)
    image = np.zeros((240, 320), np.float32)
    uv_right = uv - [10.0, 0.0] if right else np.full((4, 2), np.nan)
    pair = ImagePair(image, image if right else None)
    return replace(_features(4), uv_left=uv, uv_right=uv_right, scale=np.full(4, 15.0), images=pair)


def align(features: slam.StereoFeatures, anchors: PatchAnchors, seen: LandmarkMatches = SEEN, enabled: bool = True):
    landmarks = rows(IDS, np.zeros(4, np.int64))
    places = dict(zip(IDS.tolist(), POINTS))
    aligner = Aligner(RIG, enabled)
    return aligner.align(
        Shifting(), anchors, features, seen, landmarks, lambda ids: np.array([places[i] for i in ids.tolist()])
    )


def anchors_at(T: np.ndarray, size: float = 15.0) -> PatchAnchors:
    return PatchAnchors.none().with_new(IDS, replace(patches(4), size=np.full(4, size)), T)


@pytest.mark.parametrize("right", [True, False])
def test_features_move_to_their_patches_also_without_a_right_image(right):
    features = frame(right)
    aligned = align(features, anchors_at(np.eye(4)))
    np.testing.assert_allclose(aligned.features.uv_left, features.uv_left + SHIFT)
    np.testing.assert_allclose(aligned.features.uv_right, features.uv_right + SHIFT)
    assert aligned.anchors.ids.tolist() == IDS.tolist()


def test_a_feature_that_has_no_right_pixel_is_aligned_in_the_left_image():
    features = frame()
    features.uv_right[2] = np.nan
    aligned = align(features, anchors_at(np.eye(4)))
    np.testing.assert_allclose(aligned.features.uv_left, features.uv_left + SHIFT)
    np.testing.assert_allclose(aligned.features.uv_right, features.uv_right + SHIFT)
    assert aligned.anchors.ids.tolist() == IDS.tolist()


@pytest.mark.parametrize("nearer,size", [(0.0, 0.0), (2.5, 15.0)])
def test_a_patch_that_is_not_found_or_of_another_scale_is_taken_anew(nearer, size):
    then, features = np.eye(4), frame()
    then[2, 3] = nearer
    aligned = align(features, anchors_at(then, size))
    np.testing.assert_array_equal(aligned.features.uv_left, features.uv_left)
    assert not len(aligned.anchors)
    new = Aligner(RIG, True).anchored(Shifting(), aligned, SEEN, LandmarkMatches.nothing(), np.eye(4))
    assert new.ids.tolist() == IDS.tolist() and (new.patches.size == 15.0).all()
    np.testing.assert_array_equal(new.poses, np.tile(np.eye(4), (4, 1, 1)))


def test_a_patch_that_is_seen_larger_is_taken_anew_where_it_is_found_before_it_is_too_large():
    then, features = np.eye(4), frame()
    then[2, 3] = -1.6  # all are seen 1.23 to 1.4 times as large
    aligned = align(features, anchors_at(then))
    np.testing.assert_allclose(aligned.features.uv_left, features.uv_left + SHIFT)
    assert not len(aligned.anchors)


def test_without_a_pose_or_images_nothing_moves_and_switched_off_nothing_is_kept():
    features, anchors = frame(), anchors_at(np.eye(4))
    for aligned in (
        align(features, anchors, replace(SEEN, T_world_left=None)),
        align(replace(features, images=None), anchors),
    ):
        np.testing.assert_array_equal(aligned.features.uv_left, features.uv_left)
        assert len(aligned.anchors) == 4
    aligned = align(features, anchors, enabled=False)
    assert aligned.features is features and not len(aligned.anchors)


@pytest.mark.parametrize("backend", ["ekf", "smoother"])
def test_features_slide_less(backend):
    """Reprojection errors of the true path are half as large; all else is the same."""
    sequence = slam.open_sequence("synthetic:desk?frames=8")
    config = SystemConfig.for_kind(sequence.kind, "surf", backend)
    true = sequence.ground_truth.poses
    slid = {}
    for aligned in (False, True):
        association = replace(config.association, align=aligned)
        system = slam.StereoSlam(sequence.rig, backend=backend, config=replace(config, association=association))
        first: dict[int, np.ndarray] = {}  # where the landmarks are, by their first sight and the true pose
        errors = []
        for k, frame in enumerate(sequence):
            result = system.process(frame)
            assert result.features.images is None  # a result does not hold the images
            z = result.features
            known = np.array([i in first for i in result.matched.tolist()], bool)
            if known.any():
                points = np.array([first[i] for i in result.matched[known].tolist()])
                expected = sequence.rig.left.project(se3.transform(se3.inverse(true[k]), points))
                errors.append(np.linalg.norm(z.uv_left[result.matched_features[known]] - expected, axis=1))
            rows = result.added_features
            world = se3.transform(true[k], sequence.rig.triangulate(z.uv_left[rows], z.uv_right[rows]))
            first |= dict(zip(result.added.tolist(), world))
        slid[aligned] = np.median(np.concatenate(errors))
    assert slid[True] < 0.7 * slid[False]
