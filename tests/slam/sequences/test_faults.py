"""Bad input: one clear line each. Whole sequences raise, single frames are reported and the others go on."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from slam.errors import CalibrationError, SequenceError, SlamError
from slam.sequences import open_sequence

# ------------------------------------------------------------------------------------------------ whole sequences


def one_line(error: pytest.ExceptionInfo[Exception]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def test_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="there is no such folder") as error:
        open_sequence(tmp_path / "nowhere")
    assert "nowhere" in one_line(error)


def test_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="the folder is empty"):
        open_sequence(tmp_path)


def test_a_file_where_the_sequence_should_be(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("hello")
    (tmp_path / "both.mp4").write_text("x")
    with pytest.raises(SequenceError, match=r"folder should be; a video .* is .*both\.mp4\?layout=sbs"):
        open_sequence(tmp_path / "both.mp4")
    with pytest.raises(SequenceError, match=r"nowhere\.bag: there is no such file or folder"):
        open_sequence(tmp_path / "nowhere.bag")
    with pytest.raises(SequenceError, match=r"a\.txt: a file where the sequence's folder should be$"):
        open_sequence(tmp_path / "a.txt")


def test_a_folder_of_no_known_format(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(SequenceError, match="no sequence of a known format"):
        open_sequence(tmp_path)


def test_a_misspelt_folder_is_answered_with_the_one_beside_it(tmp_path: Path) -> None:
    (tmp_path / "corridor").mkdir()
    with pytest.raises(SequenceError, match=f"did you mean '{tmp_path / 'corridor'}'"):
        open_sequence(tmp_path / "coridor" / "left")
    with pytest.raises(SequenceError, match=f"{tmp_path} has no 'garden'"):
        open_sequence(tmp_path / "garden" / "left")


def test_a_folder_in_a_sequence_names_the_sequence(kitti: Path, euroc: Path) -> None:
    for folder, name in ((kitti / "image_0", "kitti"), (euroc / "mav0" / "cam0" / "data", "euroc")):
        root = kitti if name == "kitti" else euroc
        with pytest.raises(SequenceError, match=f"give {root}(/mav0)? .format {name}"):
            open_sequence(folder)


def test_two_folders_of_images_by_other_names_are_named(tmp_path: Path) -> None:
    for name in ("cam_l", "cam_r"):
        (tmp_path / name).mkdir()
        for k in range(2):
            (tmp_path / name / f"{k}.png").write_bytes(b"")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.png").write_bytes(b"")
    with pytest.raises(SequenceError, match=rf"say which is which: '{tmp_path.name}\?left=cam_l&right=cam_r'$"):
        open_sequence(tmp_path)


def test_a_folder_above_sequences_names_them(kitti: Path, raw: Path) -> None:
    with pytest.raises(SequenceError, match=r"no sequence of a known format .*; below it are sequences.03$"):
        open_sequence(kitti.parent.parent)
    with pytest.raises(SequenceError, match=r"below it are 2011_09_26_drive_0013_sync$"):
        open_sequence(raw.parent)


@pytest.mark.parametrize(
    ("fixture", "right"),
    [("euroc", "mav0/cam1"), ("kitti", "image_1"), ("raw", "image_01"), ("two_folders", "right")],
)
class TestOneCamera:
    def test_the_right_camera_is_missing(self, fixture: str, right: str, request: pytest.FixtureRequest) -> None:
        folder: Path = request.getfixturevalue(fixture)
        shutil.rmtree(folder / right)
        with pytest.raises(SequenceError, match="two cameras are needed") as error:
            open_sequence(folder)
        assert str(folder) in one_line(error)

    def test_a_file_stands_where_its_folder_should(
        self, fixture: str, right: str, request: pytest.FixtureRequest
    ) -> None:
        folder: Path = request.getfixturevalue(fixture)
        shutil.rmtree(folder / right)
        (folder / right).write_text("hello")
        with pytest.raises(SequenceError, match=r"a file where a folder|two cameras are needed"):
            open_sequence(folder)

    def test_it_has_no_images(self, fixture: str, right: str, request: pytest.FixtureRequest) -> None:
        folder: Path = request.getfixturevalue(fixture)
        for path in (folder / right).rglob("*.png"):
            path.unlink()
        with pytest.raises(SequenceError, match=r"no images|none of the 6 images"):
            open_sequence(folder)


@pytest.mark.parametrize(
    ("fixture", "calibration"),
    [
        ("euroc", "mav0/cam1/sensor.yaml"),
        ("kitti", "calib.txt"),
        ("raw", "../calib_cam_to_cam.txt"),
        ("two_folders", "calibration.yaml"),
    ],
)
class TestCalibration:
    def test_missing(self, fixture: str, calibration: str, request: pytest.FixtureRequest) -> None:
        folder: Path = request.getfixturevalue(fixture)
        (folder / calibration).unlink()
        with pytest.raises(CalibrationError, match="calibration is missing") as error:
            open_sequence(folder)
        assert str(folder.parent) in one_line(error)

    @pytest.mark.parametrize("content", [b"", b"hello", b"\x00\xff\xfe" * 50, b"K1: [1, 2", b"%YAML:1.0\n---\nK1: 3\n"])
    def test_unreadable(
        self,
        fixture: str,
        calibration: str,
        content: bytes,
        request: pytest.FixtureRequest,
        capfd: pytest.CaptureFixture,
    ) -> None:
        folder: Path = request.getfixturevalue(fixture)
        (folder / calibration).write_bytes(content)
        with pytest.raises(CalibrationError) as error:
            open_sequence(folder)
        assert Path(calibration).name in one_line(error)
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("word", ["nan", "inf"])
    def test_not_finite(self, fixture: str, calibration: str, word: str, request: pytest.FixtureRequest) -> None:
        folder: Path = request.getfixturevalue(fixture)
        path = folder / calibration
        text = path.read_text()
        for number in ("50.0,", "5.000000e+01", "50."):
            if number in text:
                yaml = path.suffix == ".yaml"
                text = text.replace(number, (f".{word}" if yaml else word) + ("," if number.endswith(",") else ""), 1)
                break
        path.write_text(text)
        with pytest.raises(CalibrationError, match="not finite") as error:
            open_sequence(folder)
        assert path.name in one_line(error)


def test_cameras_swapped(euroc: Path, kitti: Path, raw: Path, two_folders: Path, build: SimpleNamespace) -> None:
    build.write_sensor(euroc / "mav0" / "cam1" / "sensor.yaml", -0.11)
    for path in (kitti / "calib.txt", raw.parent / "calib_cam_to_cam.txt"):
        path.write_text(path.read_text().replace("-2.500000e+01", "2.500000e+01"))
    build.write_storage(two_folders / "calibration.yaml", build.stereo_entries(-0.2))
    for folder, name in ((euroc, "sensor.yaml"), (kitti, "calib.txt"), (raw, "calib_cam"), (two_folders, "calib")):
        with pytest.raises(CalibrationError, match="are the cameras swapped") as error:
            open_sequence(folder)
        assert name in one_line(error)


@pytest.mark.parametrize(
    ("fixture", "right"),
    [("euroc", "mav0/cam1/data"), ("kitti", "image_1"), ("raw", "image_01/data"), ("two_folders", "right")],
)
def test_left_and_right_images_of_unequal_size(
    fixture: str, right: str, request: pytest.FixtureRequest, build: SimpleNamespace
) -> None:
    folder: Path = request.getfixturevalue(fixture)
    for path in (folder / right).iterdir():
        build.write_image(path, 0, width=60)
    with pytest.raises(SequenceError, match=r"differ in size: .* is 64x48, .* is 60x48") as error:
        open_sequence(folder)
    one_line(error)


def test_images_of_another_size_than_the_calibration(
    euroc: Path, raw: Path, two_folders: Path, build: SimpleNamespace
) -> None:
    entries = {**build.stereo_entries(), "image_width": 640, "image_height": 480}
    build.write_storage(two_folders / "calibration.yaml", entries)
    for folder in (euroc, raw):
        for path in folder.rglob("*.png"):
            build.write_image(path, 0, width=74, height=58)
    with pytest.raises(SequenceError, match=r"images are 74x58, but .*sensor\.yaml is for 64x48"):
        open_sequence(euroc)
    with pytest.raises(CalibrationError, match=r"cam_to_cam.*images are 74x58.*64x48.*unrectified \(extract\) drive"):
        open_sequence(raw)
    with pytest.raises(SequenceError, match=r"images are 64x48, but .*calibration\.yaml is for 640x480"):
        open_sequence(two_folders)


def test_cameras_that_never_fire_together(euroc: Path, build: SimpleNamespace) -> None:
    stamps = [build.T0 + i * build.STEP for i in range(6)]
    table = euroc / "mav0" / "cam1" / "data.csv"
    table.write_text("".join(f"{s + 20_000_000},{s}.png\n" for s in stamps))
    with pytest.raises(SequenceError, match="the nearest two are 20 ms apart, 5 ms are allowed; see tolerance="):
        open_sequence(euroc)


def test_no_pair_of_images_is_readable(kitti: Path, build: SimpleNamespace) -> None:
    for path in (kitti / "image_1").iterdir():
        build.cut(path)
    with pytest.raises(SequenceError, match=r"no pair of images can be read: .*PNG is cut off"):
        open_sequence(kitti)


@pytest.mark.parametrize("row", ["P1: 0 0 0 0 0 0 0 0 0 0 0 0", "P1: 50 1 31.5 -25 0 50 23.5 0 0 0 1 0", "P1: 1 2 3"])
def test_a_projection_that_is_none(kitti: Path, row: str) -> None:
    lines = (kitti / "calib.txt").read_text().splitlines()
    (kitti / "calib.txt").write_text("\n".join([lines[0], row]))
    with pytest.raises(CalibrationError, match=r"calib\.txt: (not a rectified projection|P1 has 3 numbers)"):
        open_sequence(kitti)


# ------------------------------------------------------------------------------------------------ stamps


def test_a_list_that_is_none_is_named_with_its_row(euroc: Path, kitti: Path, raw: Path) -> None:
    (euroc / "mav0" / "cam0" / "data.csv").write_text("#timestamp,filename\nfirst row,a.png\nsecond,b.png\n")
    with pytest.raises(SequenceError, match=r"cam0/data\.csv, row 2: 'first row' is not a time in whole nanosec"):
        open_sequence(euroc)
    (kitti / "times.txt").write_text("0.0\nnan\nnan\nnan\n")
    with pytest.raises(SequenceError, match=r"times\.txt, row 2: 'nan' is not a finite time"):
        open_sequence(kitti)
    (raw / "image_00" / "timestamps.txt").write_text("half past one\n" * 6)
    with pytest.raises(SequenceError, match=r"timestamps\.txt, row 1: 'half past one' is not a date and time"):
        open_sequence(raw)
    (raw / "image_00" / "timestamps.txt").write_text("\n\n")
    with pytest.raises(SequenceError, match=r"timestamps\.txt: the file has no rows"):
        open_sequence(raw)


def test_a_row_that_is_no_stamp_costs_its_frame(euroc: Path, kitti: Path) -> None:
    for path, broken in ((euroc / "mav0" / "cam0" / "data.csv", 3), (kitti / "times.txt", 2)):
        lines = path.read_text().splitlines()
        lines[broken] = "abc"
        path.write_text("\n".join(lines))
    sequence = open_sequence(euroc)
    assert len(sequence) == 5
    assert "cam0/data.csv, row 4: 'abc' is not a time in whole nanoseconds; row left out" in sequence.warnings[0]
    sequence = open_sequence(kitti)
    assert np.allclose(sequence.stamps, [0, 0.1, 0.3, 0.4, 0.5])
    assert "times.txt, row 3: 'abc' is not a time in seconds; row left out" in sequence.warnings[0]


def test_stamps_that_stand_twice_or_run_backwards_cost_their_frames(euroc: Path, kitti: Path) -> None:
    table = euroc / "mav0" / "cam0" / "data.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:4], lines[3], lines[1], *lines[4:]]))
    sequence = open_sequence(euroc)
    assert len(sequence) == 6
    assert "2 of 8 stamps stand twice or run backwards" in sequence.warnings[0]
    (kitti / "times.txt").write_text("0\n0.1\n99\n0.1\n0.3\n0.4\n")  # one leap ahead must not cost all that follow
    sequence = open_sequence(kitti)
    assert np.allclose(sequence.stamps, [0, 0.1, 0.3, 0.4])
    assert "2 times stand twice or run backwards" in sequence.warnings[0]


def test_time_that_runs_backwards_altogether(euroc: Path, kitti: Path) -> None:
    table = euroc / "mav0" / "cam0" / "data.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0], *lines[:0:-1]]))
    with pytest.raises(SequenceError, match="5 of 6 stamps stand twice or run backwards"):
        open_sequence(euroc)
    (kitti / "times.txt").write_text("".join(f"{6 - i}\n" for i in range(6)))
    with pytest.raises(SequenceError, match="of 6 images 0 have no time and 5 one that does not increase"):
        open_sequence(kitti)


# ------------------------------------------------------------------------------------------------ pairs


def test_one_camera_ahead_of_the_other(euroc: Path, kitti: Path, build: SimpleNamespace) -> None:
    stamps = [build.T0 + i * build.STEP for i in range(6)]
    build.write_csv(euroc / "mav0" / "cam1", stamps[2:])
    build.write_csv(euroc / "mav0" / "cam0", stamps[:5])
    for i in (0, 1):
        (kitti / "image_1" / f"{i:06d}.png").unlink()
    (kitti / "image_0" / "000005.png").unlink()
    for folder in (euroc, kitti):
        sequence = open_sequence(folder)
        frames = list(sequence)
        assert len(frames) == len(sequence) == 3
        assert all(f.right is not None for f in frames)
        text = "\n".join(sequence.warnings)
        assert "2 images before the first pair and 0 after the last are left out" in text
        assert "1 images have no partner" in text
    assert np.allclose(sequence.stamps, [0.2, 0.3, 0.4])
    assert sequence.ground_truth is not None
    assert np.allclose(sequence.ground_truth.positions[:, 2], [3, 4.5, 6])


def test_stamps_that_differ_a_little_are_paired(euroc: Path, build: SimpleNamespace) -> None:
    stamps = [build.T0 + i * build.STEP for i in range(6)]
    table = euroc / "mav0" / "cam1" / "data.csv"
    table.write_text("".join(f"{s + (-1) ** i * 4_000_000},{s}.png\n" for i, s in enumerate(stamps)))
    sequence = open_sequence(euroc)
    assert [f.right is not None for f in sequence] == [True] * 6
    assert sequence.warnings == []


def test_listed_images_that_are_missing(euroc: Path, build: SimpleNamespace) -> None:
    names = [f"{build.T0 + i * build.STEP}.png" for i in range(6)]
    (euroc / "mav0" / "cam0" / "data" / names[1]).unlink()
    (euroc / "mav0" / "cam1" / "data" / names[3]).unlink()
    sequence = open_sequence(euroc)
    frames = list(sequence)
    assert [f.right is not None for f in frames] == [True, True, False, True, True]
    text = "\n".join(sequence.warnings)
    assert f"cam0/data.csv: 1 of 6 listed images are missing (first: {names[1]})" in text
    assert f"cam1/data.csv: 1 of 6 listed images are missing (first: {names[3]})" in text
    assert f"1 images have no partner in {euroc / 'mav0' / 'cam1' / 'data'} (first: {names[3]})" in text


def test_a_gap_in_numbered_images(kitti: Path) -> None:
    for number in (0, 1):
        (kitti / f"image_{number}" / "000003.png").unlink()
    sequence = open_sequence(kitti)
    assert [f.stamp for f in sequence] == pytest.approx([0, 0.1, 0.2, 0.4, 0.5])
    assert f"{kitti / 'image_0'}: 1 images are missing between the first and the last (after 000002.png)" in (
        sequence.warnings
    )


# ------------------------------------------------------------------------------------------------ frames


def test_an_unreadable_left_image_costs_its_frame(
    kitti: Path, build: SimpleNamespace, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture
) -> None:
    build.cut(kitti / "image_0" / "000002.png")
    sequence = open_sequence(kitti)
    with caplog.at_level(logging.WARNING, "slam.sequences"):
        frames = list(sequence)
    assert [f.index for f in frames] == [0, 1, 3, 4, 5]
    assert frames[2].stamp == pytest.approx(0.3)
    assert len(caplog.records) == 1
    assert caplog.records[0].name == "slam.sequences"
    assert "frame 2 skipped: " in caplog.text
    assert "000002.png: PNG is cut off after" in caplog.text
    assert sequence.warnings == [caplog.records[0].getMessage()]
    assert capfd.readouterr().err == ""  # neither OpenCV nor libpng says it again


def test_an_unreadable_right_image_leaves_the_left_one(kitti: Path, build: SimpleNamespace) -> None:
    build.cut(kitti / "image_1" / "000000.png")
    sequence = open_sequence(kitti)
    frames = list(sequence)
    assert [f.right is None for f in frames] == [True, False, False, False, False, False]
    assert "frame 0 is given without its right image: " in sequence.warnings[0]


def test_a_later_image_of_another_size(kitti: Path, build: SimpleNamespace) -> None:
    build.write_image(kitti / "image_0" / "000002.png", 2, width=32)
    build.write_image(kitti / "image_1" / "000004.png", 2, width=32)
    sequence = open_sequence(kitti)
    assert [(f.index, f.right is None) for f in sequence] == [(0, False), (1, False), (3, False), (4, True), (5, False)]
    assert "000002.png: image is 32x48, not 64x48" in sequence.warnings[0]


def test_an_image_that_vanishes_after_opening(kitti: Path) -> None:
    sequence = open_sequence(kitti)
    (kitti / "image_0" / "000001.png").unlink()
    assert [f.index for f in sequence] == [0, 2, 3, 4, 5]
    assert "000001.png: No such file" in sequence.warnings[0]


def test_many_faults_of_a_kind_are_summed_up(
    kitti: Path, build: SimpleNamespace, caplog: pytest.LogCaptureFixture
) -> None:
    for i in range(6, 40):
        for number in (0, 1):
            build.write_image(kitti / f"image_{number}" / f"{i:06d}.png", i % 20)
    (kitti / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(40)))
    for i in range(10, 40):
        (kitti / "image_0" / f"{i:06d}.png").write_bytes(b"not an image")
    (kitti.parent.parent / "poses" / "03.txt").unlink()
    sequence = open_sequence(kitti)
    for _ in range(2):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "slam.sequences"):
            assert len(list(sequence)) == 10
        assert len(caplog.records) == 6
        assert caplog.records[-1].getMessage() == "left images unreadable, frames skipped: 30 in all, 25 not listed"
    assert len(sequence.warnings) == 6  # kept once, though read twice


def test_broken_ground_truth_is_reported_and_left_out(euroc: Path, kitti: Path) -> None:
    (euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text("stamp\nx,y\n")
    (kitti.parent.parent / "poses" / "03.txt").write_text("1 0 0\n")
    for folder in (euroc, kitti):
        sequence = open_sequence(folder)
        assert sequence.ground_truth is None
        assert "there is no ground truth" in sequence.warnings[-1]


def test_ground_truth_with_fewer_poses_than_frames(kitti: Path) -> None:
    path = kitti.parent.parent / "poses" / "03.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:4]))
    sequence = open_sequence(kitti)
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth) == 4
    assert "4 poses, 2 frames are beyond them" in sequence.warnings[0]


# ------------------------------------------------------------------------------------------------ memory


def test_a_long_sequence_is_opened_and_read_in_constant_memory(kitti: Path, build: SimpleNamespace) -> None:
    """300 images of 0.5 MB, linked to one file: the peak while iterating stays far below their sum."""
    big = kitti.parent / "big.png"
    cv2.imwrite(str(big), np.random.default_rng(0).integers(0, 255, (700, 700)).astype(np.uint8))
    for number in (0, 1):
        for i in range(300):
            path = kitti / f"image_{number}" / f"{i:06d}.png"
            path.unlink(missing_ok=True)
            os.link(big, path)
    (kitti / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(300)))
    code = (
        "import resource, sys; from slam.sequences import open_sequence; import cv2\n"
        "sequence = open_sequence(sys.argv[1])\n"
        "for frame in sequence.frames(0, 3): pass\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "for frame in sequence.frames(0, 60): pass\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    pytest.importorskip("resource")
    run = subprocess.run([sys.executable, "-c", code, str(kitti)], capture_output=True, text=True, check=True)
    assert int(run.stdout) < 15_000  # kilobytes; 60 frames more of two images each would be 58 000


# ------------------------------------------------------------------------------------------------ anything


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes replaced, lines shuffled, a line or a word lost, a word replaced, or the end cut off."""
    lines, words = data.split(b"\n"), data.split(b" ")
    at, word = int(rng.integers(len(lines))), int(rng.integers(len(words)))
    junk = [b"nan", b"-1", b"1e400", b"", b"\0", b"0", b"99999999999999999999", b"[", b"{a: b}"][rng.integers(9)]
    flipped = bytearray(data)
    for i in rng.integers(0, len(data), 3):
        flipped[i] = rng.integers(256)
    return [
        bytes(flipped),
        b"\n".join(lines[i] for i in rng.permutation(len(lines))),
        b"\n".join(lines[:at] + lines[at + 1 :]),
        b" ".join(words[:word] + words[word + 1 :]),
        b" ".join([*words[:word], junk, *words[word + 1 :]]),
        data[: rng.integers(len(data))],
    ][rng.integers(6)]


@pytest.mark.parametrize("fixture", ["euroc", "kitti", "raw", "two_folders"])
def test_damaged_files_are_errors_or_warnings_never_anything_else(
    fixture: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    folder: Path = request.getfixturevalue(fixture)
    if fixture == "two_folders":
        (folder / "times.txt").write_text("0\n1\n2\n3\n4\n5\n")
    files = sorted(p for p in tmp_path.rglob("*") if p.suffix in (".txt", ".csv", ".yaml"))
    rng = np.random.default_rng(8)
    for _ in range(60):
        path = files[rng.integers(len(files))]
        data = path.read_bytes()
        path.write_bytes(damage(data, rng))
        try:
            stamps = [f.stamp for f in open_sequence(folder)]
            assert (np.diff(stamps) > 0).all()
        except SlamError as error:
            assert "\n" not in str(error)
        path.write_bytes(data)
    assert len(open_sequence(folder)) == 6
