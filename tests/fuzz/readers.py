"""Folders of every format with hostile files in them."""

from __future__ import annotations

import os
import struct
import zlib
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np

import slam
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.hostile import NUMBERS, PATHS, XML_BOMBS, YAML_BOMBS, broken_bytes, broken_text, choose

WIDTH, HEIGHT, FRAMES = 64, 48, 4
T0, STEP = 1_403_715_273_262_142_976, 50_000_000

Files = dict[str, bytes]

_SENSOR = """%YAML:1.0
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.5, 23.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""

_STORAGE = """%YAML:1.0
---
K1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 50., 0., 31.5, 0., 50., 23.5, 0., 0., 1. ]
K2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 50., 0., 31.5, 0., 50., 23.5, 0., 0., 1. ]
R: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]
T: [ -0.2, 0., 0. ]
"""

_OXTS = "49.0 8.4 112.8 0.02 0.01 -1.2 1 1 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 4 9 4 4 0\n"


@cache
def image(seed: int, ending: str = ".png") -> bytes:
    """A small image file."""
    pixels = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    return cv2.imencode(ending, pixels)[1].tobytes()


def euroc() -> Files:
    """A folder in EuRoC's format, with ground truth."""
    files: Files = {}
    stamps = [T0 + k * STEP for k in range(FRAMES)]
    for number, cam in enumerate(("cam0", "cam1")):
        files[f"mav0/{cam}/sensor.yaml"] = _SENSOR.format(x=0.11 * number).encode()
        files[f"mav0/{cam}/data.csv"] = "".join(["#t,name\n", *(f"{s},{s}.png\n" for s in stamps)]).encode()
        files |= {f"mav0/{cam}/data/{s}.png": image(10 * number + k) for k, s in enumerate(stamps)}
    rows = "".join(f"{s},{0.1 * k},0,1,1,0,0,0\n" for k, s in enumerate(stamps))
    files["mav0/state_groundtruth_estimate0/data.csv"] = f"#t,p,q\n{rows}".encode()
    return files


def kitti() -> Files:
    """A sequence of KITTI odometry, with poses."""
    files = {f"image_{c}/{k:06d}.png": image(10 * c + k) for c in (0, 1) for k in range(FRAMES)}
    P = "P{}: 50 0 31.5 {} 0 50 23.5 0 0 0 1 0\n"
    files["calib.txt"] = (P.format(0, 0) + P.format(1, -25)).encode()
    files["times.txt"] = "".join(f"{0.1 * k:e}\n" for k in range(FRAMES)).encode()
    files["poses.txt"] = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {1.5 * k}\n" for k in range(FRAMES)).encode()
    return files


def raw() -> Files:
    """A drive of KITTI raw, with OXTS records and GPS."""
    files: Files = {}
    for c in ("00", "01"):
        files |= {f"image_{c}/data/{k:010d}.png": image(10 * int(c) + k) for k in range(FRAMES)}
        times = "".join(f"2011-09-26 13:10:{51 + 0.1 * k:.9f}\n" for k in range(FRAMES))
        files[f"image_{c}/timestamps.txt"] = times.encode()
    P = "S_rect_{0}: 64 48\nP_rect_{0}: 50 0 31.5 {1} 0 50 23.5 0 0 0 1 0\n"
    files["calib_cam_to_cam.txt"] = (
        P.format("00", 0) + P.format("01", -25) + "R_rect_00: 1 0 0 0 1 0 0 0 1\n"
    ).encode()
    for name in ("velo_to_cam", "imu_to_velo"):
        files[f"calib_{name}.txt"] = b"R: 1 0 0 0 1 0 0 0 1\nT: 0.1 0.2 0.3\n"
    files["oxts/timestamps.txt"] = files["image_00/timestamps.txt"]
    files |= {f"oxts/data/{k:010d}.txt": _OXTS.replace("8.4", f"8.400{k}").encode() for k in range(FRAMES)}
    files["ego_gps_m.txt"] = "".join(f"{k} {k} 0 0\n" for k in range(FRAMES)).encode()
    return files


def folders() -> Files:
    """Two folders of images with OpenCV's calibration."""
    files = {
        f"{side}/{k:03d}.png": image(10 * i + k) for i, side in enumerate(("left", "right")) for k in range(FRAMES)
    }
    files["calibration.yaml"] = _STORAGE.encode()
    files["times.txt"] = "".join(f"{0.1 * k}\n" for k in range(FRAMES)).encode()
    return files


@lru_cache(maxsize=1)
def _video() -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/v.avi"
        writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 20, (WIDTH, HEIGHT))
        for k in range(FRAMES):
            writer.write(np.random.default_rng(k).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        writer.release()
        return Path(path).read_bytes()


def videos() -> Files:
    """Two videos with OpenCV's calibration."""
    return {"left.avi": _video(), "right.avi": _video(), "calibration.yaml": _STORAGE.encode()}


FORMATS = (euroc, kitti, raw, folders, videos)


def read_folder(rng: np.random.Generator, folder: Path) -> None:
    """Write a mutated folder and read it to its end."""
    root = folder / "sequence"
    files = choose(rng, FORMATS)()
    for _ in range(int(rng.integers(1, 4))):
        mutate(rng, files)
    write(files, root)
    for _ in range(int(rng.integers(3)) // 2):
        special(rng, root)
    consume(str(root))


def read_path(rng: np.random.Generator, folder: Path) -> None:
    """Open what is no folder at all, or a folder with hostile options."""
    if rng.random() < 0.5:
        consume(choose(rng, PATHS), frames=2)
        return
    root = folder / "sequence"
    write(choose(rng, FORMATS)(), root)
    key = choose(rng, ("left", "right", "calibration", "times", "fps", "unit", "rectified", "fisheye", "kind", "x"))
    consume(f"{root}?{key}={choose(rng, (*PATHS, *NUMBERS))}")


def consume(path: str, frames: int = 100) -> None:
    """Open a sequence and read frames; what comes must be sound."""
    sequence = slam.open_sequence(path)
    if len(str(sequence.warnings)) > 100_000 or any("\n" in line for line in sequence.warnings):
        raise Broken("warnings are not lines of bounded length")
    last = -np.inf
    for count, frame in enumerate(sequence, 1):
        if not (np.isfinite(frame.stamp) and frame.stamp > last):
            raise Broken("time does not increase")
        last = frame.stamp
        for pixels in (frame.left, frame.right):
            if pixels is not None and pixels.shape[:2] != (sequence.rig.height, sequence.rig.width):
                raise Broken("an image is not of the rig's size")
        if count == frames:
            break
    truth = sequence.ground_truth
    if truth is not None and len(truth) > 1 and not path.startswith("synthetic:"):
        R = truth.poses[:, :3, :3]
        rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 0.1 and (np.linalg.det(R) > 0).all()
        if not (rigid and np.abs(truth.positions).max() < 1e9 and truth.poses[:, :3, 3].any()):
            raise Broken("ground truth that cannot be true is accepted")


def mutate(rng: np.random.Generator, files: Files) -> None:
    """Change one file."""
    name = choose(rng, sorted(files))
    kind = int(rng.integers(10))
    if kind == 0:
        del files[name]
        if not files:
            files["x"] = b""
    elif kind == 1:
        stem = choose(rng, (*NUMBERS, "0" * 200 + "7", "9999999999", "9" * 19, "x", "1e3", "١٢"))
        old = Path(name)
        files[f"{old.parent}/{stem[:200]}{old.suffix}".removeprefix("./")] = files.pop(name)
    elif kind == 2 and name.endswith((".csv", ".txt")):
        files[name] = hostile_truth(rng, files[name].decode("utf-8", "replace")).encode("utf-8", "replace")
    elif name.endswith((".png", ".avi")):
        files[name] = hostile_image(rng, files[name])
    elif name.endswith(".yaml") and kind < 6:
        bomb = choose(rng, (*YAML_BOMBS, *XML_BOMBS)).encode("utf-8", "replace")
        files[name] = choose(rng, (bomb, files[name] + bomb))
    else:
        files[name] = broken_text(rng, files[name].decode("utf-8", "replace")).encode("utf-8", "replace")


def hostile_truth(rng: np.random.Generator, text: str) -> str:
    """A table whose numbers are all zero, all turned around, or all huge."""
    kind = int(rng.integers(4))
    rows = []
    for line in text.splitlines():
        separator = "," if "," in line else " "
        words = line.split(separator)
        keep = 1 if separator == "," else 0
        numbers = words[keep:]
        if kind == 0:
            numbers = ["0"] * len(numbers)
        elif kind == 1:
            numbers = [f"-{w}" for w in numbers]
        elif kind == 2:
            numbers = [w.replace("1", "1e308") for w in numbers]
        else:
            numbers = numbers[::-1]
        rows.append(separator.join([*words[:keep], *numbers]))
    return "\n".join(rows) + "\n"


def hostile_image(rng: np.random.Generator, data: bytes) -> bytes:
    """An image with a false header, odd chunks, of another kind, or damaged."""
    kind = int(rng.integers(6))
    if kind == 0:
        size = choose(rng, ((30_000, 30_000), (2**31 - 1, 1), (0, 0), (WIDTH, 60_000), (WIDTH, HEIGHT), (1, 1)))
        return png(
            size, choose(rng, (b"", rng.bytes(50), zlib.compress(bytes(WIDTH * HEIGHT)))), int(choose(rng, (8, 16, 3)))
        )
    if kind == 1:
        extra = chunk(
            choose(rng, (b"iCCP", b"gAMA", b"tEXt", b"zTXt", b"sRGB", b"PLTE", b"IDAT", b"tRNS")), rng.bytes(20)
        )
        return data[:33] + extra + data[33:]
    if kind == 2:
        ending = choose(rng, (".jpg", ".bmp", ".tiff", ".webp", ".pgm", ".jp2"))
        return broken_bytes(rng, image(1, ending)) if rng.random() < 0.8 else image(1, ending)
    if kind == 3:
        return choose(
            rng, (b"P5\n60000 60000\n255\n", b"P5 64 48 255\n", b"P2 64 48 65535\n1 2", b"BM" + rng.bytes(60))
        )
    return broken_bytes(rng, data)


def png(size: tuple[int, int], pixels: bytes, depth: int = 8) -> bytes:
    """A PNG with right checksums, whatever its header says."""
    header = struct.pack(">IIBBBBB", *size, depth, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def special(rng: np.random.Generator, root: Path) -> None:
    """Put something that is not a regular file in a file's place."""
    files = sorted(p for p in root.rglob("*") if p.is_file() and not p.is_symlink())
    if not files:
        return
    path = choose(rng, files)
    path.unlink()
    kind = int(rng.integers(6))
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    else:
        path.symlink_to(
            choose(rng, ("/dev/zero", "/dev/full", path.name, "nowhere", "/proc/self/mem", "/proc/kmsg", "/"))
        )


def write(files: Files, root: Path) -> None:
    """Write files below a folder; those whose names no file can have are left out."""
    root.mkdir(exist_ok=True)
    for name, data in files.items():
        path = root / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except (OSError, ValueError):
            continue


SUBJECTS = (Subject("folders", read_folder), Subject("paths", read_path))
