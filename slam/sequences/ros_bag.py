"""ROS recordings as the package rosbags reads them: messages, images in grey, and what cameras say of themselves."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from slam.errors import CalibrationError, SequenceError, SlamError, one_line, text_of
from slam.sequences.base import attempt
from slam.sequences.calibration import Entry, array, naming
from slam.sequences.images import Size, decode_image, require_image_size, size_text

#: Types of messages that hold an image.
RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"  #: type of what a camera says of itself
_LARGEST, _RATIO = 2**30, 50  # of what is unpacked: bytes, or times its size

#: Encodings of depth images, in ROS's convention (REP 118): no picture of a camera.
DEPTH = frozenset({"16UC1", "32FC1"})

# Bits and channels of an encoding, and OpenCV's conversion to grey. OpenCV names a Bayer pattern by its second row.
_ENCODINGS: dict[str, tuple[int, int, str]] = {
    **{name: (bits, 1, "") for bits in (8, 16) for name in (f"mono{bits}", f"{bits}UC1")},
    **{f"{bits}UC{n}": (bits, n, f"COLOR_{'BGR' if n == 3 else 'BGRA'}2GRAY") for bits in (8, 16) for n in (3, 4)},
    **{name: (8, 2, "COLOR_YUV2GRAY_UYVY") for name in ("yuv422", "uyvy")},
    **{name: (8, 2, "COLOR_YUV2GRAY_YUY2") for name in ("yuv422_yuy2", "yuyv")},
    **{
        f"{order}{bits}": (bits, len(order), f"COLOR_{order.upper()}2GRAY")
        for bits in (8, 16)
        for order in ("bgr", "rgb", "bgra", "rgba")
    },
    **{
        f"bayer_{order}{bits}": (bits, 1, f"COLOR_Bayer{name}2GRAY")
        for bits in (8, 16)
        for order, name in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB"))
    },
}


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Whatever goes wrong with a damaged recording as one SequenceError with its name."""
    try:
        yield
    except SlamError:
        raise
    except Exception as error:  # of rosbags, of the decoders that it uses, or of messages that are not what they say
        text = one_line(text_of(error), 200) or type(error).__name__
        raise SequenceError(f"{path}: cannot be read as a ROS recording: {text}") from error


def grey_image(message: Any, kind: str, what: str, size: Size | None = None) -> np.ndarray:
    """The image (H, W) of a message, of a `kind` `RAW` or `COMPRESSED`, in grey as sent; `what` names it in errors."""
    if kind == COMPRESSED:
        return decode_image(bytes(message.data), what, size)
    width, height, step = int(message.width), int(message.height), int(message.step)
    require_image_size((width, height), size, what)
    if message.encoding not in _ENCODINGS:
        raise SequenceError(f"{what}: encoding {message.encoding!r} is not supported")
    bits, channels, conversion = _ENCODINGS[message.encoding]
    row = width * channels * bits // 8
    data = np.asarray(message.data, np.uint8)
    if step < row or len(data) < height * step:
        raise SequenceError(f"{what}: {len(data)} bytes are too few for {size_text((width, height))}")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    if bits == 16:
        rows = rows.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    image = rows.reshape(height, width, channels)
    if not conversion:
        return image[:, :, 0]
    import cv2

    try:
        return np.asarray(cv2.cvtColor(image, getattr(cv2, conversion)))
    except cv2.error as error:
        raise SequenceError(f"{what}: cannot be decoded") from error


class Bag:
    """An open recording, whatever its kind."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path, self._reader = path, reader
        self.kinds: dict[str, str] = {connection.topic: connection.msgtype for connection in reader.connections}

    def topics(self, *kinds: str) -> list[str]:
        """The topics of messages of these types."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    def messages(
        self, topics: Iterable[str], since: int | None = None
    ) -> Generator[tuple[str, int, bytes], None, None]:
        """Topic, time of recording [ns] and bytes of the messages of some topics, from a time on, as recorded."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        for connection, time, data in self._reader.messages(connections, start=since) if connections else ():
            yield connection.topic, int(time), data

    def read(self, topic: str, data: bytes) -> Any:
        """A message as an object."""
        return self._reader.deserialize(data, self.kinds[topic])

    def image(self, topic: str, row: int, data: bytes, size: Size | None = None) -> np.ndarray:
        """The image (H, W) of a topic's message by its number, see `grey_image`."""
        with _one_line(self.path):
            return grey_image(self.read(topic, data), self.kinds[topic], f"{topic}, message {row}", size)

    def first_image(self, topic: str) -> np.ndarray:
        """The first image (H, W) of a topic that can be read; SequenceError where none can."""
        image = None
        for row, (_, _, data) in enumerate(self.messages([topic])):
            image = attempt(self.image, topic, row, data)
            if isinstance(image, np.ndarray):
                return image
        raise SequenceError(f"{self.path}: no image of {topic} can be read: {image}")

    def first(self, topic: str) -> Any:
        """The first message of a topic as an object; None where there is none."""
        with closing(self.messages([topic])) as messages:
            return next((self.read(topic, data) for _, _, data in messages), None)

    def camera_info(self, topic: str) -> dict[str, Entry]:
        """The first CameraInfo message of a topic as entries; ROS 1 writes the matrices' names in capitals."""
        message = self.first(topic)
        if message is None:
            raise CalibrationError(f"{self.path}: topic {topic} has no messages")
        with naming(Path(topic)):
            size, roi = ((int(area.width), int(area.height)) for area in (message, message.roi))
            if max(int(message.binning_x), int(message.binning_y)) > 1 or roi not in ((0, 0), size):
                raise CalibrationError("binning and regions of interest are not supported")
            entries: dict[str, Entry] = {"size": ("size", size)}
            entries["distortionmodel"] = "distortion_model", str(message.distortion_model)
            for name in "KDRP":
                numbers = getattr(message, name, getattr(message, name.lower(), None))
                entries[name.lower()] = name, array(numbers, name, None)
            return entries


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a recording, and close it in the end; every fault of it, also while it is read, is a SequenceError."""
    if find_spec("rosbags") is None:
        raise SequenceError(f"{path}: it is read by the package rosbags, which is not installed: pip install rosbags")
    with _one_line(path), ExitStack() as stack:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        file = path
        if path.name.lower().endswith(".zstd"):
            file = Path(stack.enter_context(TemporaryDirectory())) / path.stem
            _unpack(path, file)
        reader = AnyReader([file], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        yield Bag(path, stack.enter_context(reader))


def _unpack(packed: Path, target: Path) -> None:
    """Decompress a file as rosbags would; SequenceError where little becomes very much."""
    try:
        from compression import zstd  # type: ignore[import-not-found, unused-ignore]
    except ImportError:  # before Python 3.14
        from backports import zstd
    most = max(_LARGEST, _RATIO * packed.stat().st_size)  # bytes
    with zstd.open(packed, "rb") as file, target.open("wb") as unpacked:
        while part := file.read(_LARGEST // 64):
            unpacked.write(part)
            if unpacked.tell() > most:
                raise SequenceError(f"{packed}: unpacks to more than {_RATIO} times its size")
