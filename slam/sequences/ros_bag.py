"""ROS recordings as they are read by the package rosbags: images in grey, and the topics and the rig of a pair."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from slam.errors import CalibrationError, ConfigurationError, SequenceError, SlamError, one_line, text_of
from slam.geometry.rig import StereoRig
from slam.naming import suggestion
from slam.sequences.calibration import Entries, Entry, array, naming
from slam.sequences.images import Size, decode_image, require_image_size, size_text
from slam.sequences.names import SIDES
from slam.sequences.rigs import rig_of

#: Types of messages that hold an image.
RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO = "sensor_msgs/msg/CameraInfo"
_IMAGES = (RAW, COMPRESSED)
_MATRICES: dict[str, tuple[str, tuple[int, ...] | None]] = {
    "K": ("cameramatrix", (3, 3)),  # of the raw image
    "D": ("distcoeffs", None),
    "R": ("rectificationmatrix", (3, 3)),  # from raw to rectified camera axes
    "P": ("projectionmatrix", (3, 4)),  # of the rectified image; ``P[0, 3] = -fx B`` of the right camera of a pair
}
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins what is compressed
_LARGEST, _RATIO = 2**30, 50  # [bytes] of a message; of what is unpacked, times its size
_SAME_PLACE = 1e-6  # [m] from a pair's left camera
_LISTED = 12  # topics named in a message

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
    """The image (H, W) of a message of a `kind`, `RAW` or `COMPRESSED`, in grey, 8 or 16 bits as sent.

    SequenceError, which names `what` it is, where it is damaged, in an unknown encoding, or of another size.
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
    """An open recording, whatever its kind."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path, self._reader = path, reader
        self.kinds: dict[str, str] = {connection.topic: connection.msgtype for connection in reader.connections}

    def messages(self, topics: Iterable[str], since: int | None = None) -> Generator[Message, None, None]:
        """All messages of some topics, from a time [ns] on, in the order of recording."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        for connection, time, data in self._reader.messages(connections, start=since) if connections else ():
            yield Message(connection.topic, connection.msgtype, int(time), data)

    def read(self, message: Message) -> Any:
        """A message as an object; one that is compressed by itself, in a file without its folder, is decompressed."""
        packed = bytes(message.data[: len(_ZSTD)]) == _ZSTD
        return self._reader.deserialize(_unpacked(message.data) if packed else message.data, message.kind)

    def image(self, message: Message, what: str, size: Size | None = None) -> np.ndarray:
        """The image (H, W) of a message, see `grey_image`."""
        with _one_line(self.path):
            return grey_image(self.read(message), message.kind, what, size)

    def first_image(self, topic: str) -> np.ndarray:
        """The first image (H, W) of a topic that can be read; SequenceError where none can."""
        reason = "no messages"
        for message in self.messages([topic]):
            try:
                return self.image(message, topic)
            except SequenceError as error:
                reason = str(error)
        raise SequenceError(f"{self.path}: no image of {topic} can be read: {reason}")

    def first(self, topic: str) -> Any:
        """The first message of a topic as an object; None where there is none."""
        with closing(self.messages([topic])) as messages:
            found = next(messages, None)
        return None if found is None else self.read(found)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a recording, and close it in the end.

    SequenceError for every fault of it, also of what is read meanwhile, or where rosbags is missing.
    """
    if find_spec("rosbags") is None:
        line = "ROS recordings are read by the package rosbags: pip install 'surf-stereo-slam[ros]'"
        raise SequenceError(f"{path}: {line}")
    with _one_line(path), ExitStack() as stack:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        file = path
        if path.name.lower().endswith(".zstd"):
            file = Path(stack.enter_context(TemporaryDirectory())) / path.stem
            _unpack(path, file)
        reader = AnyReader([file], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        yield Bag(path, stack.enter_context(reader))


def _zstd() -> Any:
    """The module that decompresses zstd."""
    try:
        from compression import zstd  # type: ignore[import-not-found, unused-ignore]
    except ImportError:  # before Python 3.14
        from backports import zstd
    return zstd


def _unpacked(data: bytes) -> bytes:
    """A message, decompressed; SequenceError where it is larger than any image."""
    unpacked: bytes = _zstd().ZstdDecompressor().decompress(data, max_length=_LARGEST)
    if len(unpacked) >= _LARGEST:
        raise SequenceError(f"a message of more than {_LARGEST} bytes")
    return unpacked


def _unpack(packed: Path, target: Path) -> None:
    """Decompress a file as rosbags would; SequenceError where little becomes very much."""
    most = max(_LARGEST, _RATIO * packed.stat().st_size)
    with _zstd().open(packed, "rb") as file, target.open("wb") as unpacked:
        while part := file.read(_LARGEST // 64):
            unpacked.write(part)
            if unpacked.tell() > most:
                raise SequenceError(f"{packed}: unpacks to more than {_RATIO} times its size")


def camera_info(bag: Bag, topic: str) -> dict[str, Entry]:
    """The first CameraInfo message of a topic, of ROS 1, which writes matrices in capitals, or 2, as entries.

    CalibrationError where there is none, it holds what no calibration holds, or only a part of the image is given.
    """
    message = bag.first(topic)
    if message is None:
        raise CalibrationError(f"{bag.path}: topic {topic} has no messages")
    with naming(Path(topic)):
        found: dict[str, Entry] = {"distortionmodel": ("distortion_model", str(message.distortion_model))}
        for name, (entry, shape) in _MATRICES.items():
            found[entry] = name, array(getattr(message, name, getattr(message, name.lower(), None)), name, shape)
        size = int(message.width), int(message.height)
        roi = int(message.roi.width), int(message.roi.height)
        if max(int(message.binning_x), int(message.binning_y)) > 1 or roi not in ((0, 0), size):
            raise CalibrationError("binning and regions of interest are not supported")
        return found | {"size": ("size", size)}


def rig_by_messages(infos: Sequence[dict[str, Entry]], rectified: bool, unit: float = 1.0) -> StereoRig:
    """The rig of the rectified or of the raw images; the baseline in ``P`` is in units of so many metres.

    CalibrationError where a camera is not calibrated, or not as one of a pair; or the rig is impossible.
    """
    for side, info in zip(("left", "right"), infos):
        if not (info["projectionmatrix"][1][0, 0] > 0 and info["cameramatrix"][1][0, 0] > 0):
            raise CalibrationError(f"the {side} camera is not calibrated: K or P is zero")
    left, right = (info["size"][1] for info in infos)
    if left != right:
        raise CalibrationError("the images of the two cameras differ in size")
    return rig_of(Entries(infos), left, unit, rectified, False)


class Topics(NamedTuple):
    """The topics of a stereo rig."""

    images: tuple[str, ...]  # of the left and the right one; one where they are side by side
    infos: tuple[str, ...] = ()  # of the cameras' calibrations; none where a file is named in their place


def is_rectified(topic: str) -> bool:
    """Whether images are rectified, by ROS's names for topics (``image_rect``, ``image_rect_raw``)."""
    return "rect" in _split(topic)[1]


def choose_topics(bag: Bag, options: Mapping[str, Any]) -> Topics:
    """The topics by the options ``left``, ``right``, ``left_info``, ``right_info``; without them those of a pair.

    A pair are two cameras whose messages say so: the same size and focal length of the rectified images, and a baseline
    in the right one's projection. Depth images do not count. Where a calibration is named, names decide.

    Raises:
        SequenceError: a topic is not there, or there is not exactly one pair.
        CalibrationError: there is no calibration.
        ConfigurationError: one of the two images is named and the other is not, or both are the same.
    """
    sides = ("left",) if options.get("layout") is not None else ("left", "right")
    if any(side in options for side in sides):
        if not all(side in options for side in sides):
            raise ConfigurationError("name both topics: left=/…&right=/…")
        images = tuple(_named(bag, options[side], _IMAGES) for side in sides)
        if len(sides) > len(set(images)):
            raise ConfigurationError(f"left and right are the same topic, {images[0]}")
    else:
        images = tuple(_cameras(bag)) if sides == ("left",) else _only_pair(bag, options)
        if sides == ("left",) and len(images) != 1:
            there = f"{len(images)} topics of images, where layout=sbs needs one"
            raise SequenceError(f"{bag.path}: {there}: add left=/… of {_listed(list(images))}")
    infos = []
    for side, topic in zip(("left", "right"), () if "calibration" in options else images * (3 - len(images))):
        usual = f"{_split(topic)[0]}/camera_info"
        if f"{side}_info" in options:
            infos.append(_named(bag, options[f"{side}_info"], (_INFO,)))
        elif bag.kinds.get(usual) == _INFO:
            infos.append(usual)
        else:
            there = f"add {side}_info=/… (there are {_listed(_of_kind(bag, (_INFO,)))}) or calibration=FILE"
            raise CalibrationError(f"{bag.path}: no {usual} for {topic}: {there}")
    return Topics(images, tuple(infos))


def _only_pair(bag: Bag, options: Mapping[str, Any]) -> tuple[str, ...]:
    """The only pair of topics of images."""
    pairs = _pairs_by_name(bag) if "calibration" in options else _pairs_by_messages(bag)
    if len(pairs) == 1:
        return pairs[0]
    images = _of_kind(bag, _IMAGES)
    if pairs:
        found = "; ".join("left={}&right={}".format(*pair) for pair in pairs[:3])
        raise SequenceError(f"{bag.path}: several stereo pairs, choose one: {found}")
    if not images:
        raise SequenceError(f"{bag.path}: no images; its topics are {_listed(sorted(bag.kinds))}")
    raise SequenceError(
        f"{bag.path}: its camera messages name no stereo pair: add left=/…&right=/… of {_listed(images)}, "
        "and calibration=FILE where the cameras are not calibrated"
    )


def _pairs_by_messages(bag: Bag) -> list[tuple[str, ...]]:
    """All pairs of cameras whose CameraInfo says that they are one."""
    cameras: dict[str, tuple[object, float]] = {}
    spaces = set()
    for topic in _cameras(bag):
        space = _split(topic)[0]
        name = f"{space}/camera_info"
        if space not in spaces and bag.kinds.get(name) == _INFO and bag.first(name) is not None:
            spaces.add(space)
            info = camera_info(bag, name)
            P = info["projectionmatrix"][1]
            if P[0, 0] > 0:
                cameras[topic] = (info["size"][1], P[0, 0]), -P[0, 3] / P[0, 0]
    return [
        (left, right)
        for left, (a, left_offset) in cameras.items()
        for right, (b, right_offset) in cameras.items()
        if a == b and abs(left_offset) < _SAME_PLACE and right_offset > _SAME_PLACE
    ]


def _pairs_by_name(bag: Bag) -> list[tuple[str, ...]]:
    """Pairs of topics of images that differ in one of the usual names for left and right, one of each two cameras."""
    images = _cameras(bag)
    found: dict[tuple[str, str], tuple[str, ...]] = {}
    for topic in images:
        for names in SIDES:
            other = topic.replace(*names)
            if other != topic and other in images:
                spaces = _split(topic)[0], _split(other)[0]
                found.setdefault(spaces if spaces[0] != spaces[1] else (topic, other), (topic, other))
    return list(found.values())


def _named(bag: Bag, topic: str, kinds: tuple[str, ...]) -> str:
    """A topic that must be there, and of one of these types."""
    known = _of_kind(bag, kinds)
    if topic not in known:
        there = f"it holds {bag.kinds[topic]}" if topic in bag.kinds else "there is none"
        raise SequenceError(f"{bag.path}: topic {topic}: {there}{suggestion(topic, known)}; there are {_listed(known)}")
    return topic


def _of_kind(bag: Bag, kinds: tuple[str, ...]) -> list[str]:
    return sorted(topic for topic, kind in bag.kinds.items() if kind in kinds)


def _cameras(bag: Bag) -> list[str]:
    """Topics of images, not of depth, in the order in which they are taken: rectified, raw, and grey ones first."""

    def order(topic: str) -> tuple[bool, ...]:
        name = _split(topic)[1]
        return "rect" not in name, bag.kinds[topic] == COMPRESSED, "color" in name

    def depth(topic: str) -> bool:
        message = bag.first(topic)
        if message is None or bag.kinds[topic] == COMPRESSED:
            return message is None or "compressedDepth" in topic
        return message.encoding in DEPTH

    return sorted((topic for topic in _of_kind(bag, _IMAGES) if not depth(topic)), key=order)


def _split(topic: str) -> tuple[str, str]:
    """The name space of a camera's topic, and its last name without what names its compression."""
    space, _, last = topic.rpartition("/")
    space, _, last = space.rpartition("/") if last.startswith("compressed") else (space, "", last)
    return space, last


def _listed(topics: list[str]) -> str:
    more = f", … ({len(topics)})" if len(topics) > _LISTED else ""
    return (", ".join(topics[:_LISTED]) or "none") + more
