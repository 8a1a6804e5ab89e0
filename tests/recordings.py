"""Small sequences of every format, written into a folder."""

from pathlib import Path

import cv2
import numpy as np

from slam.geometry.rig import StereoRig

WIDTH, HEIGHT = 64, 48

#: Of the left camera.
K = np.array([[50.0, 0, 31.5], [0, 51.0, 23.5], [0, 0, 1]])

#: The calibration of a rectified rig.
FIVE = "fx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\nbaseline: 0.2\n"

SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{T}]
rate_hz: 20
resolution: [{width}, {height}]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.5, 23.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""

#: Body axes as on EuRoC's sensor: the camera's x is the body's y, its y is minus the body's x.
BODY_CAMERA = np.array([[0.0, -1.0, 0.0, 0.02], [1.0, 0.0, 0.0, -0.06], [0.0, 0.0, 1.0, 0.01], [0.0, 0.0, 0.0, 1.0]])


def picture(seed: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A picture that is told from others by its mean."""
    noise = np.random.default_rng(seed).integers(0, 4, (height, width))
    return (10 * (seed + 1) + noise).astype(np.uint8)


def seeds(sequence) -> list[tuple[int | None, int | None]]:
    """Which pictures the frames show: the seeds that `picture` drew left and right with."""

    def seed(image: np.ndarray | None) -> int | None:
        return None if image is None else round((float(image.mean()) - 1.5) / 10) - 1

    return [(seed(f.left), seed(f.right)) for f in sequence]


def rename(folder: Path, name) -> None:
    """Give the files of a folder other names, by their numbers in order."""
    for i, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / name(i))


def write_image(path: Path, seed: int, width: int = WIDTH, height: int = HEIGHT) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture(seed, width, height))


def write_pairs(left: Path, right: Path, name: str = "{:06d}.png") -> None:
    """Six pairs of images, in a folder for each camera."""
    for folder, first in ((left, 0), (right, 10)):
        for i in range(6):
            write_image(folder / name.format(i), first + i)


def cut(path: Path, share: float = 0.5) -> None:
    """Keep the first part of a file."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def write_sensor(path: Path, baseline: float = 0.11, axis: int = 0) -> None:
    """EuRoC's sensor.yaml of a camera `baseline` to the right of camera 0, or below it: along its `axis`."""
    T = BODY_CAMERA.copy()
    T[:3, 3] += T[:3, axis] * baseline
    path.parent.mkdir(parents=True, exist_ok=True)
    numbers = ", ".join(str(x) for x in T.ravel())
    path.write_text(SENSOR.format(T=numbers, width=WIDTH, height=HEIGHT))


def write_csv(camera: Path, stamps: list[int]) -> None:
    camera.mkdir(parents=True, exist_ok=True)
    lines = ["#timestamp [ns],filename", *(f"{s},{s}.png" for s in stamps)]
    (camera / "data.csv").write_text("\n".join(lines) + "\n")


T0 = 1_403_715_273_262_142_976
STEP = 50_000_000


def write_euroc(root: Path) -> Path:
    """Six frames in EuRoC's format, with ground truth."""
    stamps = [T0 + i * STEP for i in range(6)]
    for number, cam in enumerate(("cam0", "cam1")):
        folder = root / "mav0" / cam
        write_csv(folder, stamps)
        write_sensor(folder / "sensor.yaml", 0.11 * number)
        for i, s in enumerate(stamps):
            write_image(folder / "data" / f"{s}.png", i + 10 * number)
    truth = root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    rows = [f"{T0 + i * STEP // 4},{0.1 * i},0,1,1,0,0,0,0.5,0,0" for i in range(24)]
    truth.write_text("#timestamp,p,q\n" + "\n".join(rows) + "\n")
    return root


def projection_row(name: str, offset: float) -> str:
    P = [50.0, 0, 31.5, offset, 0, 50.0, 23.5, 0, 0, 0, 1, 0]
    return f"{name}: " + " ".join(f"{x:.6e}" for x in P)


def write_kitti(dataset: Path) -> Path:
    """Six frames of KITTI odometry in the publishers' layout, with poses; the path goes straight ahead."""
    folder = dataset / "sequences" / "03"
    write_pairs(folder / "image_0", folder / "image_1")
    rows = [projection_row("P0", 0), projection_row("P1", -25), projection_row("P2", 3), projection_row("P3", -22)]
    (folder / "calib.txt").write_text("\n".join([*rows, "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0"]) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(6)))
    poses = dataset / "poses" / "03.txt"
    poses.parent.mkdir()
    poses.write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {1.5 * i}\n" for i in range(6)))
    return folder


def write_raw(day: Path) -> Path:
    """Six frames of a KITTI raw drive; the calibration is in the day's folder."""
    drive = day / "2011_09_26_drive_0013_sync"
    write_pairs(drive / "image_00/data", drive / "image_01/data", "{:010d}.png")
    times = [f"2011-09-26 13:10:{51 + 0.1 * i:.9f}\n" for i in range(6)]
    for camera in ("image_00", "image_01"):
        (drive / camera / "timestamps.txt").write_text("".join(times))
    rows = ["calib_time: 09-Jan-2012 13:57:47", f"S_00: {WIDTH + 10} {HEIGHT + 10}"]
    for camera_name, offset in (("00", 0), ("01", -25)):
        rows += [f"S_rect_{camera_name}: {WIDTH} {HEIGHT}", projection_row(f"P_rect_{camera_name}", offset)]
    rows += ["R_rect_00: 1 0 0 0 1 0 0 0 1"]
    (day / "calib_cam_to_cam.txt").write_text("\n".join(rows) + "\n")
    return drive


def write_two_folders(folder: Path) -> Path:
    """Six frames in two folders, with a calibration as ``cv2.stereoCalibrate`` users write it."""
    for number, side in enumerate(("left", "right")):
        for i in range(6):
            write_image(folder / side / f"{side}_{i:03d}.png", i + 10 * number)
    write_storage(folder / "calibration.yaml", stereo_entries())
    return folder


def stereo_entries(baseline: float = 0.2) -> dict[str, np.ndarray | int]:
    D = np.array([[-0.2, 0.05, 0.001, -0.001, 0.0]])
    R = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    T = R @ np.array([[-baseline], [0.001], [0.002]])
    return {"K1": K, "D1": D, "K2": K * [[1.1], [1.1], [1]], "D2": D / 2, "R": R, "T": T}


def write_storage(path: Path, entries: dict[str, np.ndarray | int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()


def write_video(path: Path, images: list[np.ndarray], codec: str = "mp4v", rate: float = 30.0) -> None:
    """A video in colour of grey images."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate, images[0].shape[::-1])
    for pixels in images:
        writer.write(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR))
    writer.release()


def write_opencv(path: Path, rig: StereoRig, unit: float = 1.0) -> None:
    """Write a rig with the entries of ``cv2.stereoCalibrate``, lengths in `unit` to the metre."""
    T = unit * (rig.R @ rig.b).reshape(3, 1)
    entries = {"image_width": rig.width, "image_height": rig.height, "R": rig.R, "T": T}
    for number, camera in enumerate((rig.left, rig.right), 1):
        entries |= {f"K{number}": camera.K, f"D{number}": np.array([camera.distortion or (0.0,) * 4])}
    write_storage(path, entries)


def write_oxts(drive: Path, records: list[str]) -> None:
    """Records of the GPS/IMU unit of a KITTI raw drive by their first six numbers, and how it stands to camera 0."""
    (drive / "oxts" / "data").mkdir(parents=True)
    for i, record in enumerate(records):
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(record + " 0" * 24 + "\n")
    (drive / "oxts" / "timestamps.txt").write_text((drive / "image_00" / "timestamps.txt").read_text())
    # camera z is the IMU's x (ahead), camera x minus its y, camera y minus its z
    turn = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.5\n"
    (drive.parent / "calib_velo_to_cam.txt").write_text("calib_time: 15-Mar-2012\n" + turn)
    (drive.parent / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
