"""Every format, found out by itself, read right; small sequences of known content."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.errors import CalibrationError, SequenceError
from slam.sequences import Sequence, formats, open_sequence
from slam.sequences.kitti import imu_poses


def levels(sequence: Sequence) -> list[tuple[int, int]]:
    """Which pictures the frames show: the seeds that `picture` drew left and right with."""

    def seed(image: np.ndarray) -> int:
        return round((float(image.mean()) - 1.5) / 10) - 1

    return [(seed(f.left), seed(f.right)) for f in sequence if f.right is not None]


PAIRS = [(i, i + 10) for i in range(6)]


@pytest.mark.parametrize(
    ("fixture", "format", "kind"),
    [
        ("euroc", "euroc", "handheld"),
        ("kitti", "kitti", "driving"),
        ("raw", "kitti-raw", "driving"),
        ("two_folders", "folders", "handheld"),
    ],
)
def test_each_format_is_found_out_and_yields_its_frames_in_order(
    fixture: str, format: str, kind: str, request: pytest.FixtureRequest, build: SimpleNamespace
) -> None:
    folder: Path = request.getfixturevalue(fixture)
    sequence = open_sequence(folder)
    assert isinstance(sequence, Sequence)
    assert (sequence.format, sequence.kind, sequence.name, len(sequence)) == (format, kind, folder.name, 6)
    assert format in formats()
    assert (sequence.rig.width, sequence.rig.height) == build.size
    assert levels(sequence) == PAIRS
    assert [f.index for f in sequence] == list(range(6))  # a second pass is as good as the first
    stamps = np.array([f.stamp for f in sequence])
    assert (np.diff(stamps) > 0).all()
    assert np.array_equal(stamps, sequence.stamps)
    assert open_sequence(str(folder), format=format).format == format


def test_a_range_of_frames_is_read_without_decoding_the_others(kitti: Path, build: SimpleNamespace) -> None:
    for name in ("000001.png", "000005.png"):  # would be reported if they were decoded
        build.cut(kitti / "image_0" / name)
    sequence = open_sequence(kitti)
    assert [f.index for f in sequence.frames(2, 5)] == [2, 3, 4]
    assert [f.index for f in sequence.frames(4)] == [4]
    assert [f.index for f in sequence.frames(3, 4)] == [3]
    assert len(sequence.warnings) == 1
    for start, stop in ((-1, 3), (6, None), (3, 3), (4, 2)):
        with pytest.raises(SequenceError, match=r"has frames 0:6|end is not after the start"):
            sequence.frames(start, stop)


def test_the_home_folder_is_expanded(kitti: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(kitti.parent))
    monkeypatch.setenv("USERPROFILE", str(kitti.parent))
    assert len(open_sequence("~/03")) == 6


def test_a_question_mark_may_be_part_of_a_folder_name(kitti: Path) -> None:
    odd = kitti.rename(kitti.parent / "what?")
    assert open_sequence(odd).name == "what?"
    assert open_sequence(f"{odd}?kind=handheld").kind == "handheld"


# ------------------------------------------------------------------------------------------------ images


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_grey_images_keep_their_depth(kitti: Path, build: SimpleNamespace, depth: type) -> None:
    for number in (0, 1):
        for i in range(6):
            build.write_image(kitti / f"image_{number}" / f"{i:06d}.png", i, depth=depth)
    frame = next(iter(open_sequence(kitti)))
    assert frame.left.dtype == depth
    assert np.array_equal(frame.left, build.picture(0, depth=depth))


def test_colour_images_become_grey(kitti: Path, build: SimpleNamespace) -> None:
    colours = np.zeros((*build.size[::-1], 3), np.uint8)
    colours[:] = (0, 0, 200)  # red: 0.299 of it is its grey
    cv2.imwrite(str(kitti / "image_0" / "000000.png"), colours)
    frame = next(iter(open_sequence(kitti)))
    assert frame.left.shape == build.size[::-1]
    assert abs(int(frame.left[0, 0]) - 0.299 * 200) <= 1


# ------------------------------------------------------------------------------------------------ EuRoC


def test_euroc_rig_and_truth(euroc: Path, build: SimpleNamespace) -> None:
    sequence = open_sequence(euroc / "mav0")
    assert sequence.name == "V0_01"
    assert np.allclose(sequence.rig.R, np.eye(3), atol=1e-12)
    assert np.allclose(sequence.rig.b, [-0.11, 0, 0], atol=1e-12)
    assert sequence.rig.left.model == "radtan"
    assert sequence.rig.left.distortion == (-0.28, 0.07, 0.0002, 1.8e-05)
    truth = sequence.ground_truth
    assert truth is not None
    assert len(truth) == 24  # denser than the frames, and not thinned
    assert np.allclose(truth.poses[:, :3, :3], build.T_body_camera[:3, :3])
    assert np.allclose(truth.positions[3], np.array([0.3, 0, 1]) + build.T_body_camera[:3, 3])
    assert truth.stamps[4] == sequence.stamps[1] == pytest.approx((build.T0 + build.STEP) / 1e9, abs=1e-6)


def test_euroc_listed_as_png_but_stored_as_jpeg(euroc: Path, build: SimpleNamespace) -> None:
    for path in euroc.glob("mav0/cam*/data/*.png"):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path), 0), [cv2.IMWRITE_JPEG_QUALITY, 100])
        path.unlink()
    assert levels(open_sequence(euroc)) == PAIRS


def test_euroc_without_lists_goes_by_file_names(euroc: Path) -> None:
    for cam in ("cam0", "cam1"):
        (euroc / "mav0" / cam / "data.csv").unlink()
    assert levels(open_sequence(euroc)) == PAIRS


def test_euroc_list_with_windows_line_ends_and_spaces(euroc: Path) -> None:
    table = euroc / "mav0" / "cam0" / "data.csv"
    text = table.read_text().replace(",", " , ").replace("\n", "\r\n")
    table.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert levels(open_sequence(euroc)) == PAIRS


# ------------------------------------------------------------------------------------------------ KITTI odometry


def test_kitti_rig_and_truth(kitti: Path) -> None:
    sequence = open_sequence(kitti)
    assert sequence.rig.is_rectified
    assert sequence.rig.baseline == pytest.approx(0.5, abs=1e-12)
    truth = sequence.ground_truth
    assert truth is not None
    assert np.allclose(truth.positions, [[0, 0, 1.5 * i] for i in range(6)])
    assert np.allclose(truth.stamps, 0.1 * np.arange(6))


def test_kitti_calibration_of_two_lines_and_poses_inside(kitti: Path) -> None:
    lines = (kitti / "calib.txt").read_text().splitlines()
    (kitti / "calib.txt").write_text("\n".join(lines[:2]))
    (kitti.parent.parent / "poses" / "03.txt").rename(kitti / "poses.txt")
    sequence = open_sequence(kitti)
    assert sequence.rig.baseline == pytest.approx(0.5, abs=1e-12)
    assert sequence.ground_truth is not None


def test_kitti_colour_where_there_is_no_grey(kitti: Path) -> None:
    (kitti / "image_0").rename(kitti / "image_2")
    (kitti / "image_1").rename(kitti / "image_3")
    sequence = open_sequence(kitti)
    assert levels(sequence) == PAIRS
    assert sequence.rig.baseline == pytest.approx(0.5, abs=1e-12)
    truth = sequence.ground_truth
    assert truth is not None
    assert np.allclose(truth.positions[0], [-3 / 50, 0, 0])  # the poses are camera 0's: camera 2 stands left of it


def test_kitti_part_of_a_sequence_keeps_its_times_and_poses(kitti: Path) -> None:
    for number in (0, 1):
        for i in (0, 1, 5):
            (kitti / f"image_{number}" / f"{i:06d}.png").unlink()
    sequence = open_sequence(kitti)
    assert levels(sequence) == PAIRS[2:5]
    assert np.allclose(sequence.stamps, [0.2, 0.3, 0.4])
    truth = sequence.ground_truth
    assert truth is not None
    assert np.allclose(truth.positions[:, 2], [3.0, 4.5, 6.0])
    assert sequence.warnings == [f"{kitti / 'times.txt'}: the last 1 rows have no image"]


def test_kitti_without_times_runs_at_ten_hertz_and_says_so(kitti: Path) -> None:
    (kitti / "times.txt").unlink()
    sequence = open_sequence(kitti)
    assert np.allclose(sequence.stamps, 0.1 * np.arange(6))
    assert sequence.warnings == [f"{kitti / 'image_0'}: no times, 10 frames per second assumed (see fps=…)"]


# ------------------------------------------------------------------------------------------------ KITTI raw


def test_kitti_raw_rig_and_times(raw: Path) -> None:
    sequence = open_sequence(raw)
    assert sequence.rig.baseline == pytest.approx(0.5, abs=1e-12)
    assert np.allclose(sequence.stamps, 0.1 * np.arange(6), atol=1e-9)
    assert sequence.ground_truth is None


def write_oxts(drive: Path, records: list[str]) -> None:
    (drive / "oxts" / "data").mkdir(parents=True)
    for i, record in enumerate(records):
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(record + " 0" * 24 + "\n")
    times = (drive / "image_00" / "timestamps.txt").read_text()
    (drive / "oxts" / "timestamps.txt").write_text(times)
    # camera z is the IMU's x (ahead), camera x minus its y, camera y minus its z
    turn = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.5\n"
    (drive.parent / "calib_velo_to_cam.txt").write_text("calib_time: 15-Mar-2012\n" + turn)
    (drive.parent / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")


def test_kitti_raw_truth_of_oxts_records(raw: Path) -> None:
    """East at 1 m a frame: straight ahead for the camera. Then a turn to the left on the spot about the IMU."""
    metre = np.degrees(1 / (6378137.0 * np.cos(np.radians(49))))
    ahead = [f"49 {8 + i * metre:.15f} 110 0 0 0" for i in range(5)]
    write_oxts(raw, [*ahead, f"49 {8 + 4 * metre:.15f} 110 0 0 {np.pi / 2}"])
    truth = open_sequence(raw).ground_truth
    assert truth is not None
    assert np.allclose(truth.poses[0], np.eye(4), atol=1e-9)
    assert np.allclose(truth.positions[:5], [[0, 0, i] for i in range(5)], atol=1e-6)
    # the camera stands 0.5 m before the IMU, so the turn swings it to the left
    assert np.allclose(truth.positions[5], [-0.5, 0, 3.5], atol=1e-6)
    assert np.allclose(truth.poses[5, :3, 2], [-1, 0, 0], atol=1e-9)  # now it looks to the left
    assert np.allclose(truth.stamps, 0.1 * np.arange(6), atol=1e-9)


@pytest.mark.parametrize("colour", [False, True])
def test_kitti_raw_truth_keeps_a_fixed_point_where_it_is(raw: Path, colour: bool) -> None:
    """Through IMU, laser, camera 0, rectification and the offset of the camera in use."""
    rng = np.random.default_rng(6)
    records = [f"{49 + 1e-5 * i} {8 + 2e-5 * i * i} {110 + i} {0.01 * i} {-0.02 * i} {0.3 * i}" for i in range(6)]
    write_oxts(raw, records)
    chain = [Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix() for _ in range(3)]
    shifts = rng.normal(size=(2, 3))
    words = [" ".join(f"{x:.17g}" for x in a.ravel()) for a in (*chain, *shifts)]
    (raw.parent / "calib_imu_to_velo.txt").write_text(f"R: {words[0]}\nT: {words[3]}\n")
    (raw.parent / "calib_velo_to_cam.txt").write_text(f"R: {words[1]}\nT: {words[4]}\n")
    cam_to_cam = raw.parent / "calib_cam_to_cam.txt"
    text = cam_to_cam.read_text().replace("R_rect_00: 1 0 0 0 1 0 0 0 1", f"R_rect_00: {words[2]}")
    offset = np.zeros(3)
    if colour:
        for grey, camera in (("00", "02"), ("01", "03")):
            (raw / f"image_{grey}").rename(raw / f"image_{camera}")
        text = (
            text.replace("P_rect_00", "P_rect_02").replace("P_rect_01", "P_rect_03").replace("S_rect_00", "S_rect_02")
        )
        text = text.replace("3.150000e+01 0.000000e+00", "3.150000e+01 3.000000e+00")
        offset[0] = 3 / 50
    cam_to_cam.write_text(text)
    sequence = open_sequence(raw)
    assert sequence.warnings == []
    truth = sequence.ground_truth
    assert truth is not None
    point = np.array([3.0, -7.0, 2.0])  # in the IMU's world
    seen = []
    for T in imu_poses(np.array([[float(w) for w in r.split()] for r in records])):
        velo = chain[0] @ (T[:3, :3].T @ (point - T[:3, 3])) + shifts[0]
        seen.append(chain[2] @ (chain[1] @ velo + shifts[1]) + offset)
    world = [T[:3, :3] @ x + T[:3, 3] for T, x in zip(truth.poses, seen)]
    assert np.allclose(world, seen[0], atol=1e-9)
    assert not np.allclose(seen[1], seen[0], atol=0.1)


def test_kitti_raw_truth_with_a_broken_record(raw: Path) -> None:
    write_oxts(raw, ["49 8 110 0 0 0", "49 8 110 0 0 abc", "49 8.00001 110 0 0 0"])
    sequence = open_sequence(raw)
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth) == 2
    assert len(sequence.warnings) == 1
    assert "0000000001.txt, row 1" in sequence.warnings[0]


def test_kitti_raw_truth_needs_its_calibration(raw: Path) -> None:
    write_oxts(raw, ["49 8 110 0 0 0"])
    (raw.parent / "calib_imu_to_velo.txt").unlink()
    sequence = open_sequence(raw)
    assert sequence.ground_truth is None
    assert "calib_imu_to_velo.txt: the calibration is missing; there is no ground truth" in sequence.warnings[0]


def test_kitti_raw_with_a_reflected_rectification(raw: Path) -> None:
    calibration = raw.parent / "calib_cam_to_cam.txt"
    calibration.write_text(calibration.read_text().replace("R_rect_00: 1 0 0", "R_rect_00: -1 0 0"))
    with pytest.raises(CalibrationError, match="not a rigid motion"):
        open_sequence(raw)


# ------------------------------------------------------------------------------------------------ real data


def test_real_kitti_06(slam_data: Path) -> None:
    sequence = open_sequence(slam_data / "kitti_odometry" / "sequences" / "06")
    assert (len(sequence), sequence.rig.width, sequence.rig.height) == (51, 1226, 370)
    assert sequence.rig.baseline == pytest.approx(0.53715, abs=1e-5)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.length == pytest.approx(59.86, abs=0.005)
    assert sequence.warnings == []
    assert sum(f.right is not None for f in sequence.frames(48)) == 3


def test_real_kitti_raw_0013(slam_data: Path) -> None:
    drive = slam_data / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0013_sync"
    sequence = open_sequence(drive)
    assert (len(sequence), sequence.rig.width, sequence.rig.height) == (144, 1242, 375)
    assert sequence.warnings == []
    if not (drive / "poses_cam0_oxts.txt").exists():
        pytest.skip("this copy of the drive has no poses of camera 0")
    assert len(sequence.ground_truth) == 144
    assert sequence.ground_truth.length == pytest.approx(173, abs=1.5)
    assert sequence.truth_noise.translation == 0.02


def test_real_euroc_keyframes(slam_data: Path) -> None:
    sequence = open_sequence(slam_data / "euroc" / "V1_01_keyframes_a")
    assert len(sequence) == len(list(sequence)) == 20
    assert sequence.rig.baseline == pytest.approx(0.11008, abs=1e-5)
    assert sequence.rig.rectified.rig.left.fu == pytest.approx(436.2, abs=0.5)
    assert not sequence.rig.is_rectified
    truth = sequence.ground_truth
    assert truth is not None
    at_frames = np.abs(truth.stamps[:, None] - sequence.stamps).min(axis=0)
    assert at_frames.max() < 1e-3
    assert sequence.warnings == []
