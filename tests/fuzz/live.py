"""ROS recordings that are damaged or lie, and cameras that stop, change their images, and come back."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

import slam
from slam.errors import SequenceError
from slam.sequences import camera, devices
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.hostile import NUMBERS, broken_bytes, broken_text, choose
from tests.fuzz.readers import HEIGHT, WIDTH, folders, videos
from tests.fuzz.readers import consume as read_to_its_end
from tests.slam.sequences.test_ros import INFO, RAW, STORES, stereo, write

Array = np.ndarray

_KINDS = ("walk.bag", "walk.mcap", "walk")
_FRAMES = 4
_MOST = 40  # frames that are taken from a camera


# ------------------------------------------------------------------------------------------------ recordings


@cache
def _recording(kind: str) -> dict[str, bytes]:
    """The files of a good recording."""
    with tempfile.TemporaryDirectory() as folder:
        version = 1 if kind.endswith(".bag") else 2
        path = write(Path(folder) / kind, stereo(STORES[version], _FRAMES), version)
        files = [path] if path.is_file() else sorted(path.iterdir())
        return {file.name: file.read_bytes() for file in files}


def damaged_recording(rng: np.random.Generator, folder: Path) -> None:
    """A recording with bytes changed, cut off or doubled, or with another one's files."""
    kind = choose(rng, _KINDS)
    files, root = dict(_recording(kind)), folder / "walk"
    root.mkdir()
    for _ in range(int(rng.integers(1, 3))):
        name = choose(rng, sorted(files))
        if name.endswith(".yaml"):
            files[name] = broken_text(rng, files[name].decode()).encode("utf-8", "replace")
        elif rng.random() < 0.1:
            files[name] = choose(rng, sorted(_recording(choose(rng, _KINDS)).values()))
        else:
            files[name] = broken_bytes(rng, files[name])
    for name, data in files.items():
        (root / name).write_bytes(data)
    read_to_its_end(str(root if "metadata.yaml" in files and rng.random() < 0.6 else root / choose(rng, sorted(files))))


def lying_recording(rng: np.random.Generator, folder: Path) -> None:
    """A sound recording with messages that are none: sizes, encodings, stamps and calibrations that cannot be."""
    kind = choose(rng, _KINDS)
    version = 1 if kind.endswith(".bag") else 2
    rows = stereo(STORES[version], _FRAMES, late=int(choose(rng, (0, 0, 10**7, 10**10))))
    for _ in range(int(rng.integers(1, 4))):
        _spoil(rng, rows)
    try:
        path = write(folder / kind, rows, version)
    except Exception:  # noqa: BLE001 what rosbags itself does not write cannot be read
        return
    names = ("left", "right", "left_info", "right_info", "calibration", "tolerance", "kind", "x")
    option = f"?{choose(rng, names)}={choose(rng, ('/x', '', *NUMBERS))}" if rng.random() < 0.2 else ""
    read_to_its_end(f"{path}{option}")


def _spoil(rng: np.random.Generator, rows: list[tuple[str, str, int, Any]]) -> None:
    """Change one message."""
    at = int(rng.integers(len(rows)))
    _, kind, time, message = rows[at]
    change = int(rng.integers(6))
    if change == 0:
        del rows[at]
    elif change == 1:
        rows.append(rows[at])
    elif change == 2:
        stamp = message.header.stamp
        object.__setattr__(stamp, "sec", int(choose(rng, (0, 1, 2**31 - 1, stamp.sec + 10**6, stamp.sec - 1))))
        object.__setattr__(stamp, "nanosec", int(choose(rng, (0, stamp.nanosec, 2**32 - 1))))
    elif change == 3:
        rows[at] = (choose(rng, ("/x", "/stereo/left/image_raw", "/stereo/right/camera_info")), kind, time, message)
    elif kind == RAW:
        name, values = choose(rng, _IMAGE)
        object.__setattr__(message, name, choose(rng, values))
    elif kind == INFO:
        names = [n for n in ("D", "K", "R", "P", "d", "k", "r", "p", "width", "height", "distortion_model")
                 if hasattr(message, n)]  # fmt: skip
        name = choose(rng, names)
        object.__setattr__(message, name, _spoilt(rng, getattr(message, name)))


_IMAGE: tuple[tuple[str, tuple[Any, ...]], ...] = (
    ("height", (0, 1, 47, 49, 60_000, 2**32 - 1)),
    ("width", (0, 1, 63, 65, 60_000, 2**32 - 1)),
    ("step", (0, 1, 64, 2**32 - 1)),
    ("encoding", ("", "x", "rgb8", "bgra8", "mono16", "32FC1", "bayer_rggb8", "yuv422", "16UC9999", "8UC0", "\0")),
    ("is_bigendian", (0, 1, 255)),
    ("data", (np.zeros(0, np.uint8), np.zeros(7, np.uint8), np.zeros(10**6, np.uint8))),
)


def _spoilt(rng: np.random.Generator, value: Any) -> Any:
    """A number, a text or an array of a calibration that cannot be."""
    if isinstance(value, str):
        return choose(rng, ("", "equidistant", "rational_polynomial", "x", "\0", "thin_prism"))
    if isinstance(value, int):
        return int(choose(rng, (0, 1, 10**6, 2**32 - 1)))
    out = np.array(value, float)
    if len(out) in (9, 12):  # of a fixed length
        out[rng.random(len(out)) < 0.3] = choose(rng, (np.nan, np.inf, 0.0, -1.0, 1e300, 1e-300))
        return out
    return choose(rng, (np.zeros(0), np.zeros(3), np.full(5, 1e300), np.full(5, np.nan), np.ones(100)))


# ------------------------------------------------------------------------------------------------ cameras


class Played:
    """A camera that gives what it is told to: an image, nothing, or an error; it is opened again after nothing."""

    def __init__(self, script: list[Any]) -> None:
        self.script, self.now = script, None

    def grab(self) -> bool:
        """The next one."""
        self.now = self.script.pop(0) if self.script else None
        return self.now is not None

    def retrieve(self) -> tuple[bool, Any]:
        """It, or an error that OpenCV has."""
        if isinstance(self.now, str):
            raise cv2.error(self.now)
        return self.now is not None, self.now

    def release(self) -> None:
        """Nothing to do."""


def _images(rng: np.random.Generator, width: int) -> list[Any]:
    """What a camera gives in a run."""
    good = rng.integers(0, 256, (HEIGHT, width), dtype=np.uint8)
    others = (
        None, None, "no frame", np.zeros((0, 0), np.uint8), good[:, :-1], good[:-1], np.dstack([good] * 3),
        good.astype(np.uint16) * 200, np.tile(good, (2, 2)), good[:, : width // 2],
    )  # fmt: skip
    script = [good] * int(rng.integers(1, 6))
    for _ in range(int(rng.integers(4))):
        script += [choose(rng, others)] * int(rng.integers(1, 4)) + [good] * int(rng.integers(4))
    return script


def camera_in_trouble(rng: np.random.Generator, folder: Path) -> None:
    """Two cameras, or one with both images, that stop, come back and change their size."""
    (folder / "calibration.yaml").write_bytes(folders()["calibration.yaml"])
    two = rng.random() < 0.5
    scripts = {"0": _images(rng, WIDTH if two else 2 * WIDTH), "1": _images(rng, WIDTH)}
    shut = [rng.random() < 0.1 for _ in range(200)]

    def open_device(address: str, *_: object) -> Played:
        if address not in scripts or shut.pop():
            raise SequenceError(f"camera:{address}: cannot be opened")
        return Played(scripts[address])

    options = f"?calibration={folder}/calibration.yaml&wait=0.03"
    if rng.random() < 0.2:
        name = choose(rng, ("width", "height", "fps", "wait", "swap", "kind", "x"))
        options += f"&{name}={choose(rng, NUMBERS)}"
        if name == "wait":
            options += "&x=1"  # nobody waits for a day here
    with patch.object(devices, "open_device", open_device), patch.object(camera, "_AGAIN", 0.005):
        _consume(f"camera:{'0,1' if two else '0'}{options}")


def camera_of_files(rng: np.random.Generator, folder: Path) -> None:
    """Damaged videos that play a camera."""
    (folder / "calibration.yaml").write_bytes(folders()["calibration.yaml"])
    for name, data in videos().items():
        if name.endswith(".avi"):
            (folder / name).write_bytes(broken_bytes(rng, data) if rng.random() < 0.6 else data)
    text = choose(rng, (f"{folder}/left.avi,{folder}/right.avi", f"{folder}/left.avi", f"{folder}/left.avi,{folder}"))
    _consume(f"camera:{text}?calibration={folder}/calibration.yaml&wait=0.1")


def _consume(address: str) -> None:
    """Read frames: in order of time, of the rig's size, and as many numbers as frames."""
    sequence = slam.open_sequence(address)
    last = -np.inf
    for count, frame in enumerate(sequence.frames(0, _MOST)):
        if frame.index != count or not (np.isfinite(frame.stamp) and frame.stamp > last):
            raise Broken("frames are not in order of time and number")
        last = frame.stamp
        for pixels in (frame.left, frame.right):
            if pixels is None or pixels.shape[:2] != (sequence.rig.height, sequence.rig.width):
                raise Broken("an image is not of the rig's size")
    if len(sequence.warnings) > _MOST:
        raise Broken("a warning for every frame")


SUBJECTS = (
    Subject("damaged recordings", "ROS bags, MCAP and SQLite recordings with bytes and files changed",
            "a sequence of sound frames or one line", damaged_recording, quiet=False, short=25),
    Subject("lying recordings", "sound ROS recordings of images, stamps and calibrations that cannot be",
            "the same", lying_recording, quiet=False, short=25),
    Subject("cameras", "cameras that stop, come back, fail, and give other sizes and types", "the same",
            camera_in_trouble, short=25),
    Subject("files as cameras", "damaged videos that play a camera", "the same", camera_of_files, short=15),
)  # fmt: skip
