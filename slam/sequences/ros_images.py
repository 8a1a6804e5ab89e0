"""ROS image messages, raw or compressed, as grey images."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError, SlamError, one_line, text_of
from slam.sequences.images import MOST_PIXELS, Size, decode_image, size_text

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
    for _order, _channels in (("bgr", 3), ("rgb", 3), ("bgra", 4), ("rgba", 4)):
        _ENCODINGS[f"{_order}{_bits}"] = (_bits, _channels, f"COLOR_{_order.upper()}2GRAY")
    for _order, _name in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB")):
        _ENCODINGS[f"bayer_{_order}{_bits}"] = (_bits, 1, f"COLOR_Bayer{_name}2GRAY")


@contextmanager
def naming_recording(path: Path) -> Iterator[None]:
    """Whatever goes wrong with a damaged recording as one error with its name.

    Raises:
        SequenceError: something did.
    """
    try:
        yield
    except SlamError:
        raise
    except Exception as error:  # of rosbags, of the decoders that it uses, or of messages that are not what they say
        text = one_line(text_of(error), 200) or type(error).__name__
        raise SequenceError(f"{path}: cannot be read as a ROS recording: {text}") from error


def grey_image(message: Any, kind: str, what: str, size: Size | None = None) -> np.ndarray:
    """The image (H, W) of a message in grey, 8 or 16 bits as sent.

    Sizes are checked before anything is decoded.

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
    if size is not None and (width, height) != size:
        raise SequenceError(f"{what}: image is {size_text((width, height))}, not {size_text(size)}")
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise SequenceError(f"{what}: image is {size_text((width, height))}: at most {MOST_PIXELS} pixels are read")
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
    return _to_grey(rows.reshape(height, width, channels), conversion, what)


def _to_grey(image: np.ndarray, conversion: str, what: str) -> np.ndarray:
    """One channel of several by OpenCV's conversion."""
    if not conversion:
        return image[:, :, 0]
    import cv2

    try:
        return np.asarray(cv2.cvtColor(image, getattr(cv2, conversion)))
    except cv2.error as error:
        raise SequenceError(f"{what}: cannot be decoded") from error
