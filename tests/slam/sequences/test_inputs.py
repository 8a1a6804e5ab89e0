"""What people bring: names of images, layouts, tolerances, masks, rigs one above the other, other data sets' trees."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, SequenceError
from slam.input.features import outside_masks
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


NAMES = {  # of the left and the right images, and the stamps that they say; plain numbers count frames at 10 Hz
    "nanoseconds": ("{}", "{}", lambda i: 1_403_715_273_000_000_000 + i * 50_000_000, 1_403_715_273, 0.05),
    "microseconds": ("{}", "{}", lambda i: 1_403_715_273_000_000 + i * 50_000, 1_403_715_273, 0.05),
    "milliseconds": ("{}", "{}", lambda i: 1_403_715_273_000 + i * 50, 1_403_715_273, 0.05),
    "since a start": ("{}", "{}", lambda i: 2_000_000_000 * (i + 1), 2.0, 2.0),
    "seconds": ("1403715273.{:02d}", "1403715273.{:02d}", lambda i: 5 * i, 1_403_715_273, 0.05),
    "seconds since a start": ("{:.3f}", "{:.3f}", lambda i: 9.95 + 0.05 * i, 9.95, 0.05),
    "unpadded microseconds": (
        "cam-1700000000.{}",
        "cam-1700000000.{}",
        lambda i: 97000 + 1500 * i,
        1.7e9 + 0.097,
        0.0015,
    ),
    "inside": ("l_{}_a", "r_{}", lambda i: 10**18 + i * 10**8, 1e9, 0.1),
    "malaga": ("img_C1_{:.6f}_left", "img_C1_{:.6f}_right", lambda i: 1261228749.91 + 0.04 * i, 1261228749.91, 0.04),
    "date": ("20230405_120000_{:03d}", "20230405_120000_{:03d}", lambda i: 90 * i, 1680696000, 0.09),
    "numbers": ("frame{:04d}", "frame{:04d}", lambda i: 3 + i, 0.0, 0.1),
    "unpadded": ("{}_cam0", "{}_cam1", lambda i: 7 + i, 0.0, 0.1),
    "size in name": ("frame{}_1226x370", "frame{}_1226x370", lambda i: 7 + i, 0.0, 0.1),
    "last number is none": ("{:06d}_x0", "{:06d}_x0", lambda i: i, 0.0, 0.1),
    "letters": ("{}", "{}", "abcdef".__getitem__, 0.0, 0.1),
    "two numbers": ("seq{0[0]}_{0[1]}", "seq{0[0]}_{0[1]}", lambda i: (1 + i // 4, i % 4), 0.0, 0.1),
    "date and count": ("2023-04-05-12-00-{0[0]:02d}_{0[1]}",) * 2 + (lambda i: (i // 2, i), 0.0, 0.1),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_are_read_as_numbers_and_stamps(two_folders: Path, name: str) -> None:
    left, right, number, first, step = NAMES[name]
    for side, form in (("left", left), ("right", right)):
        rename(two_folders / side, lambda i, form=form: form.format(number(i)) + ".png")
    sequence = open_sequence(two_folders)
    assert in_order(sequence)
    assert np.allclose(sequence.stamps, first + step * np.arange(6), atol=2e-6, rtol=0)
    assert any("10 frames per second assumed" in w for w in sequence.warnings) == (first == 0)


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


def test_a_tolerance_and_a_rate_go_with_every_format(two_folders: Path, euroc: Path, kitti: Path) -> None:
    for side, late in (("left", 0), ("right", 8_000_000)):
        rename(two_folders / side, lambda i, late=late: f"{10**18 + i * 10**8 + late}.png")
    with pytest.raises(SequenceError, match=r"nearest two are 8 ms apart, 5 ms are allowed; see tolerance="):
        open_sequence(two_folders)
    assert in_order(open_sequence(f"{two_folders}?tolerance=0.02"))
    assert np.allclose(open_sequence(f"{two_folders}?fps=10").stamps, 0.1 * np.arange(6))
    with pytest.raises(SequenceError, match="1 ms are allowed"):
        open_sequence(f"{two_folders}?tolerance=0.001")
    assert len(open_sequence(f"{euroc}?tolerance=0")) == 6
    for folder in (kitti, euroc):
        assert np.allclose(open_sequence(f"{folder}?fps=5").stamps, 0.2 * np.arange(6))


def test_words_for_left_and_right() -> None:
    assert of_sides(["left_01.png", "right_01.png"]) == (["left_01.png"], ["right_01.png"])
    assert of_sides(["0_cam0.png", "0_cam1.png", "0_cam10.png"]) == (["0_cam0.png"], ["0_cam1.png"])
    assert of_sides(["L01.png", "R01.png"]) == (["L01.png"], ["R01.png"])
    assert of_sides(["brightness.png", "leftover.png"]) is None
    assert keys_of([["a.png", "b.png"]]) is None


# ------------------------------------------------------------------------------------------------ layouts


@pytest.mark.parametrize("names", [("image_left", "image_right"), ("camera0", "camera1"), ("infra1", "infra2")])
def test_folders_by_other_usual_names(two_folders: Path, names: tuple[str, str]) -> None:
    for usual, name in zip(("left", "right"), names):
        (two_folders / usual).rename(two_folders / name)
    assert in_order(open_sequence(f"{two_folders}?fps=10"))


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
        strict = outside_masks(features, frame, sequence.rig)
        assert strict.uv_left[:, 0].min() >= 159.5
        system.process(frame)
    right = open_sequence(with_mask(text, f",{tmp_path / 'left half.png'}"))
    frame = next(iter(right))
    features = outside_masks(slam.StereoSlam(right.rig).frontend.extract(frame), frame, right.rig)
    assert features.uv_left[:, 0].min() < 100
    assert np.nanmin(features.uv_right[:, 0]) >= 159.5


def test_a_mask_of_a_recording(two_folders: Path) -> None:
    cv2.imwrite(str(two_folders / "m.png"), np.eye(48, 64, dtype=np.uint8))
    frame = next(iter(open_sequence(f"{two_folders}?mask=m.png")))
    assert frame.left_mask is frame.right_mask and frame.left_mask.sum() == 48


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
