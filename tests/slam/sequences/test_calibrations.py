"""Calibrations of every form, and rigs by camera matrices: what they say, and what is refused."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, ConfigurationError
from slam.geometry.camera import in_units
from slam.sequences import open_sequence
from tests import recordings

SIZE = (64, 48)
SIDES = ("left", "right")


def same(a: slam.StereoRig, b: slam.StereoRig) -> bool:
    return a.left == b.left and a.right == b.right and np.allclose(a.R, b.R, atol=1e-12) and np.allclose(a.b, b.b)


def matrix(name: str, rows: int, columns: int, data: str) -> str:
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [{data}]\n"


# ------------------------------------------------------------------------------------------------ every form

FLAT, M, EYE = {"fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], np.eye(3)
EYE = EYE.tolist()
FIVE = "fx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\n"

CAMERA = """cam{}:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.07, 2e-4, 1e-5]
  distortion_model: radtan
  intrinsics: [50.0, 51.0, 31.5, 23.5]
  resolution: [64, 48]
"""
TURN = "  T_cn_cnm1: [[1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
CAMCHAIN = CAMERA.format(0) + CAMERA.format(1) + TURN
OPENVINS = "".join(
    f"{CAMERA.format(i)}  T_imu_cam: [[1,0,0,{x}], [0,1,0,0], [0,0,1,0], [0,0,0,1]]\n" for i, x in ((0, 0.0), (1, 0.2))
)


def ros_yaml(tx: float) -> str:
    matrices = {
        "camera_matrix": "50, 0, 31, 0, 51, 23, 0, 0, 1",
        "distortion_coefficients": "0.1, 0, 0, 0, 0",
        "rectification_matrix": "1, 0, 0, 0, 1, 0, 0, 0, 1",
        "projection_matrix": f"40, 0, 32, {tx}, 0, 40, 24, 0, 0, 0, 1, 0",
    }
    head = "image_width: 64\nimage_height: 48\ncamera_name: stereo/left\ndistortion_model: plumb_bob\n"
    return head + "".join(f"{name}:\n  rows: 3\n  cols: 3\n  data: [{data}]\n" for name, data in matrices.items())


def ros_message(tx: float, names: str) -> str:
    """As ``rostopic`` and ``ros2 topic`` print it."""
    P = [40, 0, 32, tx, 0, 40, 24, 0, 0, 0, 1, 0]
    values = [0.1, 0, 0, 0, 0], [50, 0, 31, 0, 51, 23, 0, 0, 1], np.eye(3).ravel().tolist(), P
    text = "header:\n  frame_id: cam\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\n"
    text += "".join(f"{name}: {value}\n" for name, value in zip(names, values))
    return f"{text}roi:\n  height: 0\n  width: 0\n---\n"


FOUR = (("fx", 50), ("fy", 50), ("cx", 31), ("cy", 23))
HEAD = "%YAML:1.0\n---\nCamera.width: 64\nCamera.height: 48\n"
ORB = HEAD + "".join(f"Camera.{k}: {v}\n" for k, v in FOUR)
ORB_RAW = f"{ORB}Camera.bf: 9\n" + "".join(
    matrix(f"{side}.{name}", rows, columns, data)
    for side, tx in (("LEFT", 0), ("RIGHT", -8))
    for name, rows, columns, data in (
        ("D", 1, 5, "0.1, 0, 0, 0, 0"),
        ("K", 3, 3, "50, 0, 30, 0, 50, 22, 0, 0, 1"),
        ("R", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1"),
        ("P", 3, 4, f"40, 0, 32, {tx}, 0, 40, 24, 0, 0, 0, 1, 0"),
    )
)
PLUMB = (("k1", 0.1), ("k2", 0), ("p1", 0), ("p2", 0))
ORB3 = f"{HEAD}Camera.type: 'PinHole'\n" + "".join(f"Camera{i}.{k}: {v}\n" for i in (1, 2) for k, v in FOUR + PLUMB)
ORB3 += matrix("Stereo.T_c1_c2", 4, 4, "1, 0, 0, 0.2, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1")
STELLA = "Camera:\n  setup: stereo\n  model: perspective\n  cols: 64\n  rows: 48\n  focal_x_baseline: 10\n"
STELLA += "".join(f"  {k}: {v}\n" for k, v in FOUR)
STELLA_RAW = f"{STELLA}StereoRectifier:\n  model: perspective\n" + "".join(
    f"  {name}_{side}: [{numbers}]\n"
    for side in SIDES
    for name, numbers in (("K", "50,0,31, 0,50,23, 0,0,1"), ("D", "0.1,0,0,0,0"), ("R", "1,0,0, 0,1,0, 0,0,1"))
)
ZED = "".join(
    f"[{side}_CAM_{name}]\nfx={f}\nfy={f}\ncx={f}\ncy={f // 2}\nk1=0.1\nk2=0\n"
    for side in ("LEFT", "RIGHT")
    for name, f in (("HD", 600), ("VGA", 300))
)
ZED += "[STEREO]\nBaseline=200\nTY=0.1\nTZ=0.2\nRX_HD=0.01\nCV_HD=0.02\nRZ_HD=0.0\n"
OAK = json.dumps(
    {
        "cameraData": [
            [
                socket,
                {
                    "cameraType": 0, "width": 64, "height": 48, "distortionCoeff": [0.1] + [0] * 13,
                    "intrinsicMatrix": [[50, 0, 31], [0, 50, 23], [0, 0, 1]],
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
ROS = {"left.yaml": ros_yaml(0), "right.yaml": ros_yaml(-8)}

#: By a name: the files, options of `load_rig` besides the size, and the left camera's distortion; None if rectified.
#: All are of a focal length of 50 px and a baseline of 0.2 m, but where it is named.
FORMS = {
    "Kalibr": ({"camchain.yaml": CAMCHAIN}, {}, 0.1),
    "OpenVINS": ({"camchain.yaml": OPENVINS}, {}, 0.1),
    "ROS": (ROS, {}, 0.1),
    "ROS, rectified": (ROS, {"rectified": True, "focal": 40}, None),
    "ROS 1, printed": ({"left.yaml": ros_message(0, "DKRP"), "right.yaml": ros_message(-8, "DKRP")}, {}, 0.1),
    "ORB-SLAM": ({"orb.yaml": f"{ORB}Camera.bf: 10\n"}, {}, None),
    "ORB-SLAM, raw": ({"orb.yaml": ORB_RAW}, {}, 0.1),
    "ORB-SLAM 3": ({"orb.yaml": ORB3}, {}, 0.1),
    "stella": ({"stella.yaml": STELLA}, {}, None),
    "stella, raw": ({"stella.yaml": STELLA_RAW}, {}, 0.1),
    "ZED HD": ({"SN123.conf": ZED}, {"size": (1280, 720), "focal": 600}, 0.1),
    "ZED VGA": ({"SN123.conf": ZED}, {"size": (672, 376), "focal": 300}, 0.1),
    "depthai": ({"oak.json": OAK}, {}, 0.1),
    **{
        f"words {n}": ({"calibration.json": json.dumps(entries, indent=1)}, {"unit": unit}, None)
        for n, (unit, entries) in enumerate([
            ("m", {side: {"K": M} for side in SIDES} | {"extrinsics": {"R": EYE, "T": [-0.2, 0, 0]}}),
            ("mm", {"intrinsics": dict.fromkeys(SIDES, FLAT), "extrinsic": {"rotation": EYE, "trans": [-200, 0, 0]}}),
            ("m", {"KK_left": M, "kc_left": [0] * 5, "KK_right": M, "om": [0, 0, 0], "T": [-0.2, 0, 0]}),
            ("m", {key: {**FLAT, "coeffs": [0] * 5, "model": "distortion.none"} for key in SIDES} | {"baseline": 0.2}),
            ("mm", {"f": 50, "cu": 31.5, "cv": 23.5, "base": 200}),
            ("m", {"K": M, "D": [0] * 5, "b": 20, "unit": "cm"}),
            ("cm", {"FX_px": 50, "FY_px": 50, "CX_px": 31.5, "CY_px": 23.5, "Baseline_m": 20}),
        ])
    },
}  # fmt: skip
UNITS_OF_THEIR_OWN = [name for name in FORMS if not name.startswith("words")]


def load(tmp_path: Path, name: str, encoding: str = "utf-8", **options) -> slam.StereoRig:
    files, known, _ = FORMS[name]
    for file, text in files.items():
        (tmp_path / file).write_text(text, encoding=encoding)
    known = {"size": SIZE, **known, **options}
    known.pop("focal", None)
    return slam.load_rig(*(tmp_path / file for file in files), **known)


@pytest.mark.parametrize("name", FORMS)
def test_the_same_rig_in_the_words_of_many_programs_and_people(tmp_path: Path, name: str) -> None:
    _, options, distortion = FORMS[name]
    rig = load(tmp_path, name, encoding="utf-16" if name == "words 3" else "utf-8")
    assert rig.left.fu == options.get("focal", 50) and rig.is_rectified == (distortion is None)
    assert rig.baseline == pytest.approx(0.2, rel=1e-5)
    assert distortion is None or rig.left.distortion[0] == distortion
    if name in UNITS_OF_THEIR_OWN:
        with pytest.raises(ConfigurationError, match="'unit' does nothing with"):
            load(tmp_path, name, unit="cm")


@pytest.mark.parametrize(("length", "units"), [(120.0, "cm mm"), (12.0, "cm in"), (4.73, "cm in"), (0.1, "")])
def test_a_unit_that_is_proposed_gives_the_baseline_that_is_said(tmp_path: Path, caplog, length, units):
    entries = recordings.stereo_entries(length)
    recordings.write_storage(tmp_path / "calibration.yaml", entries)
    proposed = re.findall(r"unit=(\w+) makes it (\S+) m", in_units(slam.load_rig(tmp_path, size=SIZE).baseline))
    assert [unit for unit, _ in proposed] == units.split()
    assert ("m apart by their calibration: is it in metres?" in caplog.text) == (length > 10)
    for unit, metres in proposed:
        assert slam.load_rig(tmp_path, size=SIZE, unit=unit).baseline == pytest.approx(float(metres), rel=0.01)


@pytest.mark.parametrize("fixture", ["euroc", "kitti", "raw", "two_folders"])
def test_a_folder_s_calibration_is_that_of_its_sequence(fixture: str, request) -> None:
    folder: Path = request.getfixturevalue(fixture)
    where = folder.parent if fixture == "raw" else folder  # the day's folder has it
    size = None if fixture in ("euroc", "raw") else SIZE
    assert same(slam.load_rig(where, size=size), open_sequence(folder).rig)


def test_opencv_s_entries_by_all_their_names_project_as_opencv_does(tmp_path: Path) -> None:
    """OpenCV's sample writes M1, D1, M2, D2 to intrinsics.yml and R, T to extrinsics.yml."""
    e = recordings.stereo_entries()
    recordings.write_storage(tmp_path / "all.xml", e)
    recordings.write_storage(tmp_path / "intrinsics.yml", {"M1": e["K1"], "D1": e["D1"], "M2": e["K2"], "D2": e["D2"]})
    recordings.write_storage(tmp_path / "extrinsics.yml", {"R": e["R"], "T": e["T"], "Q": np.eye(4)})
    words = {f"camera_matrix_{side}": e[f"K{i}"] for i, side in ((1, "left"), (2, "right"))}
    words |= {f"dist_coeffs_{side}": e[f"D{i}"] for i, side in ((1, "left"), (2, "right"))}
    recordings.write_storage(tmp_path / "words.json", words | {"R": cv2.Rodrigues(e["R"])[0], "T": e["T"] * 1000})
    rig = slam.StereoRig.from_pinhole(e["K1"], e["K2"], D_left=e["D1"], D_right=e["D2"], R=e["R"], T=e["T"], size=SIZE)
    assert same(slam.load_rig(tmp_path / "all.xml", size=SIZE), rig)
    assert same(slam.load_rig(tmp_path, size=SIZE), rig)
    assert same(slam.load_rig(tmp_path / "words.json", size=SIZE, unit="mm"), rig)
    points, zero = np.array([[0.1, -0.2, 2.0], [-0.5, 0.3, 3.0], [0.7, 0.1, 1.5]]), np.zeros(3)
    left, right = rig.project(points)
    assert np.allclose(left, cv2.projectPoints(points, zero, zero, e["K1"], e["D1"])[0][:, 0], atol=1e-9)
    turn = cv2.Rodrigues(e["R"])[0]
    assert np.allclose(right, cv2.projectPoints(points, turn, e["T"], e["K2"], e["D2"])[0][:, 0], atol=1e-9)


def test_rectified_images_take_the_projection_matrices(tmp_path: Path) -> None:
    e = recordings.stereo_entries()
    R1, R2, P1, P2 = cv2.stereoRectify(e["K1"], e["D1"], e["K2"], e["D2"], SIZE, e["R"], e["T"])[:4]
    recordings.write_storage(tmp_path / "a.yml", {**e, "R1": R1, "R2": R2, "P1": P1, "P2": P2})
    recordings.write_storage(tmp_path / "p.yml", {"P1": P1, "P2": P2})
    rig = slam.load_rig(tmp_path / "a.yml", size=SIZE, rectified=True)
    assert rig.is_rectified and rig.baseline == pytest.approx(np.linalg.norm(e["T"]), rel=1e-9)
    assert same(slam.load_rig(tmp_path / "p.yml", size=SIZE), rig)
    assert not slam.load_rig(tmp_path / "a.yml", size=SIZE).is_rectified
    with pytest.raises(ConfigurationError, match=r"'fisheye' does nothing with .*p\.yml"):
        slam.load_rig(tmp_path / "p.yml", size=SIZE, fisheye=True)


def test_distortions_of_every_kind_and_length(tmp_path: Path) -> None:
    file, e = tmp_path / "a.yml", recordings.stereo_entries()
    e["D1"] = e["D2"] = np.array([[0.01, 0.002, -0.001, 0.0003]])
    recordings.write_storage(file, e)
    points = np.array([[[0.1, -0.2, 2.0], [0.5, 0.3, 1.0]]])
    expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), e["K1"], e["D1"])[0][0]
    assert np.allclose(slam.load_rig(file, size=SIZE, fisheye=True).left.project(points[0]), expected, atol=1e-9)
    for count, kept in ((4, 4), (5, 5), (8, 8), (14, 8)):
        D = np.zeros((1, count))
        D[0, : min(count, 8)] = 0.01
        recordings.write_storage(file, e | {"D1": D, "D2": D})
        assert len(slam.load_rig(file, size=SIZE).left.distortion) == kept
    D[0, 9] = 0.1
    recordings.write_storage(file, {**e, "D1": D})
    with pytest.raises(CalibrationError, match="thin prisms"):
        slam.load_rig(file, size=SIZE)


# ------------------------------------------------------------------------------------------------ refused

#: A file's text, or what is replaced in one of the forms, and what is said.
REFUSED = [
    (f"{FIVE}baseline: 0.2\nk1: 0.1\n", "names distortion, but only one camera"),
    ("fx: 0.8\nfy: 0.8\ncx: 0.5\ncy: 0.5\nbaseline: 0.2\n", "a focal length of 0.8 px for images 64 px wide: is it"),
    (f"{FIVE}baseline: 7.9\nunit: inch\n", "unit must be m or cm or mm or in, got 'inch'"),
    (f"{FIVE}baseline: -0.12\n", "fx, fy and baseline must be positive"),
    (json.dumps({"K1": M, "R": EYE}), "K2, T are missing"),
    *((json.dumps({"K1": M, "K2": M, "R": EYE, "T": [-0.2, 0, 0]} | change), text) for change, text in (
        ({"D1": [-0.3, 0.1, 0, 0]}, "D2 is missing"),
        ({"R": (2 * np.eye(3)).tolist()}, "R is not a rotation matrix"),
        ({"R": [1.0, -2.0, 0.5]}, "the cameras look 126 degrees apart: is a rotation in degrees?"),
        ({"K1": [[50, 3, 31.5], [0, 51, 23.5], [0, 0, 1]]}, "K1 is no camera matrix"),
        ({"K1": EYE}, "a focal length of 1 px for images 64 px wide: is it in pixels?"),
    )),
    (OAK.replace('"toCameraSocket": 2', '"toCameraSocket": 0'), "depthai's, but says nothing of how the pair stands"),
    (ZED, "it is a ZED's, for images of another size than 64x48; it has 1280x720, 672x376"),
    ('{"rig": {}, "parameters": [], "evidence": null}', "errors of a rig, as `slam calibrate` or a run found them"),
    *((CAMCHAIN.replace(old, new, 1), text) for old, new, text in (
        ("-0.2]", "0.2]", "are the cameras swapped (the first one of a calibration is the left one)"),
        ("  T_cn_cnm1:", "  T_12:", "it looks like Kalibr's, but R, T are missing"),
        ("camera_model: pinhole", "camera_model: omni", "camera model 'omni' is not supported"),
        ("distortion_model: radtan", "distortion_model: fov", "distortion model 'fov' is not supported"),
        ("[0, 0, 1, 0]", "[0, 0, 2, 0]", "T_cn_cnm1 is not a rigid motion"),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words"), REFUSED)
def test_what_a_file_lacks_is_one_line_with_its_name(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "a.conf"
    file.write_text(text)
    with pytest.raises(CalibrationError) as error:
        slam.load_rig(file, size=SIZE)
    assert words in str(error.value) and str(error.value).startswith(str(file)) and "\n" not in str(error.value)
