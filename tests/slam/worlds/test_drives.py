"""Drives along paths of files, and the streets beside them."""

from pathlib import Path

import numpy as np
import pytest

from slam.errors import SequenceError
from slam.geometry.se3 import inverse
from slam.geometry.trajectory import Trajectory
from slam.sequences import open_sequence
from slam.worlds import WorldSequence, open_world
from slam.worlds.paths import camera_poses


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its 8 columns must be stamp tx ty tz qx qy qz qw"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", r"a path of 0\.0 m in 1 poses; a drive needs 10 m to 100 km"),
        ("1 0 0 0 0 0 0 0 0 0 1 0\n", "the pose of row 0 has no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n-1 0 0 0 0 -1 0 0 0 0 1 20\n", "y axis must point downwards"),
    ],
)
def test_what_is_no_path_is_refused_in_one_line(tmp_path, text, message):
    file = tmp_path / "path.txt"
    file.write_text(text)
    with pytest.raises(SequenceError, match=message) as caught:
        open_sequence(f"synthetic:drive?path={file}")
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


LAP = 450  # frames of a round in `loop`


@pytest.fixture(scope="session")
def loop(tmp_path_factory) -> Path:
    """A file with two rounds of a circle of 450 m in KITTI's axes, on a slope; the second one repeats the first."""
    angle = 2 * np.pi * np.arange(2 * LAP) / LAP
    radius = LAP / (2 * np.pi)
    positions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 2 * np.sin(angle)])
    zero = np.zeros(2 * LAP)
    poses = camera_poses(positions, angle, zero, zero)
    file = tmp_path_factory.mktemp("paths") / "loop.txt"
    Trajectory(np.arange(2.0 * LAP), inverse(poses[0]) @ poses).write_kitti(file)
    return file


def opened(loop: Path, query: str = "") -> WorldSequence:
    return open_world(f"drive?path={loop}&{query}")


def test_a_round_later_the_same_landmarks_are_seen(loop):
    sequence = opened(loop, "change=0&outliers=0&clutter=0&detect=1&sigma=0&descriptor_noise=0")
    for k in (0, 100):
        first, later = (sequence.simulate(n) for n in (k, k + LAP))
        assert len(first.ids) > 80
        a, b = np.argsort(first.ids), np.argsort(later.ids)
        assert np.array_equal(first.ids[a], later.ids[b])
        assert np.allclose(first.features.uv_left[a], later.features.uv_left[b], atol=1e-4)
        assert np.allclose(first.features.descriptors[a], later.features.descriptors[b], atol=1e-4)


def test_a_wrong_calibration_is_told_and_the_true_one_records():
    right, wrong = open_world("town?sigma=0"), open_world("town?sigma=0&focal_error=0.005&turn_error=1")
    assert wrong.rig is right.rig
    assert wrong.world.rig.left.fu == pytest.approx(right.rig.left.fu / 1.005)
    turned = wrong.world.rig.R @ right.rig.R.T
    assert np.allclose([turned[2, 1], turned[0, 2], turned[1, 0]], 1e-3, atol=2e-6)
    a, b = right.simulate(40), wrong.simulate(40)
    ids, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    still = ids >= 0
    centre = right.rig.left.u0, right.rig.left.v0
    ratio = (a.features.uv_left[i[still]] - centre) / (b.features.uv_left[j[still]] - centre)
    assert np.allclose(np.median(ratio, axis=0), 1.005, atol=1e-4)
