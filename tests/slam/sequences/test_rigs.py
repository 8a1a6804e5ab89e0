"""Rigs by files of every form, by camera matrices, and what is refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, ConfigurationError, SequenceError

K = np.array([[50.0, 0, 31.5], [0, 51.0, 23.5], [0, 0, 1]])


def same(a: slam.StereoRig, b: slam.StereoRig) -> bool:
    return a.left == b.left and a.right == b.right and np.array_equal(a.R, b.R) and np.array_equal(a.b, b.b)


@pytest.mark.parametrize("fixture", ["euroc", "kitti", "raw", "two_folders"])
def test_a_folder_s_calibration_is_that_of_its_sequence(fixture: str, request, build: SimpleNamespace) -> None:
    folder: Path = request.getfixturevalue(fixture)
    where = folder.parent if fixture == "raw" else folder  # the day's folder has it
    size = None if fixture in ("euroc", "raw") else build.size
    assert same(slam.load_rig(where, size=size), slam.open_sequence(folder).rig)


def test_files_by_name(euroc: Path, two_folders: Path, build: SimpleNamespace) -> None:
    sensors = [euroc / "mav0" / cam / "sensor.yaml" for cam in ("cam0", "cam1")]
    assert same(slam.load_rig(*sensors), slam.open_sequence(euroc).rig)
    file = two_folders / "calibration.yaml"
    rig = slam.load_rig(file, size=build.size)
    assert rig.baseline == pytest.approx(0.2, rel=1e-3)
    assert slam.load_rig(str(file), size=build.size, unit="mm").baseline == pytest.approx(rig.baseline / 1000)


def test_kalibr_s_file_names_the_size(tmp_path: Path) -> None:
    camera = "  intrinsics: [50, 50, 31, 23]\n  resolution: [64, 48]\n  distortion_model: equidistant\n"
    camera += "  distortion_coeffs: [0, 0, 0, 0]\n"
    T = "  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    (tmp_path / "camchain.yaml").write_text(f"cam0:\n{camera}cam1:\n{camera}{T}")
    rig = slam.load_rig(tmp_path)
    assert (rig.width, rig.height, rig.left.model, rig.baseline) == (64, 48, "equidistant", pytest.approx(0.1))
    with pytest.raises(ConfigurationError, match=r"'fisheye' does nothing with .*, which is Kalibr's"):
        slam.load_rig(tmp_path, fisheye=True)


def test_what_is_no_calibration_is_one_line(tmp_path: Path, two_folders: Path, kitti: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nowhere\.yaml: the calibration is missing"):
        slam.load_rig(tmp_path / "nowhere.yaml")
    with pytest.raises(CalibrationError, match="no calibration under one of the usual names"):
        slam.load_rig(tmp_path / "mine" / "left")
    for file in (two_folders / "calibration.yaml", kitti / "calib.txt"):
        with pytest.raises(CalibrationError, match=rf"{file.name}: names no image size: give size=\(width, height\)"):
            slam.load_rig(file)
    with pytest.raises(SequenceError, match=r"images are 32x24, but .* is for 64x48"):
        load_euroc_as(tmp_path, (32, 24))
    with pytest.raises(ConfigurationError, match="unit must be one of m, cm, mm"):
        slam.load_rig(two_folders, size=(64, 48), unit="inch")
    with pytest.raises(CalibrationError, match="no calibration is named"):
        slam.load_rig()


def test_camera_matrices_as_opencv_calibrates_them(two_folders: Path, build: SimpleNamespace) -> None:
    e = build.stereo_entries()
    rig = slam.StereoRig.from_pinhole(
        e["K1"], e["K2"], D_left=e["D1"], D_right=e["D2"], R=e["R"], T=e["T"], size=build.size
    )
    expected = slam.open_sequence(two_folders).rig
    assert rig.left == expected.left
    assert rig.right == expected.right
    assert np.allclose(rig.R, expected.R)
    assert np.allclose(rig.b, expected.b)


def test_two_equal_cameras_side_by_side() -> None:
    rig = slam.StereoRig.from_pinhole(K.tolist(), baseline=0.12, size=(64, 48), D_left=[0.1, 0, 0, 0])
    assert rig.left == rig.right
    assert rig.left.model == "radtan"
    assert np.array_equal(rig.b, [-0.12, 0, 0])
    fisheye = slam.StereoRig.from_pinhole(K, baseline=0.12, size=(64, 48), D_left=[0.1, 0, 0, 0], fisheye=True)
    points = np.array([[0.3, -0.2, 1.0]])
    pixel = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), K, np.array([0.1, 0, 0, 0]))[0][0]
    assert np.allclose(fisheye.left.project(points), pixel)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"baseline": None}, "give either T or baseline"),
        ({"T": [-0.1, 0, 0]}, "give either T or baseline"),
        ({"baseline": -0.1}, "swapped"),
        ({"baseline": "wide"}, "must be numbers"),
        ({"R": np.eye(4)}, r"\(3, 3\) rotation"),
        ({"R": np.full((3, 3), np.nan)}, "finite"),
        ({"D_left": np.ones(14)}, "thin prisms"),
        ({"D_left": "none"}, "no numbers"),
        ({"K_right": np.eye(2)}, r"\(3, 3\)"),
        ({"size": (64, 0)}, "size must be positive"),
    ],
)
def test_impossible_rigs_are_refused(change: dict, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        slam.StereoRig.from_pinhole(**{"K_left": K, "baseline": 0.1, "size": (64, 48), **change})


def load_euroc_as(folder: Path, size: tuple[int, int]) -> None:
    camera = "T_BS: [1,0,0,{x}, 0,1,0,0, 0,0,1,0, 0,0,0,1]\nresolution: [64, 48]\nintrinsics: [50, 50, 31, 23]\n"
    files = [folder / name for name in ("a.yaml", "b.yaml")]
    for file, x in zip(files, (0.0, 0.1)):
        file.write_text(camera.format(x=x))
    slam.load_rig(*files, size=size)
