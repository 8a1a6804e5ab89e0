"""Two folders or videos and what people bring: names of images, layouts, tolerances, masks, rigs of any stand."""

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, ConfigurationError, SequenceError, SlamError
from slam.geometry.trajectory import TruthNoise
from slam.sequences import open_sequence, with_mask
from slam.worlds import open_world
from tests import recordings
from tests.recordings import FIVE, rename, seeds

PAIRS = [(i, i + 10) for i in range(6)]

NAMES = {  # of the left and the right images, and the stamps that they say; plain numbers count frames at 10 Hz
    "nanoseconds": ("{}", "{}", lambda i: 1_403_715_273_000_000_000 + i * 50_000_000, 1_403_715_273, 0.05),
    "microseconds": ("{}", "{}", lambda i: 1_403_715_273_000_000 + i * 50_000, 1_403_715_273, 0.05),
    "milliseconds": ("{}", "{}", lambda i: 1_403_715_273_000 + i * 50, 1_403_715_273, 0.05),
    "comma": ("a1700000000,{:03d}", "a1700000000,{:03d}", lambda i: 7 + 50 * i, 1.7e9 + 0.007, 0.05),
    "since a start": ("{}", "{}", lambda i: 2_000_000_000 * (i + 1), 2.0, 2.0),
    "seconds": ("1403715273.{:02d}", "1403715273.{:02d}", lambda i: 5 * i, 1_403_715_273, 0.05),
    "seconds since a start": ("{:.3f}", "{:.3f}", lambda i: 9.95 + 0.05 * i, 9.95, 0.05),
    "unpadded": ("c-1700000000.{}", "c-1700000000.{}", lambda i: 97000 + 1500 * i, 1.7e9 + 0.097, 0.0015),
    "whole seconds": ("{}", "{}", lambda i: 1_600_000_000 + i, 1.6e9, 1.0),
    "ISO": ("2023-04-05T12:00:{:02d}.250000Z",) * 2 + (lambda i: i, 1680696000.25, 1.0),
    "seconds and nanoseconds": ("{0[0]}_{0[1]:09d}",) * 2
    + (lambda i: divmod(1_403_636_579_900_000_000 + i * 50_000_000, 10**9), 1403636579.9, 0.05),
    "seconds and a count": ("1600000000_{:06d}",) * 2 + (lambda i: 3 + i, 0.0, 0.1),
    "date and time": ("20230405_120000_{:03d}",) * 2 + (lambda i: 90 * i, 1680696000, 0.09),
    "seconds of minutes": ("20230405_12{0[0]:02d}{0[1]:02d}",) * 2 + (lambda i: divmod(57 + i, 60), 1680696057, 1.0),
    "two dates": ("2018-07-09-16-11-56_2018-07-09-16-11-5{0[0]}-{0[1]:03d}",) * 2
    + (lambda i: divmod(6700 + 110 * i, 1000), 1531152716.7, 0.11),
    "date of the session": ("20230405_120000_{:03d}",) * 2 + (lambda i: i, 0.0, 0.1),
    "time of day behind a date": ("20230405_{0[0]:06d}.{0[1]:02d}",) * 2 + (lambda i: (120057 + i, 25), 0.0, 0.1),
    "malaga": ("img_C1_{:.6f}_left", "img_C1_{:.6f}_right", lambda i: 1261228749.91 + 0.04 * i, 1261228749.91, 0.04),
    "inside, since a start": ("left_{:.3f}", "right_{:.3f}", lambda i: 12.85 + 0.05 * i, 12.85, 0.05),
    "before a start": ("{:.2f}", "{:.2f}", lambda i: -0.1 + 0.05 * i, -0.1, 0.05),
    "time of day": ("a12-{0[0]:02.0f}-{0[1]:04.1f}",) * 2 + (lambda i: divmod(238.5 + 0.5 * i, 60), 0.0, 0.1),
    "exposure in seconds": ("{0[0]:05d}_{0[1]:.3f}",) * 2 + (lambda i: (i, 0.02 - 0.002 * i), 0.0, 0.1),
    "numbers": ("frame{:04d}", "frame{:04d}", lambda i: 3 + i, 0.0, 0.1),
    "unpadded numbers": ("{}_cam0", "{}_cam1", lambda i: 7 + i, 0.0, 0.1),
    "size in name": ("frame{}_1226x370", "frame{}_1226x370", lambda i: 7 + i, 0.0, 0.1),
    "letters": ("{}", "{}", "abcdef".__getitem__, 0.0, 0.1),
    "two numbers": ("seq{0[0]}_{0[1]}", "seq{0[0]}_{0[1]}", lambda i: (1 + i // 4, i % 4), 0.0, 0.1),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_are_read_as_numbers_and_stamps(two_folders: Path, name: str) -> None:
    left, right, number, first, step = NAMES[name]
    for side, form in (("left", left), ("right", right)):
        rename(two_folders / side, lambda i, form=form: form.format(number(i)) + ".png")
    sequence = open_sequence(two_folders)
    assert seeds(sequence) == PAIRS
    assert np.allclose(sequence.stamps, first + step * np.arange(6), atol=2e-6, rtol=0)
    assert any("10 frames per second assumed" in w for w in sequence.warnings) == (first == 0)


@pytest.mark.parametrize(
    ("heading", "row", "first", "step"),
    [
        ("timestamp\n", "{s:.6f}", 1.7e9, 0.1),
        ("t [s];file\n", "{s:.6f};{i:06d}.png", 1.7e9, 0.1),
        ("", "{ns}", 1.7e9, 0.1),
        ("", "{ns0}", 0.0, 0.1),
        ("", "{slow}", 1.7e9, 20.0),
        ("", "{i} {ns}", 1.7e9, 0.1),
        ("frame;t\n", "{n};{s:.6f}", 1.7e9, 0.1),
        ("", "2023-11-14 22:13:2{i}.500000", 1.7e9 + 0.5, 1.0),
        ("", "1999-11-14 22:13:2{i}.5", 942617600.0 + 0.5, 1.0),
        ("", "{ns_boot}", 20011.228, 0.1),  # no date
        ("", "{i:03d}.png {s:.6f}", 1.7e9, 0.1),
    ],
)
def test_times_as_other_programs_write_them(two_folders: Path, heading, row, first, step) -> None:
    """A heading is no row, which would shift all times by one; nanoseconds are no seconds."""
    starts = {"ns0": 0, "ns": 17 * 10**17, "ns_boot": 20_011_228_000_000}
    ns = [{name: start + i * 10**8 for name, start in starts.items()} for i in range(6)]
    rows = [row.format(i=i, n=i + 100, s=1.7e9 + 0.1 * i, slow=17 * 10**8 + 20 * i, **ns[i]) + "\n" for i in range(6)]
    (two_folders / "times.txt").write_text(heading + "".join(rows))
    sequence = open_sequence(two_folders)
    assert np.allclose(sequence.stamps, first + step * np.arange(6), rtol=0, atol=1e-5) and len(sequence) == 6
    assert any("taken as nanoseconds" in line for line in sequence.warnings) == ("ns" in row)


@pytest.mark.parametrize("row", ["{n:03d}.png,{t}", "{t} left/{n:03d}.png", "{t}"])
@pytest.mark.parametrize("first", [0, 1])
def test_rows_of_times_belong_to_the_images_that_they_name_or_number(two_folders: Path, row: str, first: int) -> None:
    for side in ("left", "right"):
        rename(two_folders / side, lambda i: f"{i + first:03d}.png")
        (two_folders / side / f"{2 + first:03d}.png").unlink()
    rows = [row.format(n=i + first, t=7 + 0.3 * i) + "\n" for i in range(6)]
    (two_folders / "times.txt").write_text("".join(rows))
    sequence = open_sequence(two_folders)
    assert np.allclose(sequence.stamps, 7 + 0.3 * np.array([0, 1, 3, 4, 5]))
    assert [left for left, _ in seeds(sequence)] == [0, 1, 3, 4, 5]


def test_one_camera_twice_is_refused(two_folders: Path, videos: Path) -> None:
    queries = [f"{two_folders}?left=left&right=left", f"{videos}?left=left.avi&right=left.avi"]
    (two_folders / "link").symlink_to(two_folders / "left")
    for path in (*queries, f"{two_folders}?left=left&right=link"):
        with pytest.raises(SequenceError, match="are the same: the left and the right camera's are needed"):
            open_sequence(path)


def test_equal_counts_with_other_stamps_are_not_paired_by_order(two_folders: Path) -> None:
    """The left camera lost one image, the right one another: as many, but not the same."""
    kept = {"left": [0, 1, 3, 4, 5, 6], "right": [0, 1, 2, 3, 4, 6]}
    for side, numbers in kept.items():
        rename(two_folders / side, lambda i, numbers=numbers: f"{10**18 + numbers[i] * 10**8}.png")
    (two_folders / "t.txt").write_text("".join(f"{i}\n" for i in range(6)))
    for query in ("", "?fps=10", "?times=t.txt"):
        frames = list(open_sequence(f"{two_folders}{query}"))
        assert [f.right is None for f in frames] == [False, False, False, False, True, False], query
    rename(two_folders / "right", lambda i: f"{2 * 10**18 + i * 10**8}.png")
    with pytest.raises(SequenceError, match="the clocks of the cameras differ"):
        open_sequence(f"{two_folders}?fps=10")


def test_a_tolerance_and_a_rate_go_with_every_format(two_folders: Path, euroc: Path, kitti: Path) -> None:
    for side, late in (("left", 0), ("right", 8_000_000)):
        rename(two_folders / side, lambda i, late=late: f"{10**18 + i * 10**8 + late}.png")
    for query, allowed in (("", "5 ms"), ("?tolerance=0.001", "1 ms")):
        with pytest.raises(SequenceError, match=rf"nearest two are 8 ms apart, {allowed} are allowed; see tolerance="):
            open_sequence(f"{two_folders}{query}")
    assert seeds(open_sequence(f"{two_folders}?tolerance=0.02")) == PAIRS
    assert np.allclose(open_sequence(f"{two_folders}?fps=20").stamps, 0.05 * np.arange(6))
    assert len(open_sequence(f"{euroc}?tolerance=0")) == 6
    for folder in (kitti, euroc):
        assert np.allclose(open_sequence(f"{folder}?fps=5").stamps, 0.2 * np.arange(6))


# ------------------------------------------------------------------------------------------------ layouts


@pytest.mark.parametrize(
    "names",
    [
        ("image_left", "image_right"), ("infra1", "infra2"), ("cam1", "cam2"), ("L", "R"), ("Camera_0", "Camera_1"),
        ("image_lcam_front", "image_rcam_front"), ("Infrared 1", "Infrared 2"),
    ],
)  # fmt: skip
def test_folders_by_other_usual_names(two_folders: Path, names: tuple[str, str]) -> None:
    for usual, name in zip(("left", "right"), names):
        (two_folders / usual).rename(two_folders / name)
    assert seeds(open_sequence(two_folders)) == PAIRS
    assert seeds(open_sequence(f"{two_folders}?swap=yes")) == [(b, a) for a, b in PAIRS]


def test_one_folder_with_both_cameras_in_it_and_patterns(two_folders: Path) -> None:
    for side in ("left", "right"):
        for path in (two_folders / side).iterdir():
            path.rename(two_folders / path.name)
        (two_folders / side).rmdir()
    assert seeds(open_sequence(two_folders)) == PAIRS
    calibration = (two_folders / "calibration.yaml").rename(two_folders / "c.yml")
    patterns = "left=left_*.png&right=right_*.png&calibration=c.yml&fps=5"
    assert open_sequence(f"{two_folders}?{patterns}").warnings == []
    inside = f"left={two_folders.name}/left_*.png&right={two_folders.name}/right_*.png&calibration={calibration}"
    assert len(open_sequence(f"{two_folders.parent}?{inside}")) == 6


def test_images_and_videos_side_by_side(two_folders: Path, tmp_path: Path) -> None:
    folder, film = tmp_path / "double", tmp_path / "walk.avi"
    folder.mkdir()
    pairs = [sorted((two_folders / side).iterdir()) for side in ("left", "right")]
    images = [np.hstack([cv2.imread(str(path), 0) for path in pair]) for pair in zip(*pairs)]
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f"{i}.png"), image)
    write_video(film, images)
    for where in (folder, tmp_path):
        (where / "calibration.yaml").write_text(FIVE)
    with pytest.raises(SequenceError, match=r"walk\.avi\?layout=sbs"):
        open_sequence(film)
    for path, name, step in ((f"{folder}?layout=sbs&fps=10", "double", 0.1), (f"{film}?layout=sbs", "walk", 0.04)):
        sequence = open_sequence(path)
        assert seeds(sequence) == PAIRS
        assert (sequence.name, len(sequence), sequence.rig.width) == (name, 6, 64)
        assert np.allclose(sequence.stamps, step * np.arange(6))
    assert seeds(open_sequence(f"{folder}?layout=sbs&swap=yes")) == [(b, a) for a, b in PAIRS]
    recordings.write_image(folder / "3.png", 3, 131)
    assert [f.index for f in open_sequence(f"{folder}?layout=sbs")] == [0, 1, 2, 4, 5]
    outer = tmp_path / "outer"
    outer.mkdir()
    film.rename(outer / film.name)
    assert seeds(open_sequence(f"{outer}?layout=sbs&calibration=../calibration.yaml")) == PAIRS
    folder.rename(outer / "images")
    with pytest.raises(SequenceError, match="2 folders and videos, where layout=sbs needs one: add left="):
        open_sequence(f"{outer}?layout=sbs")


@pytest.mark.parametrize("clockwise", [1, -1])
def test_cameras_above_each_other_are_turned(two_folders: Path, clockwise: int) -> None:
    """A rig turned by a quarter, and its images with it, gives the frames and the rig of the upright one."""
    upright = open_sequence(two_folders)
    turned = [camera.turned(-clockwise) for camera in (upright.rig.left, upright.rig.right)]
    axes = np.linalg.matrix_power(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), -clockwise % 4)
    R, b = axes @ upright.rig.R @ axes.T, axes @ upright.rig.b
    frames = list(upright)
    for side in ("left", "right"):
        for path in (two_folders / side).iterdir():
            cv2.imwrite(str(path), np.rot90(cv2.imread(str(path), 0), -clockwise))
    entries = {f"K{i}": c.K for i, c in enumerate(turned, 1)} | {"R": R, "T": R @ b}
    entries |= {f"D{i}": np.array([c.distortion]) for i, c in enumerate(turned, 1)}
    recordings.write_storage(two_folders / "calibration.yaml", entries)
    sequence = open_sequence(two_folders)
    assert sequence.rig.turns % 4 == clockwise % 4
    for a, c in ((sequence.rig.left, upright.rig.left), (sequence.rig.right, upright.rig.right)):
        assert np.allclose([a.fu, a.fv, a.u0, a.v0, *a.distortion], [c.fu, c.fv, c.u0, c.v0, *c.distortion])
    assert np.allclose(sequence.rig.R, upright.rig.R) and np.allclose(sequence.rig.b, upright.rig.b)
    for frame, expected in zip(sequence, frames, strict=True):
        assert np.array_equal(frame.left, expected.left) and np.array_equal(frame.right, expected.right)
    with pytest.raises(CalibrationError, match="turn both images by 90 degrees"):
        slam.load_rig(two_folders, size=(48, 64))


def test_the_truth_of_cameras_above_each_other_is_the_turned_camera_s(euroc: Path) -> None:
    upright = open_sequence(euroc).ground_truth
    recordings.write_sensor(euroc / "mav0" / "cam1" / "sensor.yaml", 0.11, axis=1)
    sequence = open_sequence(euroc)
    turn = np.linalg.inv(upright.poses[0]) @ sequence.ground_truth.poses[0]
    assert sequence.rig.turns == 1 and np.allclose(turn[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])


def test_masks_are_of_both_cameras_or_of_one(tmp_path: Path, two_folders: Path) -> None:
    mask = np.full((240, 320), 255, np.uint8)
    cv2.imwrite(str(tmp_path / "all.png"), mask)
    mask[:, :160] = 0
    cv2.imwrite(str(tmp_path / "left half.png"), mask)
    sequence = open_sequence(
        with_mask("synthetic:desk?frames=3", f"{tmp_path / 'left half.png'},{tmp_path / 'all.png'}")
    )
    frame = sequence[2]
    cv2.imwrite(str(tmp_path / "black.png"), 0 * mask)
    for wrong, said in (
        (with_mask("synthetic:desk?frames=3", str(tmp_path / "black.png")), "black all over"),
        (f"{two_folders}?mask={tmp_path / 'all.png'}", "another size"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            open_sequence(wrong)
    with pytest.raises(ConfigurationError, match="mask"):
        open_world("desk?frames=3&mask=none.png")
    assert frame.right_mask.all() and not frame.left_mask[:, :160].any() and frame.left_mask[:, 160:].all()
    frame = open_sequence(with_mask("synthetic:desk?frames=3", f",{tmp_path / 'left half.png'}"))[0]
    assert frame.left_mask is None and not frame.right_mask[:, :160].any()
    cv2.imwrite(str(two_folders / "m.png"), np.eye(48, 64, dtype=np.uint8))
    frame = next(iter(open_sequence(f"{two_folders}?mask=m.png")))
    assert (frame.left_mask == frame.right_mask).all() and frame.left_mask.sum() == 48


# ------------------------------------------------------------------------------------------------ videos


write_video = partial(recordings.write_video, codec="FFV1", rate=25)


def grey(first: int, count: int = 12, size: tuple[int, int] = (64, 48)) -> list[np.ndarray]:
    return [np.full(size[::-1], first + 5 * i, np.uint8) for i in range(count)]


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "films"
    recordings.write_storage(folder / "calib.yml", recordings.stereo_entries())
    write_video(folder / "left.avi", grey(10))
    write_video(folder / "right.avi", grey(100))
    return folder


def test_two_videos(videos: Path) -> None:
    sequence = open_sequence(videos)
    assert (sequence.format, len(sequence)) == ("folders", 12)
    found = [(round(f.left.mean()), round(f.right.mean())) for f in sequence]
    assert found == [(10 + 5 * i, 100 + 5 * i) for i in range(12)]
    assert np.allclose(sequence.stamps, np.arange(12) / 25)
    assert [(f.index, round(f.left.mean())) for f in sequence.frames(4, 7)] == [(4, 30), (5, 35), (6, 40)]
    assert np.allclose(open_sequence(f"{videos}?fps=10").stamps, np.arange(12) / 10)
    assert len(open_sequence(f"{videos}?left=left.avi&right=right.avi&calibration=calib.yml")) == 12
    assert sequence.warnings == []
    write_video(videos / "right.avi", grey(100), rate=30)
    with pytest.raises(SequenceError, match=r"has 25 frames per second, .* has 30: .* add fps="):
        open_sequence(videos)
    assert len(open_sequence(f"{videos}?fps=25")) == 12
    write_video(videos / "right.avi", grey(100, 9))
    sequence = open_sequence(videos)
    assert len(list(sequence)) == 9 and "has 12 frames, " in sequence.warnings[0]


def test_a_video_that_ends_too_early(videos: Path) -> None:
    noise = [np.random.default_rng(i).integers(0, 255, (48, 64)).astype(np.uint8) for i in range(12)]
    write_video(videos / "left.avi", noise, codec="MJPG")  # so that the frames are most of the file
    recordings.cut(videos / "left.avi", 0.7)
    sequence = open_sequence(videos)
    frames = list(sequence)
    assert 0 < len(frames) < len(sequence)
    assert f"left.avi: ends or is damaged at frame {len(frames)} of 12" in sequence.warnings[-1]


def test_a_true_path_is_given_by_an_option(two_folders: Path) -> None:
    stamps = open_sequence(two_folders).stamps
    truth = slam.Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    truth.poses[:, 0, 3] = 3.0 * stamps + 1.0
    truth.write_tum(two_folders / "true.txt")
    found = open_sequence(f"{two_folders}?truth=true.txt").ground_truth
    np.testing.assert_allclose(found.poses, truth.poses, atol=1e-8)
    assert open_sequence(f"{two_folders}?truth=true.txt").truth_noise == TruthNoise()
    noise = open_sequence(f"{two_folders}?truth=true.txt&truth_sigma=0.002,0.2").truth_noise
    assert noise == TruthNoise(rotation=np.radians(0.2), translation=0.002)
    for query, said in (
        ("truth=true.txt&truth_sigma=2mm", "truth_sigma in metres"),
        ("truth_sigma=0.1", "does nothing"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            open_sequence(f"{two_folders}?{query}")
    slam.Trajectory(stamps * 1e3, truth.poses).write_tum(two_folders / "ms.txt")
    (said,) = open_sequence(f"{two_folders}?truth=ms.txt").warnings[-1:]
    assert f"1 of {len(stamps)} images have a true pose" in said
    slam.Trajectory(stamps + 1e6, truth.poses).write_tum(two_folders / "late.txt")
    for name, line in (("late.txt", "no pose is within"), ("none.txt", "none.txt")):
        with pytest.raises(SlamError, match=line):
            open_sequence(f"{two_folders}?truth={name}")
