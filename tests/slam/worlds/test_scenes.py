from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.se3 import inverse, rotation_angle, transform
from slam.sequences import Sequence, open_sequence
from slam.worlds import names, open_world
from slam.worlds.scenes import aisle, box, boxes, people, startup, street

WITHOUT_A_FILE = [name for name in names() if name != "drive"]


@pytest.mark.parametrize("name", WITHOUT_A_FILE)
def test_every_world_keeps_the_protocol_of_sequences_and_moves_smoothly(name):
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


@pytest.mark.parametrize("name", WITHOUT_A_FILE)
def test_every_world_shows_landmarks_in_every_frame(name):
    sequence = open_world(name)
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
    assert path[-1, 0] - path[0, 0] == pytest.approx(aisle.LENGTH, abs=0.05)
    distance = aisle.SHELF_Y - path[:, 1]
    assert 0.8 <= distance.min() < 1.0 < distance.max() <= 1.5
    forward = sequence.ground_truth.poses[:, :3, 2]
    assert (forward[:, 0] > 0.3).all() and (forward[:, 1] > 0.3).all(), "along the shelves and towards them"


def test_bare_wall_starves_the_detector():
    sequence = open_world("aisle")
    counts = [len(sequence.simulate(k).features) for k in range(0, len(sequence), 50)]
    assert max(counts[20:25]) < 0.7 * np.median(counts), "the camera passes the wall in frames 1000 to 1200"


def test_speed_shortens_the_recording_but_not_the_way():
    slow, fast = open_world("aisle"), open_world("aisle?speed=4")
    assert len(fast) == len(slow) // 4
    assert fast.ground_truth.positions[-1, 0] == pytest.approx(slow.ground_truth.positions[-1, 0], abs=0.05)


def test_startup_camera_stands_where_paper_b_says_and_the_board_faces_it():
    sequence = open_world("startup?tremor=0")
    assert np.allclose(sequence.ground_truth.positions, startup.CAMERA, atol=1e-12)
    on_board = sequence.landmarks.surface == 0
    assert on_board.sum() == 24
    assert np.abs(sequence.landmarks.positions[on_board, 1]).max() < 1e-12


def test_box_stands_at_the_places_of_table_1():
    sequence = open_world("box")
    pause = round((box.REST + box.MOVE) * 30)
    for i, (x, y, z, yaw, pitch, roll) in enumerate(box.PLACES):
        T = sequence.objects(i * pause + 30).T_world_object[0]
        assert np.allclose(T[:3, 3], (x, y, z), atol=1e-12)
        a, b, c = np.deg2rad([yaw, pitch, roll])
        R = _about(2, a) @ _about(1, b) @ _about(0, c)
        assert np.allclose(T[:3, :3], R, atol=1e-12)
        assert np.array_equal(T, sequence.objects(i * pause + 31).T_world_object[0]), "it stands still there"


def _about(axis: int, angle: float) -> np.ndarray:
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[[i, j], [i, j]] = np.cos(angle)
    R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
    return R


def test_camera_options_of_the_box_worlds():
    still = open_world("box?camera=still").ground_truth
    assert np.allclose(still.poses, still.poses[0], atol=1e-12)
    assert open_world("box?camera=sway").ground_truth.length < open_world("box?camera=moving").ground_truth.length


def test_boxes_do_not_run_into_each_other_and_differ_in_velocity():
    sequence = open_world("boxes")
    corners = np.stack(np.meshgrid(*[np.linspace(0, 1, 7)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    lowest = [_lowest(body, size) for body, size in enumerate(np.array(boxes.SIZES), start=1)]
    for k in range(0, len(sequence), 10):
        T = sequence.objects(k).T_world_object
        for i, j in ((i, j) for i in range(5) for j in range(5) if i != j and {i, j} != {3, 4}):
            points = transform(inverse(T[j]) @ T[i], lowest[i] + corners * boxes.SIZES[i])
            inside = (points > lowest[j]) & (points < lowest[j] + boxes.SIZES[j])
            assert not inside.all(axis=1).any(), f"boxes {i + 1} and {j + 1} in frame {k}"
    positions = sequence.world.T_world_object[:3, :, :3, 3]
    speed = np.linalg.norm(np.diff(positions, axis=1), axis=2) * 30
    assert (speed.max(axis=1) > 0.05).all()
    assert speed[1].min() < 1e-9, "the second one stops at times"


def _lowest(body: int, size: np.ndarray) -> np.ndarray:
    return -size / 2 if body < 4 else np.array([-size[0] / 2, -size[1], -size[2] if body == 4 else 0.0])


def test_the_hinge_holds_the_two_parts_together():
    T = open_world("boxes").world.T_world_object
    lower, lid = T[3], T[4]
    relative = inverse(lower) @ lid
    assert np.allclose(relative[:, :3, 3], 0, atol=1e-12), "the hinge is the origin of both"
    assert np.allclose(relative[:, :, 0], (1, 0, 0, 0), atol=1e-12), "and its axis is x"
    assert rotation_angle(relative[:, :3, :3]).max() > 1.0


def test_street_is_driven_at_kitti_s_scale():
    sequence = open_world("street")
    assert sequence.kind == "driving"
    assert (sequence.rig.width, sequence.rig.height) == (1241, 376)
    assert sequence.rig.baseline == pytest.approx(0.54)
    speed = np.linalg.norm(np.diff(sequence.ground_truth.positions, axis=0), axis=1) * 10
    assert speed.mean() == pytest.approx(street.PACE, rel=0.1)
    heading = sequence.ground_truth.poses[:, :3, 2]
    assert heading[0, 1] > 0.99 and heading[-1, 0] < -0.99, "it turns to the left"
    assert len(sequence.objects(0).ids) == 3
    assert len(open_world("street?cars=0").objects(0).ids) == 0


def test_the_legs_of_people_swing_about_their_hips():
    sequence = open_world("people")
    poses = np.array([sequence.objects(k).T_world_object for k in range(len(sequence))])
    assert poses.shape[1] == people.PARTS * len(people.PEOPLE)
    trunk, left, right = poses[:, 3], poses[:, 4], poses[:, 5]  # of the first walker
    hips = inverse(trunk) @ left
    assert np.allclose(hips[:, :3, 3], (0, 0, people.HIP), atol=1e-12)
    assert 0.4 < rotation_angle(hips[:, :3, :3]).max() < 0.5
    assert np.allclose((inverse(trunk) @ right)[:, :3, :3], np.swapaxes(hips[:, :3, :3], 1, 2)), "legs alternate"
    assert np.linalg.norm(trunk[-1, :3, 3] - trunk[0, :3, 3]) == pytest.approx(1.4 * 13.9, rel=0.01)


def test_another_layout_is_another_world_and_the_same_layout_is_the_same():
    a, b, c = (open_world(f"aisle?layout={n}") for n in (0, 0, 1))
    assert np.array_equal(a.landmarks.positions, b.landmarks.positions)
    assert a.landmarks.positions.shape != c.landmarks.positions.shape
    assert not np.array_equal(a.ground_truth.poses, c.ground_truth.poses)
