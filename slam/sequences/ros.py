"""ROS recordings as sequences: ``.bag`` files of ROS 1, folders, ``.mcap`` and ``.db3`` files of ROS 2.

They are read by the package rosbags (``pip install 'surf-stereo-slam[ros]'``), loaded when one is opened.
"""

from __future__ import annotations

import shutil
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from slam.data import StereoFrame
from slam.errors import SequenceError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray
from slam.sequences import rigs
from slam.sequences.base import RecordedSequence, delivered
from slam.sequences.calibration import naming
from slam.sequences.camera_info import rig_from_camera_infos
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given, flag
from slam.sequences.images import Size
from slam.sequences.ros_images import grey_image, naming_recording
from slam.sequences.ros_topics import Topics, choose_topics
from slam.sequences.source import Listing, hardware_tolerance, in_order, in_seconds, pair_listings, require_size

#: Options besides ``kind``.
OPTIONS = frozenset({"left_info", "right_info"})

#: Endings of files, in lower case.
SUFFIXES = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")

_METADATA, _ROS_2, _BEGINNING = "metadata.yaml", b"rosbag2_bagfile_information", 4096

_LATE = 10  # messages in a row that are out of order; more, or the last ones, are of a clock that was set back
_LATEST = 10**9  # [ns] that a message is late; more is a wrong stamp, or the clock


def matches(path: Path) -> bool:
    """Whether a path is a ROS recording by its ending or, for a folder, by its ``metadata.yaml``."""
    if not path.is_dir():
        return path.name.lower().endswith(SUFFIXES) and path.is_file()
    metadata = path / _METADATA
    return metadata.is_file() and (
        any(file.name.endswith(SUFFIXES) for file in path.iterdir()) or _ROS_2 in metadata.read_bytes()[:_BEGINNING]
    )


def open_folder(path: Path, options: Given) -> RecordedSequence:
    """Open a recording; all of it is read once, for the stamps.

    Raises:
        SequenceError: rosbags is not installed, the recording is damaged, or its topics are not found or do not pair.
        CalibrationError: there is no calibration, or an impossible one.
        ConfigurationError: an option has an impossible value.
    """
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        with open_bag(path) as bag:
            topics = choose_topics(bag, options)
            left_all, right_all = (_listing(bag, topic, faults) for topic in (topics.left, topics.right))
            size = _first_size(bag, topics.left)
        ordered = _in_time((left_all, right_all), faults)
        told = options.tolerance()
        tolerance = hardware_tolerance(ordered[0]) if told is None else told
        left, partners = pair_listings(ordered[0], ordered[1], tolerance, faults)
        left, partners, stamps = in_seconds(left, partners, faults)
        rig = _rig(path, topics, size, options)
    rows = np.array([int(name) for name in left.names])
    right_rows = np.array([-1 if name is None else int(name) for name in partners])
    source = RosPairs(stamps, path, left_all, right_all, rows, right_rows, size)
    return RecordedSequence(path.stem, "ros", options.get("kind", "handheld"), rig, source, warnings=warnings)


class Messages(NamedTuple):
    """When the messages of a topic were taken, by their headers, and recorded, in the order of the recording [ns]."""

    topic: str
    stamps: IntArray
    recorded: IntArray

    def seek(self, row: int) -> tuple[int | None, int]:
        """The time from which on to read for a row, and the first row that comes then; None for the beginning."""
        if (np.diff(self.recorded) < 0).any():
            return None, 0
        return int(self.recorded[row]), int(np.searchsorted(self.recorded, self.recorded[row]))


@dataclass(frozen=True, eq=False)
class RosPairs:
    """A frame source: two topics of a recording, already paired.

    Attributes:
        stamps: times (N,) [s], strictly increasing.
        path: of the recording.
        left, right: the messages of the topics.
        left_rows: which of them are the frames (N,).
        right_rows: the same for the right images, -1 where there is none (N,).
        size: width and height that every image must have.
    """

    stamps: Array
    path: Path
    left: Messages
    right: Messages
    left_rows: IntArray
    right_rows: IntArray
    size: Size

    def read(self, start: int, stop: int, faults: FaultLog) -> Iterator[StereoFrame]:
        """Decode frames `start` to `stop`; a damaged left image costs its frame, a right one itself."""
        right_rows = self.right_rows[start:stop]
        with ExitStack() as stack:
            bags = [stack.enter_context(open_bag(self.path)) for _ in range(2)]  # each goes its own way through it
            left = stack.enter_context(closing(self._images(bags[0], self.left, self.left_rows[start:stop])))
            right = stack.enter_context(closing(self._images(bags[1], self.right, right_rows[right_rows >= 0])))
            for index, right_row in zip(range(start, stop), right_rows.tolist()):
                image = next(left, None)
                partner = next(right, None) if right_row >= 0 else None
                if image is None:
                    return
                yield from delivered(index, float(self.stamps[index]), image, partner, faults)

    def _images(
        self, bag: Bag, messages: Messages, rows: IntArray
    ) -> Generator[np.ndarray | SequenceError, None, None]:
        """The images of these rows of a topic; an error in place of one that is damaged."""
        if not len(rows):
            return
        wanted = rows.tolist()
        ahead: dict[int, tuple[str, bytes]] = {}  # read before their turn, where messages are out of order
        expected, due = set(wanted), 0
        since, first = messages.seek(min(wanted))
        for number, (_, kind, raw) in enumerate(bag.messages([messages.topic], since), start=first):
            if number in expected:
                ahead[number] = kind, raw
            while due < len(wanted) and wanted[due] in ahead:
                kind, raw = ahead.pop(wanted[due])
                try:
                    yield bag.image(raw, kind, f"{messages.topic}, message {wanted[due]}", self.size)
                except SequenceError as error:
                    yield error
                due += 1
            if due == len(wanted):
                return


class Bag:
    """An open recording, whatever its kind; every fault of it is a `SequenceError` with its name."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path, self._reader = path, reader
        self.kinds: dict[str, str] = {connection.topic: connection.msgtype for connection in reader.connections}

    def messages(self, topics: list[str], since: int | None = None) -> Generator[tuple[int, str, bytes], None, None]:
        """Time of recording [ns], type and bytes of all messages of some topics, from a time on."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        messages = iter(self._reader.messages(connections, start=since)) if connections else iter(())
        while True:
            with naming_recording(self.path):
                found = next(messages, None)
            if found is None:
                return
            yield int(found[1]), found[0].msgtype, found[2]

    def message(self, raw: bytes, kind: str) -> Any:
        """A message of its bytes."""
        with naming_recording(self.path):
            return self._reader.deserialize(raw, kind)

    def image(self, raw: bytes, kind: str, what: str, size: Size | None = None) -> np.ndarray:
        """The image (H, W) of a message's bytes, see `grey_image`."""
        with naming_recording(self.path):
            return grey_image(self._reader.deserialize(raw, kind), kind, what, size)

    def first(self, topic: str) -> Any:
        """The first message of a topic; None where there is none."""
        with closing(self.messages([topic])) as messages:
            found = next(messages, None)
        return None if found is None else self.message(found[2], found[1])


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a recording, and close it in the end.

    Raises:
        SequenceError: rosbags is not installed, or the recording cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SequenceError(
            f"{path}: ROS recordings are read by the package rosbags: pip install 'surf-stereo-slam[ros]'"
        ) from None
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


def _in_time(topics: tuple[Messages, Messages], faults: FaultLog) -> list[Listing]:
    """The messages of both topics in order of time; the names are their rows.

    Messages out of order are sorted. Where a clock was set back, time goes on as the recording's own clock did, by
    the left topic for both.
    """
    listings, shifts = [], list[int]()
    for messages in topics:
        stamps, found, start = messages.stamps.copy(), list[int](), 1
        while (row := _set_back(stamps, start)) is not None:
            step = int(messages.recorded[row] - messages.recorded[row - 1])
            found.append(step - int(stamps[row] - stamps[row - 1]))
            shift = shifts[len(found) - 1] if len(found) <= len(shifts) else found[-1]
            stamps[row:] += shift
            line = f"{messages.topic}: the clock was set back by {1e-9 * shift:.3f} s at message {row}"
            faults.report("clock", f"{line}; time goes on by the clock of the recording")
            start = row + 1
        shifts = shifts or found
        late = np.maximum.accumulate(stamps) - stamps
        rows = np.flatnonzero(late <= _LATEST)
        rows = rows[np.argsort(stamps[rows], kind="stable")]
        disordered = int(((late > 0) & (late <= _LATEST)).sum())
        if disordered:
            faults.report("order", f"{messages.topic}: {disordered} messages are out of order; sorted by their stamps")
        if len(rows) < len(stamps):
            faults.report(
                "stamps", f"{messages.topic}: {len(stamps) - len(rows)} of {len(stamps)} stamps run backwards; left out"
            )
        listing = Listing(Path(messages.topic), stamps[rows], [str(row) for row in rows.tolist()], True)
        listings.append(in_order(listing, messages.topic, faults))
    return listings


def _set_back(stamps: IntArray, start: int) -> int | None:
    """The first row, from `start` on, from which on a clock is behind what it was, and stays so; None for none."""
    late = stamps < np.maximum.accumulate(stamps)
    begins = np.flatnonzero(late & ~np.concatenate([[False], late[:-1]]))
    ends = np.flatnonzero(late & ~np.concatenate([late[1:], [False]])) + 1
    for first, end in zip(begins.tolist(), ends.tolist()):
        behind, length = stamps[first - 1] - stamps[first], end - first
        # Late messages fill a gap; after a clock was set back there are messages of the same times twice.
        twice = int(((stamps[:first] >= stamps[first]) & (stamps[:first] <= stamps[end - 1])).sum())
        again = length > 1 and 2 * twice >= length
        if first >= start and (again or length > _LATE or (end == len(stamps) and behind > _LATEST)):
            return first
    return None


def _listing(bag: Bag, topic: str, faults: FaultLog) -> Messages:
    """Stamps of all messages of a topic; where their headers hold none, when they were recorded."""
    stamps, recorded = [], []
    for time, kind, raw in bag.messages([topic]):
        message = bag.message(raw, kind)
        with naming_recording(bag.path):
            stamps.append(int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec))
        recorded.append(time)
    if not stamps:
        raise SequenceError(f"{bag.path}: topic {topic} has no messages")
    if not any(stamps):
        faults.report("stamps", f"{topic}: the images have no stamps; the times of recording are taken")
        stamps = recorded
    return Messages(topic, np.array(stamps, np.int64), np.array(recorded, np.int64))


def _first_size(bag: Bag, topic: str) -> Size:
    """Width and height of the first image of a topic that can be read."""
    reason = "no messages"
    for _, kind, raw in bag.messages([topic]):
        try:
            image = bag.image(raw, kind, topic)
        except SequenceError as error:
            reason = str(error)
            continue
        return image.shape[1], image.shape[0]
    raise SequenceError(f"{bag.path}: no image of {topic} can be read: {reason}")


def _rig(path: Path, topics: Topics, size: Size, options: Given) -> StereoRig:
    """The rig by the calibration file that is named, else by the camera messages."""
    if "calibration" in options:
        paths = rigs.calibration_files(path if path.is_dir() else path.parent, options)
        return rigs.read_rig(paths, size, options)
    assert topics.left_info is not None and topics.right_info is not None
    where = Path(topics.info_names)
    rectified = flag(options, "rectified") if "rectified" in options else topics.rectified
    with naming(where):
        rig = rig_from_camera_infos(topics.left_info, topics.right_info, rectified, rigs.metres_per_unit(options))
    require_size(size, rig, where)
    return rig
