"""Faults of single frames, stamps, pairs and of the truth: reported in one line each, and the others go on."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from slam.sequences import open_sequence

# ------------------------------------------------------------------------------------------------ stamps


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
    assert "000002.png: the image is cut off or damaged" in caplog.text
    assert sequence.warnings == [caplog.records[0].getMessage()]
    assert capfd.readouterr().err == ""  # neither OpenCV nor libpng says it again


def test_damaged_vanished_and_other_images_cost_no_more_than_themselves(kitti: Path, build: SimpleNamespace) -> None:
    build.cut(kitti / "image_1" / "000000.png")
    build.write_image(kitti / "image_0" / "000002.png", 2, width=32)
    build.write_image(kitti / "image_1" / "000004.png", 2, width=32)
    sequence = open_sequence(kitti)
    (kitti / "image_0" / "000001.png").unlink()
    assert [(f.index, f.right is None) for f in sequence] == [(0, True), (3, False), (4, True), (5, False)]
    for words in (
        "frame 0 is given without its right image: ",
        "000001.png: No such file",
        "frame 2 skipped: ",
        "000002.png: image is 32x48, not 64x48",
    ):
        assert any(words in line for line in sequence.warnings)


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


# ------------------------------------------------------------------------------------------------ ground truth


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
    (kitti.parent.parent / "poses" / "03.txt").write_text(row * 6)
    sequence = open_sequence(kitti)
    assert sequence.ground_truth is None
    assert any(words in line and "there is no ground truth" in line for line in sequence.warnings)


@pytest.mark.parametrize("row", ["1e308,0,0,1,0,0,0", "0,1,0,1e308,0,0,0"])
def test_ground_truth_of_euroc_that_cannot_be_true(euroc, build, row):
    path = euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    path.write_text("".join(f"{build.T0 + k * build.STEP},{row}\n" for k in range(6)))
    sequence = open_sequence(euroc)
    assert sequence.ground_truth is None and any("there is no ground truth" in line for line in sequence.warnings)
