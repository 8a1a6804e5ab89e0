"""What people bring: names of images, layouts, tolerances, masks, rigs one above the other, other data sets' trees."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.sequences import open_sequence, with_mask
from slam.sequences.names import keys_of, of_sides

FIVE = "fx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\nbaseline: 0.2\n"


def rename(folder: Path, name) -> None:
    for i, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / name(i))


def means(sequence) -> list[tuple[int, int]]:
    return [(round(f.left.mean()), -1 if f.right is None else round(f.right.mean())) for f in sequence]


def in_order(sequence) -> bool:
    found = means(sequence)
    return found == sorted(found) and all(right - left in (99, 100, 101) for left, right in found)


# ------------------------------------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("left", "right", "stamps"),
    [
        (lambda i: f"{i + 7}_cam0.png", lambda i: f"{i + 7}_cam1.png", 0.1 * np.arange(6)),
        (lambda i: f"frame{i + 7}_1226x370.png", lambda i: f"frame{i + 7}_1226x370.png", 0.1 * np.arange(6)),
        (lambda i: f"seq{1 + i // 4}_{i % 4}.png", lambda i: f"seq{1 + i // 4}_{i % 4}.png", 0.1 * np.arange(6)),
        (
            lambda i: f"img_CAMERA1_{1261228749.918590 + 0.049999 * i:.6f}_left.png",
            lambda i: f"img_CAMERA1_{1261228749.918590 + 0.049999 * i:.6f}_right.png",
            1261228749.918590 + 0.049999 * np.arange(6),
        ),
        (lambda i: f"l_{10**18 + i * 10**8}_a.png", lambda i: f"r_{10**18 + i * 10**8}.png", 1e9 + 0.1 * np.arange(6)),
        (
            lambda i: f"cam-{1_700_000_000}.{97000 + 1500 * i}.png",  # microseconds without padding
            lambda i: f"cam-{1_700_000_000}.{97000 + 1500 * i}.png",
            1.7e9 + 0.097 + 0.0015 * np.arange(6),
        ),
        (lambda i: f"{9.95 + 0.05 * i:.3f}.png", lambda i: f"{9.951 + 0.05 * i:.3f}.png", 9.95 + 0.05 * np.arange(6)),
        (
            lambda i: f"20230405_120000_{90 * i:03d}.png",
            lambda i: f"20230405_120000_{90 * i:03d}.png",
            1680696000 + 0.09 * np.arange(6),
        ),
        (
            lambda i: f"2023-04-05-12-00-{i // 2:02d}_{i}.png",  # counted on when the second is over
            lambda i: f"2023-04-05-12-00-{i // 2:02d}_{i}.png",
            0.1 * np.arange(6),
        ),
    ],
    ids=[
        "unpadded",
        "size-in-name",
        "two-numbers",
        "malaga",
        "inside",
        "unpadded-usec",
        "since-a-start",
        "date",
        "date-and-count",
    ],
)
def test_names_are_read_as_numbers_and_stamps(two_folders: Path, left, right, stamps) -> None:
    for side, name in (("left", left), ("right", right)):
        rename(two_folders / side, name)
    sequence = open_sequence(two_folders)
    assert in_order(sequence)
    assert np.allclose(sequence.stamps, stamps, atol=2e-6, rtol=0)


def test_a_guess_is_said_with_what_was_guessed(two_folders: Path) -> None:
    for side in ("left", "right"):
        rename(two_folders / side, lambda i: f"img_{i:03d}_{9 - i}.png")
    warnings = open_sequence(f"{two_folders}?fps=10").warnings
    assert any("numbers in the names disagree" in line for line in warnings)
    for side, end in (("left", "a"), ("right", "b")):
        rename(two_folders / side, lambda i, end=end: "abcdef"[i] + end + ".png")
    assert any("their order does" in line for line in open_sequence(f"{two_folders}?fps=10").warnings)
    for side in ("left", "right"):
        rename(two_folders / side, lambda i: f"x_{1_700_000_000 + i}.500000.png")
    assert any("is taken as 1700000000.500000 s" in line for line in open_sequence(two_folders).warnings)


def test_equal_counts_with_other_stamps_are_not_paired_by_order(two_folders: Path) -> None:
    """The left camera lost one image, the right one another: as many, but not the same."""
    kept = {"left": [0, 1, 3, 4, 5, 6], "right": [0, 1, 2, 3, 4, 6]}
    for side, numbers in kept.items():
        rename(two_folders / side, lambda i, numbers=numbers: f"{10**18 + numbers[i] * 10**8}.png")
    for query in ("", "?fps=10", "?times=t.txt"):
        (two_folders / "t.txt").write_text("".join(f"{i}\n" for i in range(6)))
        frames = list(open_sequence(f"{two_folders}{query}"))
        assert [f.right is None for f in frames] == [False, False, False, False, True, False], query
    rename(two_folders / "right", lambda i: f"{2 * 10**18 + i * 10**8}.png")
    with pytest.raises(SequenceError, match="the clocks of the cameras differ"):
        open_sequence(f"{two_folders}?fps=10")


def test_a_tolerance_goes_with_every_format_that_has_stamps(two_folders: Path, euroc: Path) -> None:
    for side, late in (("left", 0), ("right", 8_000_000)):
        rename(two_folders / side, lambda i, late=late: f"{10**18 + i * 10**8 + late}.png")
    with pytest.raises(SequenceError, match=r"nearest two are 8 ms apart, 5 ms are allowed; see tolerance="):
        open_sequence(two_folders)
    assert in_order(open_sequence(f"{two_folders}?tolerance=0.02"))
    assert np.allclose(open_sequence(f"{two_folders}?fps=10").stamps, 0.1 * np.arange(6))
    with pytest.raises(SequenceError, match="1 ms are allowed"):
        open_sequence(f"{two_folders}?tolerance=0.001")
    assert len(open_sequence(f"{euroc}?tolerance=0")) == 6
    with pytest.raises(ConfigurationError, match="tolerance must be a number from 0 to 10"):
        open_sequence(f"{euroc}?tolerance=-1")


def test_an_option_that_does_nothing_is_refused(kitti: Path, euroc: Path, two_folders: Path) -> None:
    for path, option in (
        (kitti, "tolerance=0.1"),
        (kitti, "rectified=yes"),
        (euroc, "layout=sbs&format=x"),
        (two_folders, "times=t.txt&fps=3"),
        (two_folders, "tolerance=0.1"),
    ):
        (two_folders / "t.txt").write_text("".join(f"{i}\n" for i in range(6)))
        with pytest.raises(slam.SlamError, match=r"does nothing here|unknown option"):
            open_sequence(f"{path}?{option}")
    assert np.allclose(open_sequence(f"{kitti}?fps=5").stamps, 0.2 * np.arange(6))
    assert np.allclose(open_sequence(f"{euroc}?fps=5").stamps, 0.2 * np.arange(6))


def test_words_for_left_and_right() -> None:
    assert of_sides(["left_01.png", "right_01.png"]) == (["left_01.png"], ["right_01.png"])
    assert of_sides(["0_cam0.png", "0_cam1.png", "0_cam10.png"]) == (["0_cam0.png"], ["0_cam1.png"])
    assert of_sides(["L01.png", "R01.png"]) == (["L01.png"], ["R01.png"])
    assert of_sides(["brightness.png", "leftover.png"]) is None
    assert keys_of([["a.png", "b.png"]]) is None


# ------------------------------------------------------------------------------------------------ layouts


def test_one_folder_with_both_cameras_in_it(two_folders: Path) -> None:
    for side in ("left", "right"):
        for path in (two_folders / side).iterdir():
            path.rename(two_folders / path.name)
        (two_folders / side).rmdir()
    assert in_order(open_sequence(f"{two_folders}?fps=10"))


def side_by_side(two_folders: Path) -> list[np.ndarray]:
    pairs = [sorted((two_folders / side).iterdir()) for side in ("left", "right")]
    return [np.hstack([cv2.imread(str(path), 0) for path in pair]) for pair in zip(*pairs)]


def test_images_side_by_side(two_folders: Path, tmp_path: Path, build: SimpleNamespace) -> None:
    folder = tmp_path / "double"
    folder.mkdir()
    for i, image in enumerate(side_by_side(two_folders)):
        cv2.imwrite(str(folder / f"{i}.png"), image)
    (folder / "calibration.yaml").write_text(FIVE)
    sequence = open_sequence(f"{folder}?layout=sbs&fps=10")
    assert in_order(sequence)
    assert (len(sequence), sequence.rig.width) == (6, 64)
    build.write_image(folder / "3.png", 3, 131)
    assert [f.index for f in open_sequence(f"{folder}?layout=sbs")] == [0, 1, 2, 4, 5]
    with pytest.raises(ConfigurationError, match="layout must be sbs"):
        open_sequence(f"{folder}?layout=stacked")


def test_a_video_side_by_side_gives_every_frame(two_folders: Path, tmp_path: Path) -> None:
    images = side_by_side(two_folders)
    film = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"FFV1"), 25, images[0].shape[::-1])
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    (tmp_path / "calibration.yaml").write_text(FIVE)
    with pytest.raises(SequenceError, match=r"walk\.avi\?layout=sbs"):
        open_sequence(film)
    sequence = open_sequence(f"{film}?layout=sbs")
    assert (sequence.name, len(sequence)) == ("walk", 6)
    assert in_order(sequence)
    assert np.allclose(sequence.stamps, np.arange(6) / 25)


# ------------------------------------------------------------------------------------------------ above each other


@pytest.mark.parametrize("clockwise", [1, -1])
def test_cameras_above_each_other_are_turned(two_folders: Path, build: SimpleNamespace, clockwise: int) -> None:
    """A rig turned by a quarter, and its images with it, gives the frames and the rig of the upright one."""
    upright = open_sequence(two_folders)
    turned = SimpleNamespace(left=upright.rig.left.turned(-clockwise), right=upright.rig.right.turned(-clockwise))
    axes = np.linalg.matrix_power(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), -clockwise % 4)
    R, b = axes @ upright.rig.R @ axes.T, axes @ upright.rig.b
    frames = list(upright)
    for side in ("left", "right"):
        for path in (two_folders / side).iterdir():
            cv2.imwrite(str(path), np.rot90(cv2.imread(str(path), 0), -clockwise))
    build.write_storage(
        two_folders / "calibration.yaml",
        {
            **{f"K{i}": c.K for i, c in ((1, turned.left), (2, turned.right))},
            **{f"D{i}": np.array([c.distortion]) for i, c in ((1, turned.left), (2, turned.right))},
            "R": R,
            "T": R @ b,
        },
    )
    sequence = open_sequence(two_folders)
    assert sequence.rig.turns % 4 == clockwise % 4
    for a, c in ((sequence.rig.left, upright.rig.left), (sequence.rig.right, upright.rig.right)):
        assert np.allclose([a.fu, a.fv, a.u0, a.v0, *a.distortion], [c.fu, c.fv, c.u0, c.v0, *c.distortion])
    assert np.allclose(sequence.rig.R, upright.rig.R) and np.allclose(sequence.rig.b, upright.rig.b)
    for frame, expected in zip(sequence, frames, strict=True):
        assert np.array_equal(frame.left, expected.left) and np.array_equal(frame.right, expected.right)
    with pytest.raises(CalibrationError, match="turn both images by 90 degrees"):
        slam.load_rig(two_folders, size=(48, 64))


def test_a_turned_camera_sees_turned_pixels() -> None:
    camera = slam.StereoRig.from_pinhole(
        [[50.0, 0, 30], [0, 52, 20], [0, 0, 1]], baseline=0.1, size=(64, 48), D_left=[-0.2, 0.05, 0.01, -0.02]
    ).left
    points = np.array([[0.1, -0.2, 1.0], [0.3, 0.2, 2.0]])
    turned = camera.turned(1).project(np.stack([points[:, 1], -points[:, 0], points[:, 2]], axis=1))
    pixels = camera.project(points)
    assert np.allclose(turned, np.stack([pixels[:, 1], 63 - pixels[:, 0]], axis=1))
    assert camera.turned(4) == camera.turned(-1).turned(1) == camera


# ------------------------------------------------------------------------------------------------ masks


def test_features_under_a_mask_are_not_used(tmp_path: Path) -> None:
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :160] = 0
    cv2.imwrite(str(tmp_path / "left half.png"), mask)
    white = np.full_like(mask, 255)
    cv2.imwrite(str(tmp_path / "all.png"), white)
    text = "synthetic:desk?frames=3"
    sequence = open_sequence(with_mask(text, f"{tmp_path / 'left half.png'},{tmp_path / 'all.png'}"))
    system = slam.StereoSlam(sequence.rig)
    for frame in sequence:
        assert frame.left_mask is not None and frame.right_mask.all()
        features = system.frontend.extract(frame)
        assert len(features) > 50 and features.uv_left[:, 0].min() >= 150
        strict = features.outside(frame.left_mask, frame.right_mask)
        assert strict.uv_left[:, 0].min() >= 159.5
        system.process(frame)
    right = open_sequence(with_mask(text, f",{tmp_path / 'left half.png'}"))
    frame = next(iter(right))
    features = slam.StereoSlam(right.rig).frontend.extract(frame).outside(frame.left_mask, frame.right_mask)
    assert features.uv_left[:, 0].min() < 100
    assert np.nanmin(features.uv_right[:, 0]) >= 159.5


def test_a_mask_of_a_recording_and_what_is_refused(two_folders: Path) -> None:
    cv2.imwrite(str(two_folders / "m.png"), np.eye(48, 64, dtype=np.uint8))
    frame = next(iter(open_sequence(f"{two_folders}?mask=m.png")))
    assert frame.left_mask is frame.right_mask and frame.left_mask.sum() == 48
    cv2.imwrite(str(two_folders / "black.png"), np.zeros((48, 64), np.uint8))
    cv2.imwrite(str(two_folders / "small.png"), np.ones((4, 4), np.uint8))
    for name, words in (("black", "black all over"), ("small", "another size"), ("nowhere", "mask: .*nowhere")):
        with pytest.raises(slam.SlamError, match=words):
            open_sequence(f"{two_folders}?mask={name}.png")


# ------------------------------------------------------------------------------------------------ data sets


def projection_row(name: str, offset: float) -> str:
    return f"{name}: 50 0 31.5 {offset} 0 50 23.5 0 0 0 1 0"


def test_own_images_in_euroc_s_tree(euroc: Path) -> None:
    for cam in ("cam0", "cam1"):
        camera = euroc / "mav0" / cam
        (camera / "data.csv").unlink()
        rename(camera / "data", lambda i: f"{i:06d}.png")
    sequence = open_sequence(euroc)
    assert np.allclose(sequence.stamps, 0.1 * np.arange(6))
    assert any("10 frames per second assumed" in line for line in sequence.warnings)
    for cam in ("cam0", "cam1"):
        (euroc / "mav0" / cam / "sensor.yaml").unlink()
    with pytest.raises(CalibrationError, match="add calibration=FILE"):
        open_sequence(f"{euroc}?fps=10")
    (euroc / "own.yaml").write_text(FIVE)
    sequence = open_sequence(f"{euroc}?fps=20&calibration=own.yaml")
    assert in_order(sequence) and np.allclose(sequence.stamps, 0.05 * np.arange(6))
    assert sequence.rig.baseline == pytest.approx(0.2)


def test_kitti_tracking_as_downloaded(tmp_path: Path, build: SimpleNamespace) -> None:
    root = tmp_path / "training"
    for camera, first in (("image_02", 0), ("image_03", 10)):
        for i in range(6):
            build.write_image(root / camera / "0003" / f"{i:06d}.png", first + i)
    with pytest.raises(SequenceError, match="below it are image_02/0003"):
        open_sequence(root)
    with pytest.raises(CalibrationError, match="add calibration=FILE"):
        open_sequence(root / "image_02" / "0003")
    rows = [projection_row("P2", 3), projection_row("P3", -22), "R_rect 1 0 0 0 1 0 0 0 1"]
    (root / "calib").mkdir()
    (root / "calib" / "0003.txt").write_text("\n".join(rows))
    sequence = open_sequence(root / "image_02" / "0003")
    assert (sequence.name, sequence.format, sequence.kind) == ("0003", "kitti", "driving")
    assert in_order(sequence) and sequence.rig.baseline == pytest.approx(0.5)


def test_kitti_360_as_downloaded(tmp_path: Path, build: SimpleNamespace) -> None:
    drive = tmp_path / "data_2d_raw" / "2013_05_28_drive_0000_sync"
    for camera, first in (("image_00", 0), ("image_01", 10)):
        for i in range(6):
            build.write_image(drive / camera / "data_rect" / f"{i:010d}.png", first + i)
        times = [f"2013-05-28 08:46:{2 + 0.1 * i:012.9f}\n" for i in range(6)]
        (drive / camera / "timestamps.txt").write_text("".join(times))
    rows = ["S_rect_00: 64 48", "R_rect_00: 1 0 0 0 1 0 0 0 1", "S_rect_01: 64 48"]
    rows += [projection_row("P_rect_00", 0), projection_row("P_rect_01", -25)]
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "perspective.txt").write_text("\n".join(rows))
    poses = tmp_path / "data_poses" / drive.name / "cam0_to_world.txt"
    poses.parent.mkdir(parents=True)
    poses.write_text("".join(f"{i} 1 0 0 {i} 0 1 0 0 0 0 1 0 0 0 0 1 \n" for i in (1, 2, 5, 9)))
    sequence = open_sequence(drive)
    assert in_order(sequence) and sequence.rig.baseline == pytest.approx(0.5)
    assert np.allclose(sequence.ground_truth.stamps, [0.1, 0.2, 0.5])
    assert np.allclose(sequence.ground_truth.positions[:, 0], [1, 2, 5])


# ------------------------------------------------------------------------------------------------ calibrations


def camera_yaml(tx: float, D: str = "0.1, 0, 0, 0, 0") -> str:
    def matrix(name: str, rows: int, columns: int, data: str) -> str:
        return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{data}]\n"

    return (
        "image_width: 64\nimage_height: 48\ncamera_name: stereo/left\ndistortion_model: plumb_bob\n"
        + matrix("camera_matrix", 3, 3, "50, 0, 31, 0, 51, 23, 0, 0, 1")
        + matrix("distortion_coefficients", 1, 5, D)
        + matrix("rectification_matrix", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1")
        + matrix("projection_matrix", 3, 4, f"40, 0, 32, {tx}, 0, 40, 24, 0, 0, 0, 1, 0")
    )


def test_ros_s_two_camera_files(tmp_path: Path) -> None:
    left, right = tmp_path / "left.yaml", tmp_path / "right.yaml"
    left.write_text(camera_yaml(0))
    right.write_text(camera_yaml(-8))
    rig = slam.load_rig(left, right)
    assert (rig.left.fu, rig.left.distortion[0], rig.baseline) == (50, 0.1, pytest.approx(0.2))
    assert slam.load_rig(left, right, rectified=True).left.fu == 40
    assert slam.load_rig(tmp_path).baseline == pytest.approx(0.2)
    with pytest.raises(ConfigurationError, match=r"'unit' does nothing with .*, which is ROS's"):
        slam.load_rig(left, right, unit="mm")
    with pytest.raises(CalibrationError, match="one camera's: name both files"):
        slam.load_rig(left)
    right.write_text(camera_yaml(0))
    with pytest.raises(CalibrationError, match="P of the right one holds no baseline"):
        slam.load_rig(left, right)


ORB = "%YAML:1.0\n---\n" + "".join(f"Camera.{k}: {v}\n" for k, v in (("fx", 50), ("fy", 50), ("cx", 31), ("cy", 23)))
MATRIX = "{}: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [{}]\n"
LEFT_RIGHT = "".join(
    MATRIX.format(f"{side}.{name}", rows, columns, data)
    for side, tx in (("LEFT", 0), ("RIGHT", -8))
    for name, rows, columns, data in (
        ("D", 1, 5, "0.1, 0, 0, 0, 0"),
        ("K", 3, 3, "45, 0, 30, 0, 45, 22, 0, 0, 1"),
        ("R", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1"),
        ("P", 3, 4, f"40, 0, 32, {tx}, 0, 40, 24, 0, 0, 0, 1, 0"),
    )
)
ORB3 = (
    "%YAML:1.0\n---\nCamera.type: 'PinHole'\nCamera.width: 64\nCamera.height: 48\n"
    + "".join(
        f"Camera{i}.{k}: {v}\n"
        for i in (1, 2)
        for k, v in (("fx", 45), ("fy", 46), ("cx", 31), ("cy", 23), ("k1", 0.1), ("k2", 0), ("p1", 0), ("p2", 0))
    )
    + MATRIX.format("Stereo.T_c1_c2", 4, 4, "1, 0, 0, 0.2, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1")
)
STELLA = (
    "Camera:\n  setup: stereo\n  model: perspective\n  fx: 50\n  fy: 50\n  cx: 31\n  cy: 23\n  cols: 64\n  rows: 48\n"
    "  focal_x_baseline: 10\n"
)
STELLA_RAW = STELLA + (
    "StereoRectifier:\n  model: perspective\n"
    + "".join(
        f"  K_{side}: [45, 0, 31, 0, 45, 23, 0, 0, 1]\n  D_{side}: [0.1, 0, 0, 0, 0]\n"
        f"  R_{side}: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
        for side in ("left", "right")
    )
)
ZED = (
    "".join(
        f"[{side}_CAM_{name}]\nfx={f}\nfy={f}\ncx={f}\ncy={f // 2}\nk1=0.1\nk2=0\n"
        for side in ("LEFT", "RIGHT")
        for name, f in (("HD", 600), ("VGA", 300))
    )
    + "[STEREO]\nBaseline=120\nTY=0.1\nTZ=0.2\nRX_HD=0.01\nCV_HD=0.02\nRZ_HD=0.0\n"
)
OAK_CAMERA = (
    '[{socket}, {{"cameraType": 0, "width": 64, "height": 48, "distortionCoeff": [0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, '
    '0, 0, 0, 0], "intrinsicMatrix": [[45, 0, 31], [0, 45, 23], [0, 0, 1]], '
    '"extrinsics": {{"rotationMatrix": [[1, 0, 0], '
    '[0, 1, 0], [0, 0, 1]], "toCameraSocket": {to}, "translation": {{"x": {x}, "y": 0, "z": 0}}}}}}]'
)
OAK = '{"cameraData": [' + OAK_CAMERA.format(socket=1, to=2, x=-20) + ", " + OAK_CAMERA.format(socket=2, to=0, x=3)
OAK += '], "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2}}'


@pytest.mark.parametrize(
    ("name", "text", "size", "focal", "baseline", "rectified"),
    [
        ("orb.yaml", ORB + "Camera.bf: 10\nCamera.width: 64\nCamera.height: 48\n", None, 50, 0.2, True),
        ("orb_raw.yaml", ORB + "Camera.bf: 10\n" + LEFT_RIGHT, (64, 48), 45, 0.2, False),
        ("orb3.yaml", ORB3, None, 45, 0.2, False),
        ("stella.yaml", STELLA, None, 50, 0.2, True),
        ("stella_raw.yaml", STELLA_RAW, None, 45, 0.2, False),
        ("SN123.conf", ZED, (1280, 720), 600, 0.12, False),
        ("SN123.conf", ZED, (672, 376), 300, 0.12, False),
        ("oak.json", OAK, None, 45, 0.2, False),
    ],
)
def test_calibrations_of_other_programs(
    tmp_path: Path, name: str, text: str, size: tuple[int, int] | None, focal: float, baseline: float, rectified: bool
) -> None:
    file = tmp_path / name
    file.write_text(text)
    rig = slam.load_rig(file, size=size)
    assert rig.left.fu == focal and rig.is_rectified == rectified
    assert rig.baseline == pytest.approx(baseline, rel=1e-5)
    assert rectified or rig.left.distortion[0] == 0.1
    with pytest.raises(ConfigurationError, match="'unit' does nothing with"):
        slam.load_rig(file, size=size, unit="mm")


def test_what_is_recognised_but_cannot_be_read_is_named(tmp_path: Path) -> None:
    file = tmp_path / "a.conf"
    file.write_text(ZED)
    with pytest.raises(CalibrationError, match="it is a ZED's, for images of another size than 64x48; it has 1280x720"):
        slam.load_rig(file, size=(64, 48))
    file.write_text(ORB + "Camera.k1: 0.1\nCamera.bf: 10\n")
    with pytest.raises(CalibrationError, match="names distortion, but only one camera"):
        slam.load_rig(file, size=(64, 48))
    file.write_text(OAK.replace('"toCameraSocket": 2', '"toCameraSocket": 0'))
    with pytest.raises(CalibrationError, match="depthai's, but says nothing of how the pair stands"):
        slam.load_rig(file)
    for number, text in enumerate(("Image_Size: [64, 48]\nfoo_Bar: 1\n", "K1: [1]\n")):
        (tmp_path / f"{number}.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=r"in it: Image_Size, K1, foo_Bar"):
        slam.load_rig(tmp_path / "0.yaml", tmp_path / "1.yaml")


def test_a_calibration_for_other_images_is_said_before_what_fails(two_folders: Path, build: SimpleNamespace) -> None:
    K, D = np.array([[12.0, 0, 7], [0, 12, 5], [0, 0, 1]]), np.array([[-0.35, 0.15, 0, 0]])
    entries = {"K1": K, "K2": K, "D1": D, "D2": D, "R": np.eye(3), "T": np.array([[-0.12], [0], [0]])}
    build.write_storage(two_folders / "calibration.yaml", entries)
    with pytest.raises(CalibrationError, match=r"\(7, 5\) px, .*is the calibration for images of another size\?"):
        slam.StereoSlam(open_sequence(f"{two_folders}?fps=10").rig)


def test_the_errors_of_a_rig_are_no_rig(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text('{"rig": {}, "residual_scale": 1, "parameters": []}')
    with pytest.raises(CalibrationError, match=r"errors of a rig, .* not a rig: see --calibration"):
        slam.load_rig(tmp_path)


def test_a_written_calibration_is_of_the_images_as_recorded(tmp_path: Path) -> None:
    from slam.sequences.calibration_files import write_kalibr, write_opencv
    from slam.sequences.rigs import read_rig

    camera = slam.StereoRig.from_pinhole([[50.0, 0, 20], [0, 50, 30], [0, 0, 1]], baseline=0.2, size=(48, 64)).left
    camera = replace(camera, model="radtan", distortion=(0.1, 0.0, 0.01, 0.02))
    rig = slam.StereoRig.side_by_side(camera, camera, np.eye(3), np.array([0.0, -0.2, 0.0]))
    for write in (write_opencv, write_kalibr):
        write(tmp_path / "c.yaml", rig)
        again = read_rig([tmp_path / "c.yaml"], (48, 64), {})
        assert again.turns == rig.turns == 1
        assert again.left == rig.left and np.allclose(again.b, rig.b)
