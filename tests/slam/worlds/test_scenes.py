from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.geometry.se3 import inverse, rotation_angle
from slam.sequences import Sequence, open_sequence
from slam.worlds import indoors, names, open_world

WITHOUT_A_FILE = [name for name in names() if name != "drive"]


@pytest.mark.parametrize("name", WITHOUT_A_FILE)
def test_every_world_is_a_sequence_moves_smoothly_and_shows_landmarks_in_every_frame(name):
    sequence = open_sequence(f"synthetic:{name}")
    assert isinstance(sequence, Sequence)
    assert sequence.format == "synthetic"
    assert sequence.warnings == []
    truth = sequence.ground_truth
    assert len(truth) == len(sequence) == len(sequence.stamps)
    rate = sequence.values["rate"]
    velocity = np.diff(truth.positions, axis=0) * rate
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) * rate
    assert acceleration.max() < 6.0, "a hand or a car does not jerk harder [m/s²]"
    turn = rotation_angle(inverse(truth.poses[:-1])[:, :3, :3] @ truth.poses[1:, :3, :3]) * rate
    assert turn.max() < 2.0
    for k in np.linspace(0, len(sequence) - 1, 12).astype(int):
        seen = sequence.simulate(k)
        assert len(seen.features) >= 15
        assert seen.features.has_stereo.sum() >= 10


def test_the_aisle_is_paper_a_s():
    sequence = open_world("aisle")
    assert len(sequence) == 1524
    assert sequence.values["rate"] == 30
    assert (sequence.rig.width, sequence.rig.height, sequence.rig.baseline) == (320, 240, 0.12)
    path = sequence.ground_truth.positions
    assert path[-1, 0] - path[0, 0] == pytest.approx(indoors.AISLE_LENGTH, abs=0.05)
    distance = indoors.SHELF_Y - path[:, 1]
    assert 0.8 <= distance.min() < 1.0 < distance.max() <= 1.5
    forward = sequence.ground_truth.poses[:, :3, 2]
    assert (forward[:, 0] > 0.3).all() and (forward[:, 1] > 0.3).all(), "along the shelves and towards them"


def test_box_stands_at_the_places_of_table_1():
    sequence = open_world("box")
    pause = round((indoors.REST + indoors.MOVE) * 30)
    for i, (x, y, z, yaw, pitch, roll) in enumerate(indoors.PLACES):
        T = sequence.objects(i * pause + 30)[0]
        assert np.allclose(T[:3, 3], (x, y, z), atol=1e-12)
        R = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        assert np.allclose(T[:3, :3], R, atol=1e-12)
        assert np.array_equal(T, sequence.objects(i * pause + 31)[0]), "it stands still there"
