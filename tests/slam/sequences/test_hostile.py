"""Folders that somebody made on purpose: refused in one line, at no more cost than their size deserves."""

from __future__ import annotations

import os
import struct
import time
import zlib

import cv2
import numpy as np
import pytest

from slam.errors import CalibrationError, ConfigurationError, SequenceError, SlamError
from slam.sequences import open_sequence
from slam.sequences.images import MOST_PIXELS, read_image
from slam.sequences.yaml_files import read_yaml


def refused(path, error=SlamError, words=None):
    """Opening and reading it ends in one line, within a second of processor time."""
    started = time.process_time()
    with pytest.raises(error, match=words) as caught:
        list(open_sequence(path))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700
    assert time.process_time() - started < 1.0
    return str(caught.value)


# --- names and numbers ---


@pytest.mark.parametrize("stem", ["9" * 19, "9" * 200, str(2**63), "١٢"])
def test_image_names_beyond_64_bits_are_left_out(kitti, stem):
    (kitti / "image_0" / "000003.png").rename(kitti / "image_0" / f"{stem}.png")
    assert [round(f.stamp, 1) for f in open_sequence(kitti)] == [0.0, 0.1, 0.2, 0.4, 0.5]


@pytest.mark.parametrize("stem", ["9" * 19, "9" * 200, str(2**63), "١٢"])
def test_stamps_in_names_beyond_64_bits_are_left_out(euroc, stem):
    for cam in ("cam0", "cam1"):
        (euroc / "mav0" / cam / "data.csv").unlink()
        first = min((euroc / "mav0" / cam / "data").iterdir())
        first.rename(first.with_name(f"{stem}.png"))
    assert len(list(open_sequence(euroc))) == 5


@pytest.mark.parametrize("stem", ["9" * 19, "9" * 16, "9999999999.5"])
def test_stamps_in_names_of_two_folders(two_folders, stem):
    for side in ("left", "right"):
        for k, image in enumerate(sorted((two_folders / side).iterdir())):
            image.rename(image.with_name(f"{stem}.png" if k == 5 else f"{10**18 + k}.png"))
    stamps = [f.stamp for f in open_sequence(two_folders)]
    assert stamps and (np.diff(stamps) > 0).all()


@pytest.mark.parametrize("format", ["kitti", "raw"])
def test_a_huge_frame_number_without_times_asks_for_no_memory(format, request):
    folder = request.getfixturevalue(format)
    for camera in ("image_0", "image_1") if format == "kitti" else ("image_00/data", "image_01/data"):
        last = max((folder / camera).iterdir())
        last.rename(last.with_name("000009999999999.png"))
    for times in folder.rglob("times*.txt"):
        times.unlink()
    stamps = [f.stamp for f in open_sequence(folder)]
    assert len(stamps) == 6 and stamps[-1] == 999999999.9


def test_stamps_that_are_the_same_in_floating_point(euroc, build):
    for cam in ("cam0", "cam1"):
        rows = "".join(f"{build.T0 + k},{build.T0 + k * build.STEP}.png\n" for k in range(6))
        (euroc / "mav0" / cam / "data.csv").write_text(rows)
    sequence = open_sequence(euroc)
    assert len(list(sequence)) == 1 and any("microsecond" in line for line in sequence.warnings)


@pytest.mark.parametrize("number", ["9" * 400, "9" * 5000, "1e400", "1e300"])
def test_numbers_of_many_digits_in_calibrations(euroc, two_folders, kitti, number):
    sensor = euroc / "mav0" / "cam0" / "sensor.yaml"
    sensor.write_text(sensor.read_text().replace("intrinsics: [50.0", f"intrinsics: [{number}"))
    refused(euroc, CalibrationError, "sensor.yaml")
    calib = kitti / "calib.txt"
    calib.write_text(calib.read_text().replace("5.000000e+01", number))
    refused(kitti, CalibrationError, "calib.txt")
    storage = two_folders / "calibration.yaml"
    storage.write_text(storage.read_text() + f"image_width: {number}\nimage_height: 48\n")
    refused(two_folders, CalibrationError, "calibration.yaml")


# --- paths ---


@pytest.mark.parametrize(
    "path",
    ["~nobody_of_this_name", "a\0b", "x" * 300, "/".join(["y" * 200] * 30), "/proc", "/proc/self",
     "new\nline", "?" * 300],
)  # fmt: skip
def test_paths_that_are_none(path):
    refused(path, SequenceError)


@pytest.mark.parametrize(
    "query",
    ["left=a%00b&right=c", "left=" + "x" * 300, "calibration=~nobody_of_this_name", "fps=1e308", "fps=1e-308",
     "&".join(f"a{i}=1" for i in range(1000)), "times=/dev/zero", "calibration=/dev/zero", "left=/proc&right=/proc"],
)  # fmt: skip
def test_options_that_are_none(two_folders, query):
    refused(f"{two_folders}?{query}", (SequenceError, CalibrationError, ConfigurationError))


@pytest.mark.parametrize("name", ["calib.txt", "times.txt", "image_0/000002.png", "../../poses/03.txt"])
@pytest.mark.parametrize("what", ["pipe", "/dev/zero", "folder", "loop"])
def test_what_is_no_regular_file_is_never_waited_for(kitti, name, what):
    path = kitti / name
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    else:
        path.symlink_to(path if what == "loop" else what)
    started = time.monotonic()
    try:
        sequence = open_sequence(kitti)
        frames = len(list(sequence))
    except SlamError as error:
        assert str(path.name) in str(error)
    else:
        assert frames == (5 if name.endswith(".png") else 6)
        assert name == "../../poses/03.txt" or sequence.warnings
    assert time.monotonic() - started < 20


@pytest.mark.parametrize("what", ["pipe", "/dev/zero", "/proc/self/status"])
def test_a_pipe_in_place_of_a_video(two_folders, what):
    for side in ("left", "right"):
        if what == "pipe":
            os.mkfifo(two_folders / f"{side}.avi")
        else:
            (two_folders / f"{side}.avi").symlink_to(what)
    refused(f"{two_folders}?left=left.avi&right=right.avi", SequenceError)


# --- YAML and XML ---

LAUGHS = "a: &a [1,1,1,1,1,1,1,1]\n" + "".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}' if k else '*a'] * 8)}]\n" for k in range(12)
)
MERGES = "a: &a {x: 1}\n" + "".join(
    f"b{k}: &b{k} {{<<: [{','.join([f'*b{k - 1}' if k else '*a'] * 9)}]}}\n" for k in range(9)
)


@pytest.mark.parametrize(
    "text",
    [LAUGHS, MERGES, "x: &x [*x]", "x: " + "[" * 10_000, "x: !!bool maybe",
     "x: !!int ''", "x: !!timestamp x", "x: !!float z", "? {a: 1}\n: 2", "x: " + "9" * 5000,
     "x: " + ":".join(["59"] * 3000), "- 1"],
)  # fmt: skip
def test_hostile_yaml(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    started = time.process_time()
    with pytest.raises(CalibrationError, match=r"a\.yaml") as caught:
        read_yaml(tmp_path / "a.yaml")
    assert "\n" not in str(caught.value)
    assert time.process_time() - started < 2.0


@pytest.mark.parametrize("first", ["%YAML:1.0\n---", "%YAML 1.1\n---", "---\n# a comment"])
def test_a_fault_in_yaml_is_in_the_row_that_an_editor_shows(tmp_path, first):
    (tmp_path / "a.yaml").write_text(f"{first}\nx: 1\ny: }}\nz: 3\n")
    with pytest.raises(CalibrationError, match=r"a\.yaml, row 4: no valid YAML"):
        read_yaml(tmp_path / "a.yaml")


def test_nothing_in_yaml_is_executed(tmp_path):
    (tmp_path / "a.yaml").write_text(f"x: !!python/object/apply:os.mkdir [{tmp_path / 'made'}]\n")
    assert read_yaml(tmp_path / "a.yaml") == {"x": None}
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "text", ['<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "<a>" * 10_000, '<?xml version="1.0" encoding="x"?><a/>']
)
def test_hostile_xml(two_folders, text):
    (two_folders / "calibration.yaml").unlink()
    (two_folders / "calibration.xml").write_text(text)
    refused(two_folders, CalibrationError, "calibration.xml")


# --- images ---


def png(width, height, pixels=b"", extra=b""):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    parts = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), extra, chunk(b"IDAT", pixels)
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(30_000, 30_000), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_a_huge_image_is_refused_by_its_header(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(*size))
    with pytest.raises(SequenceError, match=f"{size[0]}x{size[1]}: at most {MOST_PIXELS} pixels"):
        read_image(tmp_path / "a.png")


def test_an_image_of_another_size_is_not_decoded(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(png(8000, 8000))
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(SequenceError, match="8000x8000, not 64x48"):
        read_image(tmp_path / "a.png", (64, 48))


def test_a_damaged_image_prints_nothing(tmp_path, capfd):
    chunk = struct.pack(">I", 20) + b"iCCP" + bytes(20)
    extra = chunk + struct.pack(">I", zlib.crc32(chunk[4:]))
    (tmp_path / "a.png").write_bytes(png(64, 48, zlib.compress(bytes(65 * 48)), extra))
    assert read_image(tmp_path / "a.png").shape == (48, 64)
    assert capfd.readouterr().err == ""


def test_damaged_videos_are_one_line(two_folders):
    for side in ("left", "right"):
        path = two_folders / f"{side}.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20, (64, 48))
        for k in range(5):
            writer.write(np.random.default_rng(k).integers(0, 256, (48, 64, 3), dtype=np.uint8))
        writer.release()
    data = (two_folders / "left.avi").read_bytes()
    rng = np.random.default_rng(0)
    for at in (*range(0, 300, 7), *rng.integers(len(data), size=30).tolist()):
        (two_folders / "left.avi").write_bytes(data[:at] + b"\xff" * 4 + data[at + 4 :])
        try:
            list(open_sequence(f"{two_folders}?left=left.avi&right=right.avi"))
        except SlamError as error:
            assert "\n" not in str(error)


def test_a_video_whose_name_is_no_utf8(two_folders):
    """OpenCV ends the process where it is given such a name."""
    for side in ("left", "right"):
        (two_folders / f"{side}\udc80.avi").write_bytes(b"RIFF")
    with pytest.raises(SlamError, match="the name is not in UTF-8"):
        open_sequence(f"{two_folders}?left=left\udc80.avi&right=right\udc80.avi")


# --- ground truth ---


def kitti_row(R, t):
    return " ".join(str(x) for x in np.column_stack([R, t]).ravel()) + "\n"


@pytest.mark.parametrize(
    ("R", "t", "words"),
    [
        (np.zeros((3, 3)), np.zeros(3), "rotation of pose 0 is none"),
        (np.diag([1.0, 1, -1]), np.ones(3), "rotation of pose 0 is none"),
        (np.diag([1.0, 1, 1e308]), np.ones(3), "rotation of pose 0 is none"),
        (np.eye(3), np.array([1e308, 0, 0]), "beyond the Earth"),
        (np.eye(3), np.zeros(3), "every position is zero"),
    ],
)  # fmt: skip
def test_ground_truth_that_cannot_be_true_is_refused(kitti, R, t, words):
    (kitti.parent.parent / "poses" / "03.txt").write_text(kitti_row(R, t) * 6)
    sequence = open_sequence(kitti)
    assert sequence.ground_truth is None
    assert any(words in line and "there is no ground truth" in line for line in sequence.warnings)


@pytest.mark.parametrize("row", ["1e308,0,0,1,0,0,0", "0,0,0,1,0,0,0", "0,1,0,1e308,0,0,0"])
def test_ground_truth_of_euroc_that_cannot_be_true(euroc, build, row):
    path = euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    path.write_text("".join(f"{build.T0 + k * build.STEP},{row}\n" for k in range(6)))
    sequence = open_sequence(euroc)
    assert any("there is no ground truth" in line for line in sequence.warnings) == (sequence.ground_truth is None)
    if not row.startswith("0,0,0"):  # at rest in the body's origin the camera is elsewhere: no zeros
        assert sequence.ground_truth is None


def test_a_reflected_rectification_gives_no_ground_truth(raw):
    day = raw.parent
    calibration = day / "calib_cam_to_cam.txt"
    calibration.write_text(calibration.read_text().replace("R_rect_00: 1 0 0", "R_rect_00: -1 0 0"))
    refused(raw, CalibrationError, "not a rotation")
