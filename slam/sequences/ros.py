"""ROS recordings as sequences: ``.bag`` files of ROS 1, folders, ``.mcap`` and ``.db3`` files of ROS 2.

They are read by the package rosbags (``pip install 'surf-stereo-slam[ros]'``), loaded when one is opened.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import SequenceError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray
from slam.sequences import rigs
from slam.sequences.base import Images, RecordedSequence
from slam.sequences.calibration import naming
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given, flag
from slam.sequences.images import Size, halved
from slam.sequences.ros_bag import Bag, naming_recording, open_bag
from slam.sequences.ros_topics import Topics, choose_topics, rig_from_camera_infos
from slam.sequences.source import Listing, hardware_tolerance, in_order, in_seconds, pair_listings, require_size

#: Options besides ``kind``.
OPTIONS = frozenset({"left_info", "right_info"})

#: Endings of files, in lower case.
SUFFIXES = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")

_METADATA, _ROS_2, _BEGINNING = "metadata.yaml", b"rosbag2_bagfile_information", 4096

_LATE = 10  # messages in a row that are out of order; more, or the last ones, are of a clock that was set back
_LATEST = 10**9  # [ns] that a message is late; more is a wrong stamp, or the clock


def matches_folder(path: Path) -> bool:
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
            messages = [_listing(bag, topic, faults) for topic in dict.fromkeys((topics.left, topics.right))]
            size = _first_size(bag, topics.left)
        left, *right = _in_time(messages, faults)
        partners: list[str | None] = [None] * len(left)
        if right:
            told = options.tolerance()
            tolerance = hardware_tolerance(left) if told is None else told
            left, partners = pair_listings(left, right[0], tolerance, faults)
        left, partners, stamps = in_seconds(left, partners, faults)
        rig = _rig(path, topics, size if right else halved(size, topics.left), options)
    rows = np.array([int(name) for name in left.names])
    right_rows = np.array([-1 if name is None else int(name) for name in partners])
    source = RosPairs(stamps, path, messages[0], messages[-1], rows, right_rows, size)
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
        left, right: the messages of the topics; the same of images that are side by side in one.
        left_rows: which of them are the frames (N,).
        right_rows: the same for the right images, -1 where there is none (N,).
        size: width and height that every message's image must have.
    """

    stamps: Array
    path: Path
    left: Messages
    right: Messages
    left_rows: IntArray
    right_rows: IntArray
    size: Size

    @property
    def halves(self) -> bool:
        """Both images are in one topic."""
        return self.right is self.left

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the images of frames `start` to `stop`; an error in place of one that is damaged."""
        right_rows = self.right_rows[start:stop]
        with ExitStack() as stack:
            bags = [stack.enter_context(open_bag(self.path)) for _ in range(2)]  # each goes its own way through it
            left = stack.enter_context(closing(self._images(bags[0], self.left, self.left_rows[start:stop])))
            right = stack.enter_context(closing(self._images(bags[1], self.right, right_rows[right_rows >= 0])))
            for image, right_row in zip(left, right_rows.tolist()):
                yield image, next(right, None) if right_row >= 0 else None

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


def _in_time(topics: list[Messages], faults: FaultLog) -> list[Listing]:
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
