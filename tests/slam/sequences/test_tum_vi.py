"""TUM-VI: equidistant cameras, images of 16 bits, Kalibr's calibration beside ``mav0``, truth in ``mocap0``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import slam
from slam.evaluation.metrics import absolute_errors
from slam.geometry.camera import PinholeCamera
from slam.geometry.se3 import pose

SIZE = 256
D = (0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367)  # of a lens of TUM-VI's
CAMERA = PinholeCamera(150.0, 150.0, 127.5, 127.5, SIZE, SIZE, "equidistant", D)
T_CAM0_IMU = pose(Rotation.from_euler("xyz", [0.1, -0.2, 1.5]).as_matrix(), np.array([0.04, -0.02, 0.01]))
STEP = 50_000_000
T0 = 1_520_530_308_199_447_626


def fisheye_view(camera: PinholeCamera) -> np.ndarray:
    """Where each pixel (SIZE, SIZE, 2) of the fisheye lies in a pinhole image; outside where that sees nothing."""
    v, u = np.mgrid[:SIZE, :SIZE]
    xy = CAMERA.normalise(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    uv = camera.project(np.concatenate([xy, np.ones((len(xy), 1))], axis=1))
    return np.nan_to_num(uv, nan=-1.0).astype(np.float32).reshape(SIZE, SIZE, 2)


def camchain(baseline: float) -> str:
    text = ""
    for cam, shift in (("cam0", 0.0), ("cam1", -baseline)):
        T = T_CAM0_IMU.copy()
        T[0, 3] += shift
        text += f"{cam}:\n  T_cam_imu:\n" + "".join(f"  - {row}\n" for row in T.tolist())
        text += f"  camera_model: pinhole\n  distortion_coeffs: {list(D)}\n  distortion_model: equidistant\n"
        text += f"  intrinsics: [150.0, 150.0, 127.5, 127.5]\n  resolution: [{SIZE}, {SIZE}]\n"
    return text


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """Six frames of a world as TUM-VI's cameras see them."""
    folder, world = tmp_path / "dataset-room1_512_16", slam.open_sequence("synthetic:desk?frames=6")
    view = fisheye_view(world.rig.left)
    poses = world.ground_truth.poses @ T_CAM0_IMU
    rows = ["#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"]
    for frame in world:
        stamp = T0 + frame.index * STEP
        for cam, image in (("cam0", frame.left), ("cam1", frame.right)):
            seen = cv2.remap(image, view[..., 0], view[..., 1], cv2.INTER_LINEAR)
            data = folder / "mav0" / cam / "data"
            data.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(data / f"{stamp}.png"), 257 * seen.astype(np.uint16))
        T = poses[frame.index]
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        rows.append(",".join(str(value) for value in (stamp, *T[:3, 3], w, x, y, z)))
    for cam in ("cam0", "cam1"):
        names = sorted(path.name for path in (folder / "mav0" / cam / "data").iterdir())
        table = ["#timestamp [ns],filename", *(f"{name[:-4]},{name}" for name in names)]
        (folder / "mav0" / cam / "data.csv").write_text("\n".join(table) + "\n")
    (folder / "mav0" / "mocap0").mkdir()
    (folder / "mav0" / "mocap0" / "data.csv").write_text("\n".join(rows) + "\n")
    (folder / "dso").mkdir()
    (folder / "dso" / "camchain.yaml").write_text(camchain(world.rig.baseline))
    return folder


def test_a_room_is_read_and_run(room: Path) -> None:
    sequence = slam.open_sequence(room)
    assert (sequence.format, len(sequence), sequence.name) == ("euroc", 6, room.name)
    assert sequence.rig.left == CAMERA
    assert np.allclose(sequence.rig.b, [-0.12, 0, 0])
    truth = sequence.ground_truth
    system = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind)
    results = []
    for frame in sequence:
        assert frame.left.dtype == frame.right.dtype == np.uint16
        results.append(system.process(frame))
    assert [result.status.value for result in results[1:]] == ["tracked"] * 5
    assert results[0].features.has_stereo.sum() > 20
    errors = absolute_errors(system.trajectory(), truth)
    assert errors.translation_statistics.rmse < 0.01  # 3 mm are measured, on a path of 9 cm
