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

SIZE = (64, 48)


# ------------------------------------------------------------------------------------------------ names, stamps


def test_times_and_rate_can_be_told(two_folders: Path) -> None:
    assert np.allclose(open_sequence(f"{two_folders}?fps=20").stamps, 0.05 * np.arange(6))
    (two_folders / "t.txt").write_text("".join(f"{7 + 0.3 * i}\n" for i in range(6)))
    sequence = open_sequence(f"{two_folders}?times=t.txt")
    assert np.allclose(sequence.stamps, 7 + 0.3 * np.arange(6))
    assert sequence.warnings == []
    (two_folders / "t.txt").rename(two_folders / "times.txt")
    assert np.allclose(open_sequence(two_folders).stamps, 7 + 0.3 * np.arange(6))


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


@pytest.mark.parametrize("query", ["fps=fast", "rectified=maybe", "tolerance=0.1", "layout=stacked"])
def test_a_wrong_option_is_said_before_anything_of_the_files(
    two_folders: Path, caplog: pytest.LogCaptureFixture, query: str
) -> None:
    (two_folders / "right" / "right_003.png").unlink()
    with pytest.raises(ConfigurationError):
        open_sequence(f"{two_folders}?{query}")
    assert caplog.records == []
    assert "have no partner" in open_sequence(two_folders).warnings[0]
    assert "have no partner" in caplog.text


def test_kitti_s_calib_txt_beside_the_images_is_read_and_another_one_named(two_folders: Path, kitti: Path) -> None:
    (two_folders / "calibration.yaml").unlink()
    (two_folders / "calib.txt").write_text((kitti / "calib.txt").read_text())
    sequence = open_sequence(two_folders)
    assert sequence.rig.baseline == pytest.approx(0.5)
    assert any("calib.txt: the images are taken as its cameras' 0 and 1" in line for line in sequence.warnings)
    (two_folders / "calib.txt").write_text("cam0=[50 0 31.5; 0 50 23.5; 0 0 1]\n")
    with pytest.raises(CalibrationError, match=r"the calibration is missing \(calib.txt is not of KITTI's form\)"):
        open_sequence(two_folders)


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
