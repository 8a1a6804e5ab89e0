"""What a body gives to its points: where it takes young ones, how deep it is, and what is left of one given up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.bodies.belief import shape_of, slid
from slam.bodies.estimator import FRAMES
from slam.window.problem import Motion
from slam.window.stereo import RectifiedStereo
from tests.slam.bodies.body_scene import box_scene
from tests.slam.bodies.body_scene import follow as follow_body


def test_the_noise_of_depth_is_no_extent():
    rng = np.random.default_rng(0)
    noise = np.array([0.02, 0.02, 0.6])
    points = rng.uniform(-1, 1, (400, 3)) + noise * rng.standard_normal((400, 3))
    shape = shape_of(points, np.tile(np.diag(noise**2), (400, 1, 1)))
    assert np.diag(shape.covariance) == pytest.approx([1 / 3] * 3, rel=0.25)  # with the noise: 0.69 in depth


def test_a_point_that_was_given_up_leaves_with_all_its_measurements():
    """They are in what is known of the others from then on: kept as well, they would count twice."""
    scene_ = box_scene(0, FRAMES + 3)
    *_, (_, b, _) = follow_body("ekf", scene_)
    member = next(p for p in b.prior.points.tolist() if (b.rows.point == p).any() and b.points.ids[p] >= 0)
    ids = b.points.ids.copy()
    ids[member] = -1
    given_up = replace(b, points=replace(b.points, ids=ids))
    after = slid(given_up, RectifiedStereo.of(scene_.rig), Motion.none(), 0.0)
    assert b.points.ids[member] not in after.points.ids
    assert len(after.points) == len(slid(b, RectifiedStereo.of(scene_.rig), Motion.none(), 0.0).points) - 1
