"""Calibrations of every form, and rigs by camera matrices: what they say, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, ConfigurationError, SlamError
from slam.sequences import open_sequence
from slam.sequences.rigs import read_rig, write_opencv

SIZE = (64, 48)
K = np.array([[50.0, 0, 31.5], [0, 51.0, 23.5], [0, 0, 1]])


def same(a: slam.StereoRig, b: slam.StereoRig) -> bool:
    return a.left == b.left and a.right == b.right and np.allclose(a.R, b.R, atol=1e-12) and np.allclose(a.b, b.b)


@pytest.mark.parametrize("fixture", ["euroc", "kitti", "raw", "two_folders"])
def test_a_folder_s_calibration_is_that_of_its_sequence(fixture: str, request) -> None:
    folder: Path = request.getfixturevalue(fixture)
    where = folder.parent if fixture == "raw" else folder  # the day's folder has it
    size = None if fixture in ("euroc", "raw") else SIZE
    assert same(slam.load_rig(where, size=size), open_sequence(folder).rig)


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


def test_opencv_s_entries_by_all_their_names(tmp_path: Path, build: SimpleNamespace) -> None:
    """OpenCV's sample writes M1, D1, M2, D2 to intrinsics.yml and R, T to extrinsics.yml."""
    e = build.stereo_entries()
    build.write_storage(tmp_path / "all.xml", e)
    build.write_storage(tmp_path / "intrinsics.yml", {"M1": e["K1"], "D1": e["D1"], "M2": e["K2"], "D2": e["D2"]})
    build.write_storage(tmp_path / "extrinsics.yml", {"R": e["R"], "T": e["T"], "Q": np.eye(4)})
    words = {f"camera_matrix_{side}": e[f"K{i}"] for i, side in ((1, "left"), (2, "right"))}
    words |= {f"dist_coeffs_{side}": e[f"D{i}"] for i, side in ((1, "left"), (2, "right"))}
    build.write_storage(tmp_path / "words.json", words | {"R": cv2.Rodrigues(e["R"])[0], "T": e["T"] * 1000})
    rig = slam.StereoRig.from_pinhole(e["K1"], e["K2"], D_left=e["D1"], D_right=e["D2"], R=e["R"], T=e["T"], size=SIZE)
    assert same(slam.load_rig(tmp_path / "all.xml", size=SIZE), rig)
    assert same(slam.load_rig(tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml", size=SIZE), rig)
    assert same(slam.load_rig(tmp_path / "words.json", size=SIZE, unit="mm"), rig)


def test_rectified_images_take_the_projection_matrices(tmp_path: Path, build: SimpleNamespace) -> None:
    e = build.stereo_entries()
    R1, R2, P1, P2 = cv2.stereoRectify(e["K1"], e["D1"], e["K2"], e["D2"], SIZE, e["R"], e["T"])[:4]
    build.write_storage(tmp_path / "a.yml", {**e, "R1": R1, "R2": R2, "P1": P1, "P2": P2})
    build.write_storage(tmp_path / "p.yml", {"P1": P1, "P2": P2})
    rig = slam.load_rig(tmp_path / "a.yml", size=SIZE, rectified=True)
    assert rig.is_rectified and rig.baseline == pytest.approx(np.linalg.norm(e["T"]), rel=1e-9)
    assert same(slam.load_rig(tmp_path / "p.yml", size=SIZE), rig)
    assert not slam.load_rig(tmp_path / "a.yml", size=SIZE).is_rectified


def test_distortions_of_every_kind_and_length(tmp_path: Path, build: SimpleNamespace) -> None:
    file, e = tmp_path / "a.yml", build.stereo_entries()
    e["D1"] = e["D2"] = np.array([[0.01, 0.002, -0.001, 0.0003]])
    build.write_storage(file, e)
    points = np.array([[[0.1, -0.2, 2.0], [0.5, 0.3, 1.0]]])
    expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), e["K1"], e["D1"])[0][0]
    assert np.allclose(slam.load_rig(file, size=SIZE, fisheye=True).left.project(points[0]), expected, atol=1e-9)
    for count, kept in ((4, 4), (5, 5), (8, 8), (14, 8)):
        D = np.zeros((1, count))
        D[0, : min(count, 8)] = 0.01
        build.write_storage(file, e | {"D1": D, "D2": D})
        assert len(slam.load_rig(file, size=SIZE).left.distortion) == kept
    D[0, 9] = 0.1
    build.write_storage(file, {**e, "D1": D})
    with pytest.raises(CalibrationError, match="thin prisms"):
        slam.load_rig(file, size=SIZE)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"K2": None, "T": None}, "K2, T are missing"),
        ({"R": None}, "R is missing"),
        ({"R": 2 * np.eye(3)}, "R is not a rotation matrix"),
        ({"R": np.eye(2)}, "R is no matrix of shape"),
        ({"T": np.zeros((3, 1))}, "baseline is zero"),
        ({"T": np.array([[np.nan], [0], [0]])}, "T is not finite"),
        ({"K1": np.array([[50.0, 3, 31.5], [0, 51, 23.5], [0, 0, 1]])}, "K1 is no camera matrix"),
        ({"K1": K.T}, "K1 is no camera matrix"),
        ({"K1": np.eye(3)}, "a focal length of 1 px for images 64 px wide: is it in pixels?"),
        ({"R": np.array([1.0, -2.0, 0.5])}, "the cameras look 126 degrees apart: is a rotation in degrees?"),
        ({"K1": np.eye(4)}, "K1 has 16 numbers; it has fx, fy, cx, cy, or 3 rows of 3"),
    ],
)
def test_faulty_entries(tmp_path: Path, build: SimpleNamespace, change: dict, text: str) -> None:
    entries = {k: v for k, v in {**build.stereo_entries(), **change}.items() if v is not None}
    build.write_storage(tmp_path / "a.yml", entries)
    with pytest.raises(CalibrationError) as error:
        slam.load_rig(tmp_path / "a.yml", size=SIZE)
    assert text in str(error.value)
    assert str(tmp_path / "a.yml") in str(error.value)


def test_arrays_of_numpy_are_no_calibration(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", K1=K)
    with pytest.raises(CalibrationError, match=r"a\.npz: no text: write K1, .* with cv2\.FileStorage"):
        slam.load_rig(tmp_path / "a.npz", size=SIZE)


def test_a_rectified_pair_by_five_numbers_and_what_is_wrong_with_them(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text("fx: 500\nfy: 501\ncx: 31.5\ncy: 23.5\nbaseline: 120.0\n")
    rig = slam.load_rig(file, size=SIZE, unit="mm")
    assert (rig.left.fu, rig.left.fv, rig.left.u0, rig.left.v0) == (500, 501, 31.5, 23.5)
    assert rig.left == rig.right and np.allclose(rig.b, [-0.12, 0, 0])
    file.write_text("fx: 0.8\nfy: 0.8\ncx: 0.5\ncy: 0.5\nbaseline: 0.2\n")
    with pytest.raises(CalibrationError, match=r"a focal length of 0\.8 px for images 64 px wide: is it in pixels"):
        slam.load_rig(file, size=SIZE)
    file.write_text("fx: 500\nfy: 500\ncx: 31\ncy: 23\nk1: -0.37\nk2: 0.2\nbaseline: 0.2\n")
    with pytest.raises(CalibrationError, match="names distortion, but only one camera"):
        slam.load_rig(file, size=SIZE)
    for text, words in (
        ("K: [50, 0, 31, 0, 50, 23, 0, 0, 1]\nD: [0.1, 0, 0, 0]\nbaseline: 0.2\n", "names distortion, but only one"),
        ("fx: 50\nfy: 50\ncx: 31\ncy: 23\nbaseline: 7.9\nunit: inch\n", "unit must be m or cm or mm, got 'inch'"),
        ("fx: true\ncx: wide\n", r"fx is no number \(a rectified pair needs fx, fy, cx, cy in pixels and baseline\)"),
        ("fx: 50\nfy: 50\ncx: .inf\n", "cx is not finite"),
        ("fx: 50\nfy: 50\ncx: 1\ncy: 1\n", "baseline is missing"),
        ("fx: 50\nfy: 50\ncx: 1\ncy: 1\nbaseline: -0.12\n", "fx, fy and baseline must be positive"),
    ):
        file.write_text(text)
        with pytest.raises(CalibrationError, match=words):
            slam.load_rig(file, size=SIZE)


FLAT, M, EYE = {"fx": 50.0, "fy": 51.0, "cx": 31.5, "cy": 23.5}, K.tolist(), np.eye(3).tolist()
SIDES = ("left", "right")


@pytest.mark.parametrize(
    "entries",
    [
        {**{side: {"K": M} for side in SIDES}, "extrinsics": {"R": EYE, "T": [-0.2, 0, 0]}},
        {"intrinsics": dict.fromkeys(SIDES, FLAT), "extrinsic": {"rotation": EYE, "translation": [-0.2, 0, 0]}},
        {"KK_left": M, "kc_left": [0] * 5, "KK_right": M, "om": [0, 0, 0], "T": [-0.2, 0, 0]},
        {"mtxL": M, "distL": [[0] * 5], "mtxR": M, "rot": EYE, "trans": [[-0.2], [0], [0]]},
        {key: {**FLAT, "coeffs": [0] * 5, "model": "distortion.none"} for key in SIDES} | {"baseline": 0.2},
        {"f": 50, "cu": 31.5, "cv": 23.5, "base": 0.2},
        {"K": M, "D": [0] * 5, "b": 20, "unit": "cm"},
        {"FX_px": 50, "FY_px": 51, "CX_px": 31.5, "CY_px": 23.5, "Baseline_m": 0.2},
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_the_same_rig_in_the_words_of_many_people(tmp_path: Path, entries: dict, encoding: str) -> None:
    (tmp_path / "calibration.json").write_text(json.dumps(entries, indent=1), encoding=encoding)
    rig = slam.load_rig(tmp_path, size=SIZE)
    assert (rig.left.fu, rig.left.u0, rig.left.v0) == (50, 31.5, 23.5)
    assert np.allclose(rig.b, [-0.2, 0, 0], atol=1e-9)


CAMERA = """cam{}:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 2e-4, 1e-5]
  distortion_model: radtan
  intrinsics: [50.0, 51.0, 31.5, 23.5]
  resolution: [64, 48]
"""
TURN = """  T_cn_cnm1:
  - [0.9999, -0.0141418, 0.0, -0.11]
  - [0.0141418, 0.9999, 0.0, 0.001]
  - [0.0, 0.0, 1.0, 0.002]
  - [0.0, 0.0, 0.0, 1.0]
"""
CAMCHAIN = CAMERA.format(0) + CAMERA.format(1) + TURN


def test_kalibr(two_folders: Path) -> None:
    (two_folders / "calibration.yaml").unlink()
    (two_folders / "camchain.yaml").write_text(CAMCHAIN)
    rig = open_sequence(two_folders).rig
    assert rig.left.distortion == (-0.28, 0.07, 2e-4, 1e-5)
    assert np.allclose(rig.T_right_left[0], [0.9999, -0.0141418, 0.0, -0.11], atol=1e-6)
    with pytest.raises(
        ConfigurationError, match=r"option 'unit' does nothing with .*camchain\.yaml, which is Kalibr's"
    ):
        open_sequence(f"{two_folders}?unit=mm")
    poses = [f"  T_imu_cam: [[1,0,0,{x}], [0,1,0,0], [0,0,1,0], [0,0,0,1]]\n" for x in (0.0, 0.3)]  # as OpenVINS has it
    (two_folders / "camchain.yaml").write_text("".join(CAMERA.format(i) + T for i, T in enumerate(poses)))
    assert np.allclose(open_sequence(two_folders).rig.b, [-0.3, 0, 0])


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("-0.11]", "0.11]", "are the cameras swapped? The first one of a calibration is the left one"),
        ("  T_cn_cnm1:", "  T_12:", "it looks like Kalibr's, but R, T are missing"),
        ("camera_model: pinhole", "camera_model: omni", "camera model 'omni' is not supported"),
        ("distortion_model: radtan", "distortion_model: fov", "distortion model 'fov' is not supported"),
        ("cam1:", "cam7:", "it looks like Kalibr's, but K2, R, T are missing"),
        ("[0.0, 0.0, 1.0, 0.002]", "[0.0, 0.0, 2.0, 0.002]", "T_cn_cnm1 is not a rigid motion"),
        ("intrinsics: [50.0, 51.0", "intrinsics: [50.0", "cam0/intrinsics has 3 numbers; it has fx, fy, cx, cy, or"),
        ("2e-4, 1e-5]", "2e-4]", "takes 4 coefficients or more, got 3"),
        ("resolution: [64, 48]", "resolution: [64]", "resolution is no matrix of shape (2,)"),
        ("cam0:", "cam0: [", "no valid YAML"),
        (CAMCHAIN, "cam0:\ncam1:\n", "K1, K2, R, T are missing; in it: cam0, cam1"),
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


def camera_yaml(tx: float) -> str:
    matrices = {
        "camera_matrix": "50, 0, 31, 0, 51, 23, 0, 0, 1",
        "distortion_coefficients": "0.1, 0, 0, 0, 0",
        "rectification_matrix": "1, 0, 0, 0, 1, 0, 0, 0, 1",
        "projection_matrix": f"40, 0, 32, {tx}, 0, 40, 24, 0, 0, 0, 1, 0",
    }
    head = "image_width: 64\nimage_height: 48\ncamera_name: stereo/left\ndistortion_model: plumb_bob\n"
    return head + "".join(f"{name}:\n  rows: 3\n  cols: 3\n  data: [{data}]\n" for name, data in matrices.items())


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


@pytest.mark.parametrize("names", ["DKRP", "dkrp"])
def test_camera_messages_as_ros_prints_them(tmp_path: Path, names: str) -> None:
    for side, tx in (("left", 0), ("right", -8)):
        P = [40, 0, 32, tx, 0, 40, 24, 0, 0, 0, 1, 0]
        values = [0.1, 0, 0, 0, 0], [50, 0, 31, 0, 51, 23, 0, 0, 1], np.eye(3).ravel().tolist(), P
        text = "header:\n  frame_id: cam\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\n"
        text += "".join(f"{name}: {value}\n" for name, value in zip(names, values))
        (tmp_path / f"{side}.yaml").write_text(f"{text}roi:\n  height: 0\n  width: 0\n---\n")
    rig = slam.load_rig(tmp_path)
    assert (rig.left.fu, rig.left.distortion[0], rig.baseline) == (50, 0.1, pytest.approx(0.2))


FOUR = (("fx", 45), ("fy", 45), ("cx", 31), ("cy", 23))
PLUMB = (("k1", 0.1), ("k2", 0), ("p1", 0), ("p2", 0))
HEAD = "%YAML:1.0\n---\nCamera.width: 64\nCamera.height: 48\n"
ORB = HEAD + "".join(f"Camera.{k}: {v}\n" for k, v in FOUR)
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
ORB3 = f"{HEAD}Camera.type: 'PinHole'\n" + "".join(f"Camera{i}.{k}: {v}\n" for i in (1, 2) for k, v in FOUR + PLUMB)
ORB3 += MATRIX.format("Stereo.T_c1_c2", 4, 4, "1, 0, 0, 0.2, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1")
STELLA = "Camera:\n  setup: stereo\n  model: perspective\n  cols: 64\n  rows: 48\n  focal_x_baseline: 9\n"
STELLA += "".join(f"  {k}: {v}\n" for k, v in FOUR)
STELLA_RAW = f"{STELLA}StereoRectifier:\n  model: perspective\n" + "".join(
    f"  {name}_{side}: [{numbers}]\n"
    for side in ("left", "right")
    for name, numbers in (("K", "45,0,31, 0,45,23, 0,0,1"), ("D", "0.1,0,0,0,0"), ("R", "1,0,0, 0,1,0, 0,0,1"))
)
ZED = "".join(
    f"[{side}_CAM_{name}]\nfx={f}\nfy={f}\ncx={f}\ncy={f // 2}\nk1=0.1\nk2=0\n"
    for side in ("LEFT", "RIGHT")
    for name, f in (("HD", 600), ("VGA", 300))
)
ZED += "[STEREO]\nBaseline=120\nTY=0.1\nTZ=0.2\nRX_HD=0.01\nCV_HD=0.02\nRZ_HD=0.0\n"
OAK = json.dumps(
    {
        "cameraData": [
            [
                socket,
                {
                    "cameraType": 0, "width": 64, "height": 48, "distortionCoeff": [0.1] + [0] * 13,
                    "intrinsicMatrix": [[45, 0, 31], [0, 45, 23], [0, 0, 1]],
                    "extrinsics": {
                        "rotationMatrix": EYE, "toCameraSocket": to, "translation": {"x": x, "y": 0, "z": 0},
                    },
                },
            ]
            for socket, to, x in ((1, 2, -20), (2, 0, 3))
        ],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
    }
)  # fmt: skip


VINS_CAMERA = """%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 64
image_height: 48
distortion_parameters:
   k1: 0.1
   k2: 0
   p1: 0
   p2: 0
projection_parameters:
   fx: 45
   fy: 45
   cx: 31
   cy: 23
"""
VINS = "%YAML:1.0\ncam0_calib: cam0.yaml\ncam1_calib: cam1.yaml\nimage_width: 64\nimage_height: 48\n" + "".join(
    MATRIX.format(f"body_T_cam{i}", 4, 4, f"1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1")
    for i, x in ((0, 0.1), (1, 0.3))
)


@pytest.mark.parametrize(
    ("name", "text", "size", "focal", "baseline", "rectified"),
    [
        ("orb.yaml", ORB + "Camera.bf: 9\n", None, 45, 0.2, True),
        ("orb_raw.yaml", ORB + "Camera.bf: 9\n" + LEFT_RIGHT, None, 45, 0.2, False),
        ("orb3.yaml", ORB3, None, 45, 0.2, False),
        ("stella.yaml", STELLA, None, 45, 0.2, True),
        ("stella_raw.yaml", STELLA_RAW, None, 45, 0.2, False),
        ("SN123.conf", ZED, (1280, 720), 600, 0.12, False),
        ("SN123.conf", ZED, (672, 376), 300, 0.12, False),
        ("oak.json", OAK, None, 45, 0.2, False),
        ("vins.yaml", VINS, None, 45, 0.2, False),
    ],
)
def test_calibrations_of_other_programs(
    tmp_path: Path, name: str, text: str, size: tuple[int, int] | None, focal: float, baseline: float, rectified: bool
) -> None:
    file = tmp_path / name
    for cam in ("cam0", "cam1"):  # of VINS-Fusion's
        (tmp_path / f"{cam}.yaml").write_text(VINS_CAMERA)
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
    file.write_text(VINS.replace("cam1.yaml", "elsewhere.yaml"))
    with pytest.raises(CalibrationError, match=r"looks like VINS-Fusion's, but K1, K2 are missing; .*, cam1_calib"):
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
    (tmp_path / "calibration.json").write_text('{"rig": {}, "parameters": [], "evidence": null}')
    with pytest.raises(CalibrationError, match=r"errors of a rig, .* not a rig: see --calibration"):
        slam.load_rig(tmp_path)


def test_a_written_calibration_is_of_the_images_as_recorded(tmp_path: Path) -> None:
    camera = slam.StereoRig.from_pinhole([[50.0, 0, 20], [0, 50, 30], [0, 0, 1]], baseline=0.2, size=(48, 64)).left
    camera = replace(camera, model="radtan", distortion=(0.1, 0.0, 0.01, 0.02))
    rig = slam.StereoRig.side_by_side(camera, camera, np.eye(3), np.array([0.0, -0.2, 0.0]))
    write_opencv(tmp_path / "c.yaml", rig)
    again = read_rig([tmp_path / "c.yaml"], (48, 64), {})
    assert again.turns == rig.turns == 1
    assert again.left == rig.left and np.allclose(again.b, rig.b)


def test_what_is_no_calibration_is_one_line(tmp_path: Path, two_folders: Path) -> None:
    camera = "T_BS: [1,0,0,{x}, 0,1,0,0, 0,0,1,0, 0,0,0,1]\nresolution: [64, 48]\nintrinsics: [50, 50, 31, 23]\n"
    for name, x in (("a", 0.0), ("b", 0.1)):
        (tmp_path / f"{name}.yaml").write_text(camera.format(x=x))
    for files, options, words in (
        (["nowhere.yaml"], {}, r"nowhere\.yaml: the calibration is missing"),
        ([two_folders / "left"], {}, "no calibration under one of the usual names"),
        ([two_folders / "calibration.yaml"], {}, r"names no image size: give size=\(width, height\)"),
        (["a.yaml", "b.yaml"], {"size": (32, 24)}, r"images are 32x24, but .* is for 64x48"),
        ([two_folders], {"unit": "inch"}, "unit must be m or cm or mm"),
        ([], {}, "no calibration is named"),
    ):
        with pytest.raises(SlamError, match=words):
            slam.load_rig(*(tmp_path / file for file in files), **options)


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
        ({"D_left": "none"}, "must be numbers"),
        ({"K_right": np.eye(2)}, r"\(3, 3\)"),
        ({"size": (64, 0)}, "size must be positive"),
    ],
)
def test_impossible_rigs_are_refused(change: dict, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        slam.StereoRig.from_pinhole(**{"K_left": K, "baseline": 0.1, "size": (64, 48), **change})
