"""ROS recordings as they are read by the package rosbags, and their image messages as grey images."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from slam.errors import SequenceError, SlamError, one_line, text_of
from slam.sequences.images import Size, decode_image, require_image_size, size_text

#: Types of messages that hold an image.
RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

#: Encodings of depth images, in ROS's convention (REP 118): no picture of a camera.
DEPTH = frozenset({"16UC1", "32FC1"})

# Bits and channels of an encoding, and OpenCV's conversion to grey. OpenCV names a Bayer pattern by its second row.
_ENCODINGS: dict[str, tuple[int, int, str]] = {
    "mono8": (8, 1, ""),
    "8UC1": (8, 1, ""),
    "mono16": (16, 1, ""),
    "16UC1": (16, 1, ""),
    "8UC3": (8, 3, "COLOR_BGR2GRAY"),
    "yuv422": (8, 2, "COLOR_YUV2GRAY_UYVY"),
    "uyvy": (8, 2, "COLOR_YUV2GRAY_UYVY"),
    "yuv422_yuy2": (8, 2, "COLOR_YUV2GRAY_YUY2"),
    "yuyv": (8, 2, "COLOR_YUV2GRAY_YUY2"),
}
for _bits in (8, 16):
    for _order in ("bgr", "rgb", "bgra", "rgba"):
        _ENCODINGS[f"{_order}{_bits}"] = (_bits, len(_order), f"COLOR_{_order.upper()}2GRAY")
    for _order, _name in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB")):
        _ENCODINGS[f"bayer_{_order}{_bits}"] = (_bits, 1, f"COLOR_Bayer{_name}2GRAY")


@contextmanager
def naming_recording(path: Path) -> Iterator[None]:
    """Whatever goes wrong with a damaged recording as one SequenceError with its name."""
    try:
        yield
    except SlamError:
        raise
    except Exception as error:  # of rosbags, of the decoders that it uses, or of messages that are not what they say
        text = one_line(text_of(error), 200) or type(error).__name__
        raise SequenceError(f"{path}: cannot be read as a ROS recording: {text}") from error


def grey_image(message: Any, kind: str, what: str, size: Size | None = None) -> np.ndarray:
    """The image (H, W) of a message in grey, 8 or 16 bits as sent; sizes are checked before anything is decoded.

    Args:
        message: as rosbags reads it.
        kind: its type, `RAW` or `COMPRESSED`.
        what: where it is from, for the message of an error.
        size: width and height that the image must have; None for any.

    Raises:
        SequenceError: it is damaged, or in an unknown encoding, or of another size.
    """
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


class Message(NamedTuple):
    """A message as it is recorded."""

    topic: str
    kind: str  # its type
    time: int  # of recording [ns]
    data: bytes


class Bag:
    """An open recording, whatever its kind; every fault of it is a `SequenceError` with its name."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path, self._reader = path, reader
        self.kinds: dict[str, str] = {connection.topic: connection.msgtype for connection in reader.connections}

    def messages(self, topics: Iterable[str], since: int | None = None) -> Generator[Message, None, None]:
        """All messages of some topics, from a time [ns] on, in the order of recording."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        messages = iter(self._reader.messages(connections, start=since)) if connections else iter(())
        while True:
            with naming_recording(self.path):
                found = next(messages, None)
            if found is None:
                return
            yield Message(found[0].topic, found[0].msgtype, int(found[1]), found[2])

    def read(self, message: Message) -> Any:
        """A message as an object."""
        with naming_recording(self.path):
            return self._reader.deserialize(message.data, message.kind)

    def image(self, message: Message, what: str, size: Size | None = None) -> np.ndarray:
        """The image (H, W) of a message, see `grey_image`."""
        with naming_recording(self.path):
            return grey_image(self.read(message), message.kind, what, size)

    def first(self, topic: str) -> Any:
        """The first message of a topic as an object; None where there is none."""
        with closing(self.messages([topic])) as messages:
            found = next(messages, None)
        return None if found is None else self.read(found)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a recording, and close it in the end; SequenceError where it cannot be read, or rosbags is missing."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        line = "ROS recordings are read by the package rosbags: pip install 'surf-stereo-slam[ros]'"
        raise SequenceError(f"{path}: {line}") from None
    with ExitStack() as stack:
        with naming_recording(path):
            if path.name.lower().endswith(".zstd"):
                path = _unpacked(path, Path(stack.enter_context(TemporaryDirectory())))
            reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            stack.enter_context(reader)
            bag = Bag(path, reader)
        yield bag


def _unpacked(path: Path, folder: Path) -> Path:
    """A compressed file, decompressed into a folder, by what rosbags does it with."""
    try:
        from compression import zstd  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        from backports import zstd
    target = folder / path.stem
    with zstd.open(path, "rb") as packed, target.open("wb") as file:
        shutil.copyfileobj(packed, file)
    return target
