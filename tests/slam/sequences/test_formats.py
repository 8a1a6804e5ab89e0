"""EuRoC's and KITTI's data sets, found out by themselves and read right; small sequences of known content."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.errors import CalibrationError, SequenceError
from slam.sequences import Sequence, formats, open_sequence
from slam.sequences.kitti import imu_poses
from tests import recordings
from tests.recordings import projection_row, seeds

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
    fixture: str, format: str, kind: str, request: pytest.FixtureRequest
) -> None:
    folder: Path = request.getfixturevalue(fixture)
    sequence = open_sequence(folder)
    assert isinstance(sequence, Sequence)
    assert (sequence.format, sequence.kind, sequence.name, len(sequence)) == (format, kind, folder.name, 6)
    assert format in formats()
    assert (sequence.rig.width, sequence.rig.height) == (recordings.WIDTH, recordings.HEIGHT)
    assert seeds(sequence) == PAIRS
    assert [f.index for f in sequence] == list(range(6))  # a second pass is as good as the first
    stamps = np.array([f.stamp for f in sequence])
    assert (np.diff(stamps) > 0).all() and np.array_equal(stamps, sequence.stamps)
    assert open_sequence(str(folder), format=format).format == format


def test_a_range_of_frames_is_read_without_decoding_the_others(kitti: Path) -> None:
    for name in ("000001.png", "000005.png"):  # would be reported if they were decoded
        recordings.cut(kitti / "image_0" / name)
    sequence = open_sequence(kitti)
    for start, stop, found in ((2, 5, [2, 3, 4]), (4, None, [4]), (3, 4, [3])):
        assert [f.index for f in sequence.frames(start, stop)] == found
    assert len(sequence.warnings) == 1
    assert [f.index for f in sequence.frames(4, 80)] == [4]
    assert f"{sequence.name}: frames 4:80 asked for, it has 6" in sequence.warnings
    for start, stop in ((-1, 3), (6, None), (3, 3), (4, 2)):
        with pytest.raises(SequenceError, match=r"has frames 0:6|end is not after the start"):
            sequence.frames(start, stop)


# ------------------------------------------------------------------------------------------------ EuRoC


def test_euroc_rig_and_truth(euroc: Path) -> None:
    sequence = open_sequence(euroc / "mav0")
    assert sequence.name == "V0_01"
    assert np.allclose(sequence.rig.R, np.eye(3), atol=1e-12) and np.allclose(sequence.rig.b, [-0.11, 0, 0], atol=1e-12)
    assert sequence.rig.left.distortion == (-0.28, 0.07, 0.0002, 1.8e-05)
    truth = sequence.ground_truth
    assert len(truth) == 24  # denser than the frames, and not thinned
    assert np.allclose(truth.poses[:, :3, :3], recordings.BODY_CAMERA[:3, :3])
    assert np.allclose(truth.positions[3], np.array([0.3, 0, 1]) + recordings.BODY_CAMERA[:3, 3])
    assert truth.stamps[4] == sequence.stamps[1] == pytest.approx((recordings.T0 + recordings.STEP) / 1e9, abs=1e-6)


def test_own_images_in_euroc_s_tree(euroc: Path) -> None:
    for cam in ("cam0", "cam1"):
        camera = euroc / "mav0" / cam
        (camera / "data.csv").unlink()
        recordings.rename(camera / "data", lambda i: f"{i:06d}.png")
    sequence = open_sequence(euroc)
    assert np.allclose(sequence.stamps, 0.1 * np.arange(6))
    assert any("10 frames per second assumed" in line for line in sequence.warnings)
    for cam in ("cam0", "cam1"):
        (euroc / "mav0" / cam / "sensor.yaml").unlink()
    with pytest.raises(CalibrationError, match="add calibration=FILE"):
        open_sequence(f"{euroc}?fps=10")
    (euroc / "own.yaml").write_text(recordings.FIVE)
    sequence = open_sequence(f"{euroc}?fps=20&calibration=own.yaml")
    assert seeds(sequence) == PAIRS and np.allclose(sequence.stamps, 0.05 * np.arange(6))
    assert sequence.rig.baseline == pytest.approx(0.2)


def test_tum_vi_is_read(euroc: Path) -> None:
    """Fisheye lenses, 16 bits, Kalibr's calibration in dso, the body's truth in mocap0."""
    usual, T = open_sequence(euroc), np.linalg.inv(recordings.BODY_CAMERA)
    D, chain = [0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367], ""
    for cam, shift in (("cam0", 0.0), ("cam1", -0.11)):
        (euroc / "mav0" / cam / "sensor.yaml").unlink()
        rows = "".join(f"  - {row}\n" for row in (T + shift * np.eye(4, k=3)).tolist())
        chain += f"{cam}:\n  T_cam_imu:\n{rows}  camera_model: pinhole\n  distortion_coeffs: {D}\n"
        chain += "  distortion_model: equidistant\n  intrinsics: [50, 50, 31, 23]\n  resolution: [64, 48]\n"
    for path in euroc.glob("mav0/cam*/data/*.png"):
        cv2.imwrite(str(path), 257 * cv2.imread(str(path), 0).astype(np.uint16))
    (euroc / "mav0" / "state_groundtruth_estimate0").rename(euroc / "mav0" / "mocap0")
    (euroc / "dso").mkdir()
    (euroc / "dso" / "camchain.yaml").write_text(chain)
    sequence = open_sequence(euroc)
    assert (sequence.rig.left.model, sequence.rig.left.distortion) == ("equidistant", tuple(D))
    assert np.allclose(sequence.rig.b, [-0.11, 0, 0]) and sequence[0].left.dtype == np.uint16
    assert np.allclose(sequence.ground_truth.poses, usual.ground_truth.poses, atol=1e-6)


# ------------------------------------------------------------------------------------------------ KITTI


def test_kitti_rig_and_truth(kitti: Path) -> None:
    sequence = open_sequence(kitti)
    assert sequence.rig.is_rectified and sequence.rig.baseline == pytest.approx(0.5, abs=1e-12)
    assert np.allclose(sequence.ground_truth.positions, [[0, 0, 1.5 * i] for i in range(6)])
    assert np.allclose(sequence.ground_truth.stamps, 0.1 * np.arange(6))
    lines = (kitti / "calib.txt").read_text().splitlines()
    (kitti / "calib.txt").write_text("\n".join(lines[:2]))
    (kitti.parent.parent / "poses" / "03.txt").rename(kitti / "poses.txt")
    sequence = open_sequence(kitti)
    assert sequence.rig.baseline == pytest.approx(0.5, abs=1e-12) and sequence.ground_truth is not None


def test_kitti_colour_where_there_is_no_grey(kitti: Path) -> None:
    (kitti / "image_0").rename(kitti / "image_2")
    (kitti / "image_1").rename(kitti / "image_3")
    sequence = open_sequence(kitti)
    assert seeds(sequence) == PAIRS
    assert sequence.rig.baseline == pytest.approx(0.5, abs=1e-12)
    assert np.allclose(sequence.ground_truth.positions[0], [-3 / 50, 0, 0])  # camera 2 stands left of camera 0


def test_kitti_part_of_a_sequence_keeps_its_times_and_poses(kitti: Path) -> None:
    for name in ("image_1/000000.png", "image_1/000001.png", "image_0/000005.png"):  # one camera is ahead of the other
        (kitti / name).unlink()
    sequence = open_sequence(kitti)
    assert seeds(sequence) == PAIRS[2:5]
    assert np.allclose(sequence.stamps, [0.2, 0.3, 0.4])
    assert np.allclose(sequence.ground_truth.positions[:, 2], [3.0, 4.5, 6.0])
    ends = [f"{kitti / 'image_0'}: 2 images before the first pair left out"]
    ends += [f"{kitti / 'image_1'}: 1 image without a partner in {kitti / 'image_0'}; left out"]
    assert sequence.warnings == [*ends, f"{kitti / 'times.txt'}: the last 1 rows have no image"]
    (kitti / "times.txt").unlink()
    sequence = open_sequence(kitti)
    assert np.allclose(sequence.stamps, [0.2, 0.3, 0.4])
    assert sequence.warnings == [*ends, f"{kitti / 'image_0'}: no times, 10 frames per second assumed (see fps=…)"]


def on_the_earth(latitude: float, longitude: float) -> np.ndarray:
    """Position (3,) [m] on the ellipsoid of WGS 84, from the earth's centre, z along its axis."""
    a, f = 6378137.0, 1 / 298.257223563
    north, east = np.radians([latitude, longitude])
    radius = a / np.sqrt(1 - f * (2 - f) * np.sin(north) ** 2)
    x, y, z = np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), (1 - f) ** 2 * np.sin(north)
    return radius * np.array([x, y, z])


@pytest.mark.parametrize("step", [(0.0, 0.001), (0.001, 0.0), (-0.0004, -0.0013)])
def test_lengths_of_oxts_truth_are_those_on_the_earth(step: tuple[float, float]) -> None:
    """On a sphere they are 0.2 % too short along a parallel, and 0.1 % too long along a meridian."""
    begin = np.array([49.0, 8.4])
    poses = imu_poses(np.array([[*begin, 0, 0, 0, 0], [*(begin + step), 0, 0, 0, 0]]))
    way = np.linalg.norm(on_the_earth(*(begin + step)) - on_the_earth(*begin))
    assert np.linalg.norm(poses[1, :3, 3]) == pytest.approx(way, rel=2e-5)


@pytest.mark.parametrize("colour", [False, True])
def test_kitti_raw_truth_keeps_a_fixed_point_where_it_is(raw: Path, colour: bool) -> None:
    """Through IMU, laser, camera 0, rectification and the offset of the camera in use."""
    rng = np.random.default_rng(6)
    records = [f"{49 + 1e-5 * i} {8 + 2e-5 * i * i} {110 + i} {0.01 * i} {-0.02 * i} {0.3 * i}" for i in range(6)]
    recordings.write_oxts(raw, records)
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
            text = text.replace(f"P_rect_{grey}", f"P_rect_{camera}").replace(f"S_rect_{grey}", f"S_rect_{camera}")
        text = text.replace("3.150000e+01 0.000000e+00", "3.150000e+01 3.000000e+00")
        offset[0] = 3 / 50
    cam_to_cam.write_text(text)
    sequence = open_sequence(raw)
    assert sequence.warnings == [] and np.allclose(sequence.ground_truth.poses[0], np.eye(4), atol=1e-9)
    assert np.allclose(sequence.ground_truth.stamps, 0.1 * np.arange(6), atol=1e-9)
    point = np.array([3.0, -7.0, 2.0])  # in the IMU's world
    seen = []
    for T in imu_poses(np.array([[float(w) for w in r.split()] for r in records])):
        velo = chain[0] @ (T[:3, :3].T @ (point - T[:3, 3])) + shifts[0]
        seen.append(chain[2] @ (chain[1] @ velo + shifts[1]) + offset)
    world = [T[:3, :3] @ x + T[:3, 3] for T, x in zip(sequence.ground_truth.poses, seen)]
    assert np.allclose(world, seen[0], atol=1e-9)
    assert not np.allclose(seen[1], seen[0], atol=0.1)


def test_kitti_tracking_as_downloaded(tmp_path: Path) -> None:
    root = tmp_path / "training"
    recordings.write_pairs(root / "image_02/0003", root / "image_03/0003")
    with pytest.raises(SequenceError, match="below it is image_02/0003: give that"):
        open_sequence(root)
    with pytest.raises(CalibrationError, match="add calibration=FILE"):
        open_sequence(root / "image_02" / "0003")
    rows = [projection_row("P2", 3), projection_row("P3", -22), "R_rect 1 0 0 0 1 0 0 0 1"]
    (root / "calib").mkdir()
    (root / "calib" / "0003.txt").write_text("\n".join(rows))
    sequence = open_sequence(root / "image_02" / "0003")
    assert (sequence.name, sequence.format, sequence.kind) == ("0003", "kitti", "driving")
    assert seeds(sequence) == PAIRS and sequence.rig.baseline == pytest.approx(0.5)


def test_kitti_360_as_downloaded(tmp_path: Path) -> None:
    drive = tmp_path / "data_2d_raw" / "2013_05_28_drive_0000_sync"
    recordings.write_pairs(drive / "image_00/data_rect", drive / "image_01/data_rect", "{:010d}.png")
    times = [f"2013-05-28 08:46:{2 + 0.1 * i:012.9f}\n" for i in range(6)]
    for camera in ("image_00", "image_01"):
        (drive / camera / "timestamps.txt").write_text("".join(times))
    rows = ["S_rect_00: 64 48", "R_rect_00: 1 0 0 0 1 0 0 0 1", "S_rect_01: 64 48"]
    rows += [projection_row("P_rect_00", 0), projection_row("P_rect_01", -25)]
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "perspective.txt").write_text("\n".join(rows))
    poses = tmp_path / "data_poses" / drive.name / "cam0_to_world.txt"
    poses.parent.mkdir(parents=True)
    poses.write_text("".join(f"{i} 1 0 0 {i} 0 1 0 0 0 0 1 0 0 0 0 1 \n" for i in (1, 2, 5, 9)))
    sequence = open_sequence(drive)
    assert seeds(sequence) == PAIRS and sequence.rig.baseline == pytest.approx(0.5)
    assert np.allclose(sequence.ground_truth.stamps, [0.1, 0.2, 0.5])
    assert np.allclose(sequence.ground_truth.positions[:, 0], [1, 2, 5])
