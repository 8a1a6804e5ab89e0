"""Two folders or two videos, with OpenCV's and Kalibr's calibrations."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.sequences import open_sequence
from slam.sequences.faults import said_before
from slam.sequences.rigs import read_rig

SIZE = (64, 48)


def opencv_rig(paths: list[Path], size: tuple[int, int], unit: float = 1, **flags: bool):
    options = {"unit": {1: "m", 0.001: "mm"}[unit], **{name: "yes" for name in flags}}
    rig = read_rig(paths, size, options)
    return rig, (rig.width, rig.height)


def test_the_rig_projects_as_opencv_does(two_folders: Path, build: SimpleNamespace) -> None:
    rig = open_sequence(two_folders).rig
    entries = build.stereo_entries()
    points = np.array([[0.1, -0.2, 2.0], [-0.5, 0.3, 3.0], [0.7, 0.1, 1.5]])
    left, right = rig.project(points)
    zero = np.zeros(3)
    expected_left = cv2.projectPoints(points, zero, zero, entries["K1"], entries["D1"])[0][:, 0]
    turn = cv2.Rodrigues(entries["R"])[0]
    expected_right = cv2.projectPoints(points, turn, entries["T"], entries["K2"], entries["D2"])[0][:, 0]
    assert np.allclose(left, expected_left, atol=1e-9)
    assert np.allclose(right, expected_right, atol=1e-9)


# ------------------------------------------------------------------------------------------------ names, stamps


def rename(folder: Path, names: list[str]) -> None:
    for path, name in zip(sorted(folder.iterdir()), names, strict=True):
        path.rename(folder / name)


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        ([f"{1_403_715_273_000_000_000 + i * 50_000_000}.png" for i in range(6)], 1_403_715_273 + 0.05 * np.arange(6)),
        ([f"{1_403_715_273_000_000 + i * 50_000}.png" for i in range(6)], 1_403_715_273 + 0.05 * np.arange(6)),
        ([f"{1_403_715_273_000 + i * 50}.png" for i in range(6)], 1_403_715_273 + 0.05 * np.arange(6)),
        ([f"{2_000_000_000 * (i + 1)}.png" for i in range(6)], 2.0 * np.arange(1, 7)),
        ([f"1403715273.{5 * i:02d}.png" for i in range(6)], 1_403_715_273 + 0.05 * np.arange(6)),
        ([f"frame{i:04d}.png" for i in (3, 4, 5, 7, 8, 9)], 0.1 * np.array([0, 1, 2, 4, 5, 6])),
        (["a.png", "b.png", "c.png", "d.png", "e.png", "f.png"], 0.1 * np.arange(6)),
        ([f"{i:06d}_x0.png" for i in range(6)], 0.1 * np.arange(6)),
    ],
    ids=[
        "nanoseconds",
        "microseconds",
        "milliseconds",
        "since-the-start",
        "seconds",
        "numbers",
        "letters",
        "last-number-is-none",
    ],
)
def test_names_give_stamps_or_numbers_or_order(two_folders: Path, names: list[str], stamps: np.ndarray) -> None:
    for side in ("left", "right"):
        rename(two_folders / side, names)
    sequence = open_sequence(two_folders)
    frames = list(sequence)
    assert np.allclose([f.stamp for f in frames], stamps, atol=1e-6, rtol=0)
    assert all(f.right is not None and f.right.mean() > f.left.mean() + 90 for f in frames)
    assumed = any("10 frames per second assumed" in w for w in sequence.warnings)
    assert assumed == (stamps[0] == 0)


def test_times_and_rate_can_be_told(two_folders: Path) -> None:
    assert np.allclose(open_sequence(f"{two_folders}?fps=20").stamps, 0.05 * np.arange(6))
    (two_folders / "t.txt").write_text("".join(f"{7 + 0.3 * i}\n" for i in range(6)))
    sequence = open_sequence(f"{two_folders}?times=t.txt")
    assert np.allclose(sequence.stamps, 7 + 0.3 * np.arange(6))
    assert sequence.warnings == []
    (two_folders / "t.txt").rename(two_folders / "times.txt")
    assert np.allclose(open_sequence(two_folders).stamps, 7 + 0.3 * np.arange(6))


@pytest.mark.parametrize(("size", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_times_since_1970_in_another_unit_are_named(two_folders: Path, size: float, unit: str) -> None:
    rows = [f"{(1.7e9 + 0.1 * k) * size:.0f}\n" for k in range(len(list((two_folders / "left").iterdir())))]
    (two_folders / "times.txt").write_text("".join(rows))
    with pytest.raises(SequenceError, match=f"is it in {unit}"):
        open_sequence(two_folders)


def test_an_assumed_rate_is_said_once_and_not_above_an_error(
    two_folders: Path, caplog: pytest.LogCaptureFixture
) -> None:
    said = [open_sequence(two_folders).warnings]
    assert [record.getMessage() for record in caplog.records] == said[0]
    with said_before():
        assert open_sequence(two_folders).warnings == said[0]
    assert len(caplog.records) == 1
    next(two_folders.glob("*.y*ml")).write_text("")
    with pytest.raises(CalibrationError):
        open_sequence(two_folders)
    assert len(caplog.records) == 1


def test_times_belong_to_the_left_images_in_order(two_folders: Path) -> None:
    (two_folders / "right" / "right_000.png").unlink()
    (two_folders / "times.txt").write_text("".join(f"{7 + i}\n" for i in range(6)))
    assert np.allclose(open_sequence(two_folders).stamps, [8, 9, 10, 11, 12])


def test_sides_can_be_told_also_as_patterns(two_folders: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for path in [*(two_folders / "left").iterdir(), *(two_folders / "right").iterdir()]:
        path.rename(other / path.name)
    (two_folders / "calibration.yaml").rename(other / "c.yml")
    sequence = open_sequence(f"{other}?left=left_*.png&right=right_*.png&calibration=c.yml&fps=5")
    assert len(list(sequence)) == 6
    assert sequence.warnings == []
    nested = open_sequence(f"{tmp_path}?left=other/left_*.png&right=other/right_*.png&calibration={other / 'c.yml'}")
    assert len(nested) == 6


@pytest.mark.parametrize(
    ("query", "error", "text"),
    [
        ("left=nowhere", SequenceError, "there is no such folder or video"),
        ("left=x*.png", SequenceError, "no images"),
        ("calibration=nowhere.yaml", CalibrationError, "the calibration is missing"),
        ("times=nowhere.txt", SequenceError, "nowhere.txt: No such file"),
        ("fps=0", ConfigurationError, "fps must be a number from 0.001"),
        ("fps=fast", ConfigurationError, "got 'fast'"),
        ("unit=feet", ConfigurationError, "unit must be one of m, cm, mm"),
        ("rectified=maybe", ConfigurationError, "rectified must be yes or no"),
        ("rectified=yes", CalibrationError, "P1, P2 are missing"),
    ],
)
def test_impossible_options(two_folders: Path, query: str, error: type[Exception], text: str) -> None:
    with pytest.raises(error) as caught:
        open_sequence(f"{two_folders}?{query}")
    assert text in str(caught.value)


def test_folders_that_cannot_be_paired_by_name_must_be_equally_full(two_folders: Path) -> None:
    for side in ("left", "right"):
        rename(two_folders / side, [f"{c}.png" for c in "abcdef"])
    (two_folders / "left" / "c.png").unlink()
    with pytest.raises(SequenceError, match=r"left has 5 images and .*right has 6"):
        open_sequence(two_folders)


# ------------------------------------------------------------------------------------------------ calibrations


def test_two_files_and_other_names_and_xml(tmp_path: Path, build: SimpleNamespace) -> None:
    """OpenCV's sample writes M1, D1, M2, D2 to intrinsics.yml and R, T to extrinsics.yml."""
    e = build.stereo_entries()
    build.write_storage(tmp_path / "all.xml", e)
    build.write_storage(tmp_path / "intrinsics.yml", {"M1": e["K1"], "D1": e["D1"], "M2": e["K2"], "D2": e["D2"]})
    build.write_storage(tmp_path / "extrinsics.yml", {"R": e["R"], "T": e["T"], "Q": np.eye(4)})
    words = {
        "camera_matrix_left": e["K1"],
        "dist_coeffs_left": e["D1"],
        "camera_matrix_right": e["K2"],
        "dist_coeffs_right": e["D2"],
        "R": cv2.Rodrigues(e["R"])[0],
        "T": e["T"] * 1000,
        "image_width": 64,
        "image_height": 48,
    }
    build.write_storage(tmp_path / "words.json", words)
    first, size = opencv_rig([tmp_path / "all.xml"], SIZE)
    assert size == SIZE
    second, _ = opencv_rig([tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"], SIZE)
    third, _ = opencv_rig([tmp_path / "words.json"], SIZE, unit=0.001)
    for rig in (second, third):
        assert rig.left == first.left
        assert rig.right == first.right
        assert np.allclose(rig.R, first.R, atol=1e-12)
        assert np.allclose(rig.b, first.b, atol=1e-12)


def test_rectified_images_take_the_projection_matrices(tmp_path: Path, build: SimpleNamespace) -> None:
    e = build.stereo_entries()
    K, T = np.array(e["K1"]), np.array(e["T"])
    R1, R2, P1, P2 = cv2.stereoRectify(K, e["D1"], e["K2"], e["D2"], SIZE, e["R"], T)[:4]
    build.write_storage(tmp_path / "a.yml", {**e, "R1": R1, "R2": R2, "P1": P1, "P2": P2})
    rig, _ = opencv_rig([tmp_path / "a.yml"], SIZE, rectified=True)
    assert rig.is_rectified
    assert rig.baseline == pytest.approx(np.linalg.norm(T), rel=1e-9)
    raw, _ = opencv_rig([tmp_path / "a.yml"], SIZE)
    assert not raw.is_rectified
    build.write_storage(tmp_path / "p.yml", {"P1": P1, "P2": P2})
    assert opencv_rig([tmp_path / "p.yml"], SIZE)[0].is_rectified


def test_fisheye_distortion(tmp_path: Path, build: SimpleNamespace) -> None:
    e = build.stereo_entries()
    e["D1"] = e["D2"] = np.array([[0.01, 0.002, -0.001, 0.0003]])
    build.write_storage(tmp_path / "a.yml", e)
    rig, _ = opencv_rig([tmp_path / "a.yml"], SIZE, fisheye=True)
    points = np.array([[[0.1, -0.2, 2.0], [0.5, 0.3, 1.0]]])
    expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), e["K1"], e["D1"])[0][0]
    assert np.allclose(rig.left.project(points[0]), expected, atol=1e-9)
    assert opencv_rig([tmp_path / "a.yml"], SIZE)[0].left.model == "radtan"


def test_distortions_of_every_length(tmp_path: Path, build: SimpleNamespace) -> None:
    for count, kept in ((0, 0), (4, 4), (5, 5), (8, 8), (12, 8), (14, 8)):
        e = build.stereo_entries()
        D = np.zeros((1, max(count, 1)))
        D[0, : min(count, 8)] = 0.01
        e["D1"] = e["D2"] = D
        if count == 0:
            del e["D1"], e["D2"]
        build.write_storage(tmp_path / "a.yml", e)
        assert len(opencv_rig([tmp_path / "a.yml"], SIZE)[0].left.distortion) == kept
    D[0, 9] = 0.1
    build.write_storage(tmp_path / "a.yml", {**e, "D1": D})
    with pytest.raises(CalibrationError, match="thin prisms"):
        opencv_rig([tmp_path / "a.yml"], SIZE)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"K2": None, "T": None}, "K2, T are missing"),
        ({"R": None}, "R is missing"),
        ({"R": 2 * np.eye(3)}, "R is not a rotation matrix"),
        ({"R": np.eye(2)}, "R is no matrix of shape"),
        ({"T": np.zeros((3, 1))}, "baseline is zero"),
        ({"T": np.array([[np.nan], [0], [0]])}, "T is not finite"),
        ({"K1": np.eye(4)}, "K1 is no matrix of shape"),
    ],
)
def test_faulty_entries(tmp_path: Path, build: SimpleNamespace, change: dict, text: str) -> None:
    entries = {k: v for k, v in {**build.stereo_entries(), **change}.items() if v is not None}
    build.write_storage(tmp_path / "a.yml", entries)
    with pytest.raises(CalibrationError) as error:
        opencv_rig([tmp_path / "a.yml"], SIZE)
    assert text in str(error.value)
    assert str(tmp_path / "a.yml") in str(error.value)


def test_a_baseline_in_millimetres(two_folders: Path, build: SimpleNamespace) -> None:
    build.write_storage(two_folders / "calibration.yaml", build.stereo_entries(200.0))
    assert open_sequence(f"{two_folders}?fps=10").rig.baseline == pytest.approx(200, rel=1e-4)
    assert open_sequence(f"{two_folders}?fps=10&unit=mm").rig.baseline == pytest.approx(0.2, rel=1e-4)


def test_a_rectified_pair_by_five_numbers(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text("fx: 500\nfy: 501\ncx: 31.5\ncy: 23.5\nbaseline: 120.0\n")
    rig, _ = opencv_rig([file], SIZE, unit=0.001)
    assert (rig.left.fu, rig.left.fv, rig.left.u0, rig.left.v0) == (500, 501, 31.5, 23.5)
    assert rig.left == rig.right
    assert np.allclose(rig.b, [-0.12, 0, 0])


def test_all_that_is_wrong_with_five_numbers_is_said_at_once(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text("fx: 500\ncx: wide\ncy: .inf\nbaseline: -0.12\n")
    with pytest.raises(CalibrationError) as error:
        opencv_rig([file], SIZE)
    for part in ("fy is missing", "cx is no number", "cy is not finite", "baseline is -0.12, which must be positive"):
        assert part in str(error.value)
    file.write_text("fx: 500\nfy: 500\ncx: true\ncy: 24\nbaseline: 0.12\n")
    with pytest.raises(CalibrationError, match="cx is no number"):
        opencv_rig([file], SIZE)


CAMCHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 2e-4, 1e-5]
  distortion_model: radtan
  intrinsics: [50.0, 51.0, 31.5, 23.5]
  resolution: [64, 48]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.9999, -0.0141418, 0.0, -0.11]
  - [0.0141418, 0.9999, 0.0, 0.001]
  - [0.0, 0.0, 1.0, 0.002]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 2e-4, 1e-5]
  distortion_model: radtan
  intrinsics: [50.0, 51.0, 31.5, 23.5]
  resolution: [64, 48]
"""


def test_kalibr(two_folders: Path) -> None:
    (two_folders / "calibration.yaml").unlink()
    chain = two_folders / "camchain.yaml"
    chain.write_text(CAMCHAIN)
    rig = open_sequence(two_folders).rig
    assert rig.left.distortion == (-0.28, 0.07, 2e-4, 1e-5)
    T = rig.T_right_left
    assert np.allclose(T[:3, 3], [-0.11, 0.001, 0.002], atol=1e-6)
    assert T[0, 1] == pytest.approx(-0.0141418, abs=1e-6)
    with pytest.raises(
        ConfigurationError, match=r"option 'unit' does nothing with .*camchain\.yaml, which is Kalibr's"
    ):
        open_sequence(f"{two_folders}?unit=mm")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("camera_model: pinhole", "camera_model: omni", "camera model 'omni' is not supported"),
        ("distortion_model: radtan", "distortion_model: fov", "distortion model 'fov' is not supported"),
        ("cam1:", "cam7:", "cam1/intrinsics, cam1/T_cn_cnm1 are missing (it looks like Kalibr's)"),
        ("T_cn_cnm1:", "T_cm_cnm1:", "T_cn_cnm1 is missing"),
        ("[0.0, 0.0, 1.0, 0.002]", "[0.0, 0.0, 2.0, 0.002]", "T_cn_cnm1 is not a rigid motion"),
        ("[0.0, 0.0, 1.0, 0.002]", "[0.0, 0.0, 1.0]", "cam1/T_cn_cnm1 is no matrix of shape (4, 4)"),
        ("intrinsics: [50.0, 51.0", "intrinsics: [50.0", "intrinsics has 3 numbers, 4 expected"),
        ("intrinsics: [50.0", "intrinsics: [.nan", "intrinsics is not finite"),
        ("intrinsics: [50.0", "intrinsics: [-50.0", "focal lengths must be positive"),
        ("2e-4, 1e-5]", "2e-4]", "takes 4 coefficients or more, got 3"),
        ("resolution: [64, 48]", "resolution: [64]", "resolution is no matrix of shape (2,)"),
        ("cam0:", "cam0: [", "no valid YAML"),
    ],
)
def test_faulty_kalibr_files(two_folders: Path, old: str, new: str, text: str) -> None:
    (two_folders / "calibration.yaml").unlink()
    chain = two_folders / "camchain.yaml"
    chain.write_text(CAMCHAIN.replace(old, new, 1))
    with pytest.raises(CalibrationError) as error:
        open_sequence(two_folders)
    assert text in str(error.value)
    assert str(chain) in str(error.value)
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------------------------ videos


def write_video(path: Path, first: int, count: int = 12, size: tuple[int, int] = SIZE) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 25, size)  # lossless
    assert writer.isOpened()
    for i in range(count):
        writer.write(np.full((*size[::-1], 3), first + 5 * i, np.uint8))
    writer.release()


@pytest.fixture
def videos(tmp_path: Path, build: SimpleNamespace) -> Path:
    folder = tmp_path / "films"
    build.write_storage(folder / "calib.yml", build.stereo_entries())
    write_video(folder / "left.avi", 10)
    write_video(folder / "right.avi", 100)
    return folder


def test_two_videos(videos: Path) -> None:
    sequence = open_sequence(videos)
    assert (sequence.format, len(sequence)) == ("folders", 12)
    frames = list(sequence)
    assert np.allclose([f.stamp for f in frames], np.arange(12) / 25)
    assert [round(f.left.mean()) for f in frames] == [10 + 5 * i for i in range(12)]
    assert [round(f.right.mean()) for f in frames] == [100 + 5 * i for i in range(12)]
    assert frames[0].left.shape == SIZE[::-1]
    part = list(sequence.frames(4, 7))
    assert [f.index for f in part] == [4, 5, 6]
    assert [round(f.left.mean()) for f in part] == [30, 35, 40]
    assert np.allclose(open_sequence(f"{videos}?fps=10").stamps, np.arange(12) / 10)
    named = open_sequence(f"{videos}?left=left.avi&right=right.avi&calibration=calib.yml")
    assert len(named) == 12
    assert sequence.warnings == []


def test_videos_of_unequal_length(videos: Path) -> None:
    write_video(videos / "right.avi", 100, 9)
    sequence = open_sequence(videos)
    assert len(list(sequence)) == 9
    assert "has 12 frames, " in sequence.warnings[0]


def test_a_video_that_ends_too_early(videos: Path, build: SimpleNamespace) -> None:
    writer = cv2.VideoWriter(str(videos / "left.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, SIZE)
    for i in range(12):  # noise, so that the frames are most of the file
        writer.write(np.random.default_rng(i).integers(0, 255, (*SIZE[::-1], 3)).astype(np.uint8))
    writer.release()
    build.cut(videos / "left.avi", 0.7)
    sequence = open_sequence(videos)
    frames = list(sequence)
    assert 0 < len(frames) < len(sequence)
    assert f"left.avi: ends or is damaged at frame {len(frames)} of 12" in sequence.warnings[-1]
    code = "import sys; from slam.sequences import open_sequence; print(len(list(open_sequence(sys.argv[1]))))"
    run = subprocess.run([sys.executable, "-c", code, str(videos)], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == str(len(frames))
    assert run.stderr.count("\n") == 1  # our line alone (logging's last resort), none of the decoder's


def test_faulty_videos(videos: Path, build: SimpleNamespace) -> None:
    write_video(videos / "right.avi", 100, size=(32, 48))
    with pytest.raises(SequenceError, match=r"differ in size: .*left\.avi is 64x48, .*right\.avi is 32x48"):
        open_sequence(videos)
    (videos / "right.avi").write_bytes(b"hello" * 100)
    with pytest.raises(SequenceError, match=r"right\.avi: not a readable video"):
        open_sequence(videos)
    (videos / "right.avi").unlink()
    with pytest.raises(SequenceError, match="two cameras are needed, but there is no right one"):
        open_sequence(videos)
    build.write_image(videos / "right" / "0.png", 0)
    with pytest.raises(SequenceError, match="one is a video and the other is not"):
        open_sequence(videos)
    write_video(videos / "other.avi", 1)
    with pytest.raises(ConfigurationError, match="option 'times' does nothing here"):
        open_sequence(f"{videos}?right=other.avi&times=t.txt")


def test_a_kalibr_camera_without_entries(two_folders: Path) -> None:
    (two_folders / "calibration.yaml").unlink()
    (two_folders / "camchain.yaml").write_text("cam0:\ncam1:\n")
    with pytest.raises(CalibrationError, match=r"camchain\.yaml: K1, K2, R, T are missing; in it: cam0, cam1"):
        open_sequence(two_folders)


@pytest.mark.parametrize("name", ["a.yml", "a.xml", "a.json"])
def test_damaged_opencv_files_are_errors_never_crashes(tmp_path: Path, build: SimpleNamespace, name: str) -> None:
    """OpenCV's own reader ends the process on some of these, so another one reads them."""
    build.write_storage(tmp_path / name, build.stereo_entries())
    data = (tmp_path / name).read_bytes()
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(60):
        broken = bytearray(data)
        for at in rng.integers(0, len(data), 4):
            broken[at] = rng.integers(0, 256)
        (tmp_path / name).write_bytes(broken[: rng.integers(1, len(data) + 1)] if rng.random() < 0.5 else broken)
        try:
            opencv_rig([tmp_path / name], SIZE)
        except CalibrationError as error:
            assert str(tmp_path / name) in str(error)
            assert "\n" not in str(error)
            refused += 1
    assert refused > 30
