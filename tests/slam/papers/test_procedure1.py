import numpy as np
import pytest

from slam.errors import ConfigurationError
from slam.geometry.se3 import angles, exp, inverse, log, pose, rotation, transform
from slam.papers.procedure1 import ObjectDatabase, body_frame, detect, makes_frame, motion_covariance, placed
from tests.slam.scene import RIG, features_at

POINTS = np.array([[0.0, 0.1, 1.5], [0.2, 0.12, 1.55], [0.05, 0.25, 1.45], [0.15, 0.2, 1.6]])
MOTION = pose(rotation(np.radians([-35.0, -15.1, 5.8])), np.array([0.1, -0.05, 0.2]))


def features_of(points, response=(4.0, 3.0, 2.0, 1.0)):
    n = len(points)
    return features_at(*RIG.project(points), np.eye(n, 16, dtype=np.float32), response=np.array(response[:n]))


def test_body_frame_is_as_printed():
    A, B, C = POINTS[:3]
    R = body_frame(A, B, C)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R[:, 0], (B - A) / np.linalg.norm(B - A))
    y = np.cross(B - A, C - A)
    np.testing.assert_allclose(R[:, 1], y / np.linalg.norm(y), atol=1e-12)


def test_detects_the_motion_and_prints_rpy():
    database = ObjectDatabase.of(features_of(POINTS), np.arange(4), RIG, np.eye(4))
    moved = transform(MOTION, POINTS)
    features = features_of(moved)
    matches = (np.arange(4), np.arange(4))
    triple = detect(features, matches, moved, database)
    np.testing.assert_array_equal(triple, [0, 1, 2])  # the largest determinants
    np.testing.assert_array_equal(database.origin, POINTS[0])
    T = placed(moved[triple], database.points[triple], POINTS[3])
    np.testing.assert_allclose(np.degrees(angles(T[:3, :3])), [-35.0, -15.1, 5.8], atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], moved[3], atol=1e-9)


@pytest.mark.parametrize(
    ("points", "good"),
    [
        ([[0, 0, 1], [0.1, 0, 1], [0.2, 0.001, 1]], False),  # collinear
        ([[0, 0, 1], [0.01, 0, 1], [0.2, 0.2, 1]], False),  # two close together
        ([[0, 0, 1], [0.1, 0, np.nan], [0.2, 0.2, 1]], False),
        ([[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]], True),
    ],
)
def test_degenerate_triples_are_refused(points, good):
    assert makes_frame(np.array(points, float)) is good


def test_next_triple_is_taken_where_the_first_is_degenerate():
    points = np.array([[0, 0, 1.0], [0.1, 0, 1], [0.2, 0.001, 1], [0.1, 0.15, 1.1]])
    database = ObjectDatabase.of(features_of(points), np.arange(4), RIG, np.eye(4))
    assert 3 in detect(features_of(points), (np.arange(4), np.arange(4)), points, database)
    assert not len(detect(features_of(points), (np.arange(2), np.arange(2)), points[:2], database))


def test_covariance_agrees_with_monte_carlo():
    rng = np.random.default_rng(1)
    current = transform(MOTION, POINTS[:3])
    noise = np.array([np.diag([1e-6, 2e-6, 5e-6])] * 3)
    P = motion_covariance(current, POINTS[:3], POINTS[0], noise)
    T = placed(current, POINTS[:3], POINTS[0])
    errors = []
    for _ in range(2000):
        moved = current + rng.standard_normal((3, 3)) * np.sqrt([1e-6, 2e-6, 5e-6])
        errors.append(log(inverse(T) @ placed(moved, POINTS[:3], POINTS[0])))
    # 2000 samples: 3 % on a deviation, 6 % on a variance; four times that is allowed.
    np.testing.assert_allclose(np.diag(np.cov(np.array(errors).T)), np.diag(P), rtol=0.25)


def test_database_is_saved_and_read(tmp_path):
    database = ObjectDatabase.of(features_of(POINTS), np.arange(4), RIG, exp(np.array([0, 0.1, 0, 1, 0, 0])))
    database.save(tmp_path / "box.npz")
    again = ObjectDatabase.load(tmp_path / "box.npz")
    np.testing.assert_array_equal(again.points, database.points)
    with pytest.raises(ConfigurationError, match=r"none\.npz"):
        ObjectDatabase.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_bytes(b"no numbers")
    with pytest.raises(ConfigurationError, match=r"text\.npz: damaged"):
        ObjectDatabase.load(tmp_path / "text.npz")
    with pytest.raises(ConfigurationError, match="3 are needed"):
        ObjectDatabase.of(features_of(POINTS), np.arange(2), RIG, np.eye(4))
