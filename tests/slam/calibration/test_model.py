"""What errors of a rig do to its pixels, and what a pair of views tells of them."""

from dataclasses import replace

import numpy as np
import pytest

from slam.calibration import Revision, RigCorrection, RigModel
from slam.calibration.pairs import Pair, View, fit_motion, match, move, noise_variances, pair_evidence, pair_of
from slam.calibration.posterior import prior_information
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from tests.slam.calibration.drives import CAR, Street, parameters
from tests.slam.numeric import jacobian
from tests.slam.scene import GENERAL_RIG, features_at

MODEL = RigModel(CAR)
F = MODEL.focal


def cloud(count=200, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-6, 6, count), rng.uniform(-2, 2, count), rng.uniform(9, 60, count)])


def other_rig(turn=(0, 0, 0), down=0.0, forward=0.0, **camera):
    """The car's rig with the right camera turned [rad] and moved, or with another right camera."""
    kind = {"model": "radtan"} if "distortion" in camera else {}
    right = replace(CAR.right, **camera, **kind)
    b = CAR.b + CAR.baseline * np.array([0, -down, -forward])
    return StereoRig(CAR.left, right, se3.so3_exp(np.array(turn)), b)


A = 1e-3
TRUE_RIGS = {
    "pitch": other_rig(turn=(-A, 0, 0)),
    "yaw": other_rig(turn=(0, -A, 0)),
    "roll": other_rig(turn=(0, 0, -A)),
    "down": other_rig(down=A),
    "forward": other_rig(forward=A),
    "right_cx": other_rig(u0=CAR.right.u0 - A * F),
    "right_cy": other_rig(v0=CAR.right.v0 - A * F),
    "right_f": other_rig(fu=F / (1 + A), fv=F / (1 + A)),
    "right_aspect": other_rig(fv=F / (1 + A)),
    "right_k1": other_rig(distortion=(-A, 0.0, 0.0, 0.0)),
    "right_k2": other_rig(distortion=(0.0, -A, 0.0, 0.0)),
    "right_p1": other_rig(distortion=(0.0, 0.0, -A, 0.0)),
    "right_p2": other_rig(distortion=(0.0, 0.0, 0.0, -A)),
}


@pytest.mark.parametrize("name", TRUE_RIGS)
def test_a_parameter_corrects_the_error_that_it_is_named_after(name):
    """What a rig with the error sees, corrected, is what the ideal one sees, but for a turn of both cameras."""
    points = cloud()
    left, right = TRUE_RIGS[name].project(points)
    z = np.column_stack([left, right[:, 0]])
    theta = parameters(**{name: A})
    measured = MODEL.points(z)
    vertical = right[:, 1] - left[:, 1] + MODEL.field(measured)[:, 3] @ theta
    np.testing.assert_allclose(vertical, 0, atol=4e-3)
    ideal, _ = CAR.project_stereo(points)
    np.testing.assert_allclose(measured + MODEL.field(measured)[:, :3] @ theta, MODEL.points(ideal), atol=6e-3)
    assert max(np.abs(z - ideal).max(), np.abs(right[:, 1] - left[:, 1]).max()) > 0.025


@pytest.mark.parametrize("name", ["left_cx", "left_cy"])
def test_a_shift_of_the_left_image_does_not_turn_the_rig(name):
    change = MODEL.field(MODEL.far())[:, :2] @ parameters(**{name: 0.01})
    assert np.abs(change.mean(axis=0)).max() < 0.05 * 0.01 * F  # the image as a whole stays where it is


@pytest.mark.parametrize("rig", [CAR, GENERAL_RIG], ids=["rectified", "general"])
def test_features_are_corrected_and_revised(rig):
    model = RigModel(rig)
    rng = np.random.default_rng(1)
    before, after = (RigCorrection(model, 2e-3 * rng.standard_normal(len(model.names))) for _ in range(2))
    points = rng.uniform((-2, -1, 5), (2, 1, 10), (20, 3))
    left, right = rig.rectified.rig.project(points)
    right[3] = np.nan
    features = features_at(left, right, np.ones((20, 4), np.float32))
    corrected = before.features(features)
    assert np.isnan(corrected.uv_right[3]).all() and np.isfinite(corrected.uv_left).all()
    rows = [np.column_stack([f.uv_left, f.uv_right[:, 0]]) for f in (features, corrected, after.features(features))]
    np.testing.assert_allclose(before.rows(rows[0]), rows[1], atol=1e-6)
    np.testing.assert_allclose(before.undone(rows[1]), rows[0], atol=1e-4)
    np.testing.assert_allclose(Revision(before, after).rows(rows[1]), rows[2], atol=1e-4)


NONE = parameters()
NOISE = np.diag([0.4, 0.4, 0.2]) ** 2


def test_motion_in_disparity_space_is_the_rigid_one():
    T = se3.exp(np.array([0.03, -0.1, 0.02, 0.5, 0.2, -2.0]))
    points = np.random.default_rng(0).uniform((-5, -3, 6), (5, 3, 30), (20, 3))
    x = MODEL.points(CAR.project_stereo(points)[0])
    R, t = T[:3, :3], T[:3, 3] / CAR.baseline
    moved, J_point, J_motion = move(x, R, t, F)
    there = MODEL.points(CAR.project_stereo(se3.transform(T, points))[0])
    np.testing.assert_allclose(moved, there, atol=1e-9)
    for i in range(3):
        numeric = jacobian(lambda p: move(p[None], R, t, F)[0][0], x[i])
        np.testing.assert_allclose(J_point[i], numeric, rtol=1e-5, atol=1e-5)
        numeric = jacobian(lambda xi, p=x[i]: move(p[None], se3.so3_exp(xi[:3]) @ R, t + xi[3:], F)[0][0], np.zeros(6))
        np.testing.assert_allclose(J_motion[i], numeric, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("wrong", [0, 20])
def test_a_pair_without_noise_gives_the_truth_also_where_some_matches_are_wrong(wrong):
    rng = np.random.default_rng(0)
    theta = parameters(right_cx=4e-4, yaw=-2e-3, left_k1=-3e-3, right_k1=-2e-3)
    R, t = se3.so3_exp(np.array([0.03, -0.1, 0.02])), np.array([0.5, 0.2, -3.0])
    ideal = np.column_stack([rng.uniform(-500, 500, 300), rng.uniform(-150, 150, 300), rng.uniform(0, 40, 300)])
    pair = [ideal, move(ideal, R, t, F)[0]]
    measured = [x - MODEL.field(x)[:, :3] @ theta for x in pair]
    corrected = [x + MODEL.shift(x, theta)[:, :3] for x in measured]
    corrected[1][:wrong] += rng.normal(0, 10, (wrong, 3))
    evidence = pair_evidence(MODEL, Pair(*corrected, R, t), theta, NOISE)
    strong = 1e8
    mean = np.linalg.solve(prior_information(MODEL) + strong * evidence.S, strong * evidence.e)
    far = MODEL.field(MODEL.far())[:, 2]
    np.testing.assert_allclose(far @ mean, far @ theta, atol=0.06)  # of up to 2 px


def test_views_forty_metres_apart_are_solved_from_the_poses_of_the_system():
    street, there = Street(3, count=20000, length=200), se3.exp(np.array([0, 0.1, 0, 0, 0, 40]))
    there[:3, 3] = [2.0, 0.0, 40.0]
    every = [street.features(float(k), T, most=8000, noise=0.2) for k, T in enumerate((np.eye(4), there))]
    off = se3.exp(np.array([0.01, 0.01, 0.0, 0.5, 0.0, 1.0]))  # as poses of a run that has drifted
    first = View.of(MODEL, every[0], np.eye(4), 10**6)
    second = View.of(MODEL, every[1], there @ off, 10**6)
    pair = pair_of(MODEL, first, second, NONE, NOISE, 0, match(first, second))
    assert len(pair.first) >= 30
    evidence = pair_evidence(MODEL, pair, NONE, NOISE)
    assert evidence is not None and evidence.S[MODEL.names.index("yaw")].any()
    # From no motion the same pair has no solution: that is why the poses are asked for, and such pairs are counted.
    still = Pair(pair.first, pair.second, np.eye(3), np.zeros(3))
    assert pair_evidence(MODEL, still, NONE, NOISE) is None


def noisy_views(pixel, disparity, outliers=0):
    """Points and their noisy measurements in two views, and the motion."""
    rng = np.random.default_rng(2)
    R, t = se3.so3_exp(np.array([0.0, 0.1, 0.0])), np.array([0.3, 0.0, -4.0])
    ideal = np.column_stack([rng.uniform(-500, 500, 800), rng.uniform(-150, 150, 800), rng.uniform(3, 40, 800)])
    views = [x + rng.standard_normal(x.shape) * [pixel, pixel, disparity] for x in (ideal, move(ideal, R, t, F)[0])]
    views[1][:outliers] += rng.normal(0, 30, (outliers, 3))
    return views, R, t


def test_the_noise_of_pixels_and_of_disparities_is_told_apart():
    for pixel, disparity in ((0.7, 1.0), (0.3, 0.1)):
        views, R, t = noisy_views(pixel, disparity, outliers=80)
        noise = np.diag([pixel, pixel, disparity]) ** 2
        found = np.sqrt(noise_variances(Pair(*views, R, t), F, noise))
        np.testing.assert_allclose(found, [pixel, disparity], rtol=0.2)


def test_a_motion_is_found_to_the_end():
    """Steps shrink slowly: the first small one is not near the solution."""
    views, R, t = noisy_views(0.2, 0.2)
    noise = np.diag([0.2, 0.2, 0.2]) ** 2
    near, far = (fit_motion(*views, R, t + off, F, noise) for off in (np.zeros(3), np.array([0.5, 0.3, 1.0])))
    np.testing.assert_allclose(near.moved, far.moved, atol=0.02)
    assert np.abs(near.t - t).max() < 0.1
