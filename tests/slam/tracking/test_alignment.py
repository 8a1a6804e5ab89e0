"""Features aligned to their first sight: the geometry, the bookkeeping, and what it is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.data import IdArray
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.interfaces import Patches
from slam.landmarks import LandmarkRows
from slam.tracking.alignment import Anchors, warps_of

RIG = StereoRig.rectified_pair(260.0, 160.0, 120.0, 0.12, 320, 240)


def patches(count: int, value: float = 0.0) -> Patches:
    return Patches(np.full((count, 5, 5), value, np.float32), np.full((count, 2), 2.0), np.full(count, 15.0))


def rows(ids: IdArray, unseen: IdArray) -> LandmarkRows:
    empty = LandmarkRows.empty(4).with_new(0, ids, _features(len(ids)), np.arange(len(ids)))
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
    anchors = Anchors.none().with_new(np.array([3, 7]), patches(2), np.eye(4))
    anchors = anchors.with_new(np.array([5, 7]), patches(2, 1.0), np.eye(4))
    assert anchors.ids.tolist() == [3, 5, 7]
    assert anchors.patches.images[:, 0, 0].tolist() == [0, 1, 1]
    known = anchors.known(rows(np.array([3, 4, 7]), np.array([0, 0, 50])))
    assert known.ids.tolist() == [3]  # 5 is not in the map, 7 was not measured for long
    assert not len(anchors.known(LandmarkRows.empty(4)))


@pytest.mark.parametrize("backend", ["ekf", "smoother"])
def test_features_slide_less(backend):
    """Reprojection errors of the true path are half as large; all else is the same."""
    sequence = slam.open_sequence("synthetic:desk?frames=12")
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
