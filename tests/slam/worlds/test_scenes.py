"""The built-in worlds, and one that is written and read back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.geometry.se3 import inverse, rotation_angle
from slam.sequences import Sequence, open_sequence
from slam.worlds import indoors, names, open_world
from slam.worlds.export import write_euroc

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


WRITTEN = range(50, 58)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A world with faults, and the folder that it was written to."""
    sequence = open_world("box?frames=60&rig=toedin&dropright=53&drop=54")
    folder = tmp_path_factory.mktemp("euroc") / "run"
    told = []
    write_euroc(sequence, folder, WRITTEN.start, WRITTEN.stop, told.append)
    assert told == list(range(1, 9))
    return sequence, folder


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_exported_world_is_read_back_as_it_was(written):
    sequence, folder = written
    read = open_sequence(folder)
    assert read.format == "euroc"
    assert (folder / "mav0/world.txt").read_text() == f"synthetic:{sequence.name}\n"
    assert read.rig.left == sequence.rig.left and read.rig.right == sequence.rig.right
    assert np.allclose(read.rig.R, sequence.rig.R, atol=1e-15) and np.allclose(read.rig.b, sequence.rig.b, atol=1e-15)
    assert np.allclose(read.ground_truth.poses, sequence.ground_truth.poses[WRITTEN], atol=1e-8)
    assert np.allclose(read.ground_truth.stamps, sequence.stamps[WRITTEN], atol=1e-9)
    for frame, k in zip(read, WRITTEN, strict=True):
        original = sequence.frame(k)
        assert frame.stamp == pytest.approx(original.stamp, abs=1e-9)
        assert np.array_equal(frame.left, original.left)
        assert np.array_equal(frame.right, original.right) or frame.right is original.right is None
