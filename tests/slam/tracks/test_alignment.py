"""Features aligned to their first sight: the geometry, the bookkeeping, and what it is worth."""

from dataclasses import replace

import numpy as np
import pytest

import slam
from slam.data import IdArray, ImagePair, Patches
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.tracks.alignment import Aligner, warps_of
from slam.tracks.step import LandmarkMatches
from slam.tracks.table import STILL, LandmarkTable, Patch
from tests.slam.scene import features_at

RIG = StereoRig.rectified_pair(260.0, 160.0, 120.0, 0.12, 320, 240)


def rows(ids: IdArray, T: np.ndarray | None = None, size: float = 15.0, body: int = STILL) -> LandmarkTable:
    """Landmarks, with patches taken from a pose in a body or the world."""
    features = alike(len(ids))
    landmarks = LandmarkTable(ids, features.descriptors, features.laplacian)
    if T is not None:
        landmarks.patches[:] = Patch(np.zeros((5, 5), np.float32), np.full(2, 2.0), size, body, T)
    return landmarks


def alike(count: int) -> slam.StereoFeatures:
    uv = np.zeros((count, 2))
    return features_at(uv, uv, np.tile(np.float32([1, 0, 0, 0]), (count, 1)))


def test_warps_are_the_derivative_of_a_surface_that_faces_the_camera():
    rng = np.random.default_rng(2)
    now = se3.exp(rng.normal(0, 0.1, 6))
    then = se3.exp(rng.normal(0, 0.1, 6))
    points = np.column_stack([rng.uniform(-1, 1, (5, 2)), rng.uniform(4, 9, 5)])
    warps = warps_of(RIG, np.tile(then, (5, 1, 1)), now, points)
    local = se3.transform(se3.inverse(now), points)
    for k in range(2):
        side = np.zeros(3)
        side[k] = 1e-4
        moved = se3.transform(now, local + side * local[:, 2:] / RIG.left.fu)  # so many pixels beside it, at its depth
        places = [RIG.left.project(se3.transform(se3.inverse(then), p)) for p in (points, moved)]
        assert warps[:, :, k] == pytest.approx((places[1] - places[0]) / 1e-4, abs=1e-4)


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
    return replace(alike(4), uv_left=uv, uv_right=uv_right, scale=np.full(4, 15.0), images=pair)


AT = np.arange(4)
ALIGNER = Aligner(RIG, Shifting())


def align(features: slam.StereoFeatures, landmarks: LandmarkTable, body: int = STILL) -> slam.StereoFeatures:
    return ALIGNER.align(features, SEEN.rows, landmarks, AT, np.eye(4), POINTS, body)


@pytest.mark.parametrize("right", [True, False])
def test_features_move_to_their_patches_also_without_a_right_image(right):
    features = frame(right)
    landmarks = rows(IDS, np.eye(4))
    aligned = align(features, landmarks)
    np.testing.assert_allclose(aligned.uv_left, features.uv_left + SHIFT)
    np.testing.assert_allclose(aligned.uv_right, features.uv_right + SHIFT)
    assert landmarks.has_patch(AT).all()


@pytest.mark.parametrize(("nearer", "size", "moves"), [(0.0, 0.0, 0), (2.5, 15.0, 0), (-1.6, 15.0, 1)])
def test_a_patch_that_is_not_found_or_of_another_scale_is_taken_anew(nearer, size, moves):
    """Also where it is found, before it is too large: the last ones are seen 1.23 to 1.4 times as large."""
    then, features = np.eye(4), frame()
    then[2, 3] = nearer
    landmarks = rows(IDS, then, size)
    aligned = align(features, landmarks)
    np.testing.assert_allclose(aligned.uv_left, features.uv_left + moves * SHIFT)
    assert not landmarks.has_patch(AT).any()
    ALIGNER.take_patches(aligned, SEEN.rows, landmarks, AT, np.eye(4))
    assert [(p.size, p.T_left.tolist()) for p in landmarks.patches] == 4 * [(15.0, np.eye(4).tolist())]


def test_without_images_nothing_moves():
    landmarks = rows(IDS, np.eye(4))
    features = replace(frame(), images=None)
    assert align(features, landmarks) is features
    assert landmarks.has_patch(AT).all()


def test_members_of_a_body_move_to_patches_of_that_body_alone():
    features, landmarks = frame(), rows(IDS, np.eye(4), body=3)
    assert align(features, landmarks) is features
    np.testing.assert_allclose(align(features, landmarks, 3).uv_left, features.uv_left + SHIFT)
    ALIGNER.take_patches(features, SEEN.rows, landmarks, AT, np.eye(4), 4)
    assert landmarks.has_patch(AT, 4).all() and not landmarks.has_patch(AT, 3).any()


class Pushing(Shifting):
    """Finds patches where they are looked for, but those at certain left pixels a pixel to the right of that."""

    def __init__(self) -> None:
        self.pushed = np.zeros((0, 2))

    def align(self, images, patches, warps, uv_left, uv_right):
        there = (uv_left[:, None] == self.pushed).all(axis=2).any(axis=1)
        return uv_left + there[:, None] * SHIFT, uv_right + there[:, None] * SHIFT


def test_the_estimate_of_a_body_is_made_of_aligned_features():
    """In the last frame they move by a pixel to the right, so that is where the body goes."""
    sequence, poses = slam.open_sequence("synthetic:box?density=300&camera=moving&sigma=0.3"), []
    image = np.zeros((sequence.rig.height, sequence.rig.width), np.float32)
    for pushed in (False, True):
        frontend = Pushing()
        system = slam.StereoSlam(sequence.rig, frontend, "ekf", kind=sequence.kind)
        for k in range(50, 81):
            seen = sequence.simulate(k)
            if pushed and k == 80:
                frontend.pushed = seen.features.uv_left[seen.objects == 1]
            result = system.process_features(replace(seen.features, images=ImagePair(image, image)))
        camera, body = result.estimate.T_world_left, result.objects[0].estimate.T_world_object
        poses.append(se3.inverse(camera) @ body)
    step = poses[1][:3, 3] - poses[0][:3, 3]
    assert step == pytest.approx([poses[0][2, 3] / sequence.rig.left.fu, 0, 0], abs=5e-4)


def test_patches_of_landmarks_that_were_not_seen_for_long_are_given_up():
    features, landmarks = frame(), rows(IDS, np.eye(4))
    landmarks.unseen[:] = [0, 11, 0, 10]
    aligned = align(features, landmarks)
    assert landmarks.has_patch(AT).tolist() == [True, False, True, True]
    moved = np.abs(aligned.uv_left - features.uv_left).max(axis=1) > 0
    assert moved[SEEN.rows].tolist() == [True, False, True, True]
