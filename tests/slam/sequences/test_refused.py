"""Sequences that are damaged, also on purpose: refused in one line, or single rows and pairs left out."""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from slam.errors import CalibrationError, SequenceError
from slam.sequences import open_sequence
from slam.sequences.base import FaultLog
from slam.sequences.options import RECORDED, Options
from slam.sequences.pairs import Listing, Pairs, pair_up
from tests import recordings

RIGHT = {"euroc": "mav0/cam1", "kitti": "image_1", "raw": "image_01", "two_folders": "right"}


def refused(path, error, words):
    """Opening and reading it ends in one line, within a second of processor time."""
    started = time.process_time()
    with pytest.raises(error, match=words) as caught:
        list(open_sequence(path))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700
    assert time.process_time() - started < 1.0
    return str(caught.value)


@pytest.mark.parametrize("fixture", RIGHT)
def test_a_right_camera_that_is_none(fixture, request):
    folder: Path = request.getfixturevalue(fixture)
    for path in (folder / RIGHT[fixture]).rglob("*.png"):
        recordings.write_image(path, 0, width=60)
    refused(folder, SequenceError, r"differ in size: .* is 64x48, .* is 60x48")
    shutil.rmtree(folder / RIGHT[fixture])
    assert str(folder) in refused(folder, SequenceError, "two cameras are needed")


def test_calibrations_of_other_cameras(euroc, kitti, raw, two_folders):
    recordings.write_sensor(euroc / "mav0" / "cam1" / "sensor.yaml", -0.11)
    (kitti / "calib.txt").write_text((kitti / "calib.txt").read_text().replace("-2.500000e+01", "2.500000e+01"))
    recordings.write_storage(two_folders / "calibration.yaml", recordings.stereo_entries(-0.2))
    for folder, name in ((euroc, "sensor.yaml"), (kitti, "calib.txt"), (two_folders, "calib")):
        assert name in refused(folder, CalibrationError, "are the cameras swapped")
    entries = {**recordings.stereo_entries(), "image_width": 640, "image_height": 480}
    recordings.write_storage(two_folders / "calibration.yaml", entries)
    refused(two_folders, SequenceError, r"images are 64x48, those of .*calibration\.yaml are 640x480")
    for path in raw.rglob("*.png"):
        recordings.write_image(path, 0, width=74, height=58)
    refused(raw, SequenceError, r"images are 74x58, those of .*cam_to_cam\.txt are 64x48")
    extract = raw.rename(raw.parent / raw.name.replace("sync", "extract"))
    refused(extract, SequenceError, r"an unrectified \(extract\) drive: take the rectified")


def test_recorded_features_are_no_sequence(tmp_path):
    (tmp_path / "tape.npz").touch()
    refused(tmp_path / "tape.npz", SequenceError, "recorded features are run by `slam replay`")


def test_a_folder_of_a_run_is_no_sequence(tmp_path):
    for name in ("config.json", "frames.csv"):
        (tmp_path / name).touch()
    assert "left=" not in refused(tmp_path, SequenceError, "it holds a run: `slam plot` draws several in one picture")


def test_images_that_never_pair(kitti, two_folders):
    for path in (kitti / "image_1").iterdir():
        recordings.cut(path)
    refused(kitti, SequenceError, r"no pair of images can be read: .*cut off or damaged")
    for side in ("left", "right"):
        recordings.rename(two_folders / side, lambda i: f"{'abcdef'[i]}.png")
    (two_folders / "left" / "c.png").unlink()
    refused(two_folders, SequenceError, r"left has 5 images and .*right has 6")


def test_rows_that_are_no_stamps_or_in_wrong_order_cost_their_frames(euroc, kitti):
    table = euroc / "mav0" / "cam0" / "data.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:3], "abc", *lines[4:]]))
    sequence = open_sequence(euroc)
    assert len(sequence) == 5
    assert "cam0/data.csv, row 4: 'abc' is not a time in whole nanoseconds; row left out" in sequence.warnings[0]
    table.write_text("\n".join([*lines[:4], lines[3], lines[1], *lines[4:]]))
    sequence = open_sequence(euroc)
    assert len(sequence) == 6 and "2 of 8 stamps stand twice or run backwards" in sequence.warnings[0]
    for text, stamps, words in (
        ("0\n0.1\nabc\n0.3\n0.4\n0.5\n", [0, 0.1, 0.3, 0.4, 0.5], "row 3: 'abc' is not a time in seconds; row left"),
        ("0\n0.1\n99\n0.1\n0.3\n0.4\n", [0, 0.1, 0.3, 0.4], "2 times stand twice or run backwards"),  # one leap ahead
    ):
        (kitti / "times.txt").write_text(text)
        sequence = open_sequence(kitti)
        assert np.allclose(sequence.stamps, stamps) and words in sequence.warnings[0]


def test_listed_images_that_are_missing_and_stamps_that_differ_a_little(euroc: Path) -> None:
    stamps = [recordings.T0 + i * recordings.STEP for i in range(6)]
    rows = [f"{s + (-1) ** i * 4_000_000},{s}.png\n" for i, s in enumerate(stamps)]
    (euroc / "mav0" / "cam1" / "data.csv").write_text("".join(rows))
    assert [f.right is not None for f in open_sequence(euroc)] == [True] * 6
    for cam, i in (("cam0", 1), ("cam1", 3)):
        (euroc / "mav0" / cam / "data" / f"{stamps[i]}.png").unlink()
    sequence = open_sequence(euroc)
    assert [f.right is not None for f in sequence] == [True, True, False, True, True]
    text = "\n".join(sequence.warnings)
    for cam, i in (("cam0", 1), ("cam1", 3)):
        assert f"{cam}/data.csv: 1 of 6 listed images are missing (first: {stamps[i]}.png)" in text
    assert f"1 image without a partner in {euroc / 'mav0' / 'cam1' / 'data'} (first: {stamps[3]}.png)" in text


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
def test_ground_truth_that_cannot_be_true_is_left_out(kitti, R, t, words):
    row = " ".join(str(x) for x in np.column_stack([R, t]).ravel()) + "\n"
    path = kitti.parent.parent / "poses" / "03.txt"
    path.write_text(row * 6)
    sequence = open_sequence(kitti)
    assert sequence.ground_truth is None
    assert any(words in line and "there is no ground truth" in line for line in sequence.warnings)
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 1\n" * 4)
    sequence = open_sequence(kitti)
    assert len(sequence.ground_truth) == 4 and "4 poses, 2 frames are beyond them" in sequence.warnings[0]


def test_a_listing_without_rows_or_out_of_order_is_an_error(tmp_path: Path) -> None:
    """None at all was an error of an array's size; rows out of order cost frames, as if they had no partner."""
    names = [f"{stamp}.png" for stamp in (1, 2, 3)]

    def paired(*stamps: int) -> Pairs:
        right = Listing(tmp_path / "b", np.array(stamps, np.int64), names[: len(stamps)], True)
        sides = [Listing(tmp_path / "a", np.arange(3), names, True), right]
        return pair_up(sides, Options("", "pairs", RECORDED), FaultLog([]))

    assert len(paired(0, 1, 2).stamps) == 3
    for stamps, said in (
        ((), "b: no images"),
        ((0, 2, 1), r"b: the images are not in order of their stamps: 3\.png follows 2\.png"),
        ((0, 1, 1), r"stamps: 3\.png follows 2\.png"),
    ):
        with pytest.raises(SequenceError, match=said):
            paired(*stamps)
