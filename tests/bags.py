"""Small ROS recordings, written by rosbags itself."""

from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from slam.sequences.ros_bag import COMPRESSED, INFO, RAW
from tests.recordings import HEIGHT, WIDTH, K, picture

T0 = 1_700_000_000_000_000_000
STEP = 50_000_000
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
LEFT, RIGHT = "/stereo/left/image_raw", "/stereo/right/image_raw"


def header(store, stamp: int):
    types = store.types
    time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    more = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__annotations__ else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id="camera", **more)


def image(store, stamp: int, pixels: np.ndarray, encoding: str = "mono8", big: bool = False):
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, 3)))  # drivers align rows
    return store.types[RAW](
        header(store, stamp), len(pixels), pixels.shape[1], encoding, int(big), padded.shape[1], padded.ravel()
    )


def compressed(store, message):
    data = cv2.imencode(".png", message.data.reshape(HEIGHT, -1)[:, :WIDTH])[1].ravel()
    return store.types[COMPRESSED](message.header, "png", data)


D = np.array([-0.2, 0.05, 0.001, -0.001, 0.0])
R_LEFT = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
R_RIGHT = cv2.Rodrigues(np.array([-0.01, 0.01, 0.003]))[0]


def info(store, baseline: float, R: np.ndarray = R_LEFT, **change):
    P = np.array([[48.0, 0, 30.0, -48.0 * baseline], [0, 48.0, 24.0, 0], [0, 0, 1, 0]])
    types, capital = store.types, store is STORES[1]
    matrices = {"D": D, "K": K.ravel(), "R": R.ravel(), "P": P.ravel()}
    values = {
        "header": header(store, T0),
        "height": HEIGHT,
        "width": WIDTH,
        "distortion_model": "plumb_bob",
        **{(name if capital else name.lower()): value for name, value in matrices.items()},
        "binning_x": 0,
        "binning_y": 0,
        "roi": types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    }
    return types[INFO](**{**values, **change})


def stereo(store, count: int = 6):
    """Topic, kind, time of recording and message of a stereo recording."""
    rows = [
        ("/stereo/left/camera_info", INFO, T0, info(store, 0.0)),
        ("/stereo/right/camera_info", INFO, T0, info(store, 0.2, R_RIGHT)),
    ]
    for k in range(count):
        stamp = T0 + k * STEP
        rows.append((LEFT, RAW, stamp + 1000, image(store, stamp, picture(k))))
        rows.append((RIGHT, RAW, stamp + 2000, image(store, stamp + 1_000_000, picture(k + 10))))
    return rows


def write(path: Path, rows, version: int = 1, packed: str = "") -> Path:
    """Write a recording; `packed` are whole files or single messages of ROS 2, or the chunks of ROS 1."""
    store = STORES[version]
    mcap = {"storage_plugin": StoragePlugin.MCAP} if path.suffix == ".mcap" else {}
    folder = path.with_suffix("") if version == 2 else path
    bag = Writer1(path) if version == 1 else Writer2(folder, version=9, **mcap)
    if packed and version == 1:
        bag.set_compression(Writer1.CompressionFormat.LZ4)
    elif packed:
        bag.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with bag:
        topics = {}
        for topic, kind, time, message in sorted(rows, key=lambda row: row[2]):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(message, kind) if version == 1 else store.serialize_cdr(message, kind)
            bag.write(topics[topic], time, data)
    return path if version == 1 else folder
