"""ROS recordings that are damaged: cut, overwritten, with wrong numbers in their index, or of another file."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from tests import recordings
from tests.fuzz.files import Files, mutate
from tests.fuzz.harness import Subject
from tests.fuzz.hostile import choose
from tests.fuzz.readers import consume
from tests.fuzz.readers import write as write_files

_FRAMES, _START, _STEP = 5, 1_700_000_000_000_000_000, 50_000_000
_IMAGE, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
KINDS = ("bag", "lz4", "mcap", "packed mcap", "message mcap", "db3", "packed db3", "message db3")


@cache
def _written(kind: str) -> Files:
    """The files of a small recording of a kind."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / ("walk.bag" if kind in ("bag", "lz4") else "walk")
        write(path, kind)
        return {str(p.relative_to(name)): p.read_bytes() for p in sorted(Path(name).rglob("*")) if p.is_file()}


def write(path: Path, kind: str) -> None:
    """Write a recording of two cameras with their calibrations."""
    first = kind in ("bag", "lz4")
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    if first:
        writer = rosbag1.Writer(path)
        if kind == "lz4":
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind.endswith("mcap") else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if kind.startswith(("packed", "message")):
            mode = rosbag2.CompressionMode.FILE if kind.startswith("packed") else rosbag2.CompressionMode.MESSAGE
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topics = {}
        for stamp, topic, message in _messages(store, first):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            serialize = store.serialize_ros1 if first else store.serialize_cdr
            writer.write(topics[topic], stamp, serialize(message, message.__msgtype__))


def _messages(store, first: bool):
    """Time of recording [ns], topic and message."""
    types, width, height = store.types, recordings.WIDTH, recordings.HEIGHT
    K = np.array([50.0, 0, 31.5, 0, 50, 23.5, 0, 0, 1])
    for k in range(_FRAMES):
        stamp = _START + k * _STEP
        time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        header = types["std_msgs/msg/Header"](**({"seq": k} if first else {}), stamp=time, frame_id="camera")
        for side, seed, offset in (("left", k, 0.0), ("right", k + 10, -10.0)):
            P = np.array([50.0, 0, 31.5, offset, 0, 50, 23.5, 0, 0, 0, 1, 0])
            entries = dict(zip("DKRP" if first else "dkrp", (np.zeros(5), K, np.eye(3).ravel(), P)))
            roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            info = {"header": header, "height": height, "width": width, "distortion_model": "plumb_bob", **entries}
            yield stamp, f"/{side}/camera_info", types[_INFO](**info, binning_x=0, binning_y=0, roi=roi)
            pixels = recordings.picture(seed).ravel()
            yield stamp, f"/{side}/image_rect", types[_IMAGE](header, height, width, "mono8", 0, width, pixels)


def read_bag(rng: np.random.Generator, folder: Path) -> None:
    """Write a damaged recording and read it to its end."""
    files = dict(_written(choose(rng, KINDS)))
    whole = folder / ("walk.bag" if "walk.bag" in files else "walk")
    mutate(rng, files)
    write_files(files, folder)
    alone = sorted(path for path in whole.glob("*") if path.suffix != ".yaml") or [whole]
    consume(str(whole if rng.random() < 0.6 else alone[0]))


SUBJECTS = (Subject("bags", read_bag, quiet=False),)
