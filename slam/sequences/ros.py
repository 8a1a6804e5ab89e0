"""ROS recordings as sequences: ``.bag`` files of ROS 1, folders, ``.mcap`` and ``.db3`` files of ROS 2.

They are read by the package rosbags (``pip install 'surf-stereo-slam[ros]'``), loaded when one is opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import SequenceError
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray
from slam.sequences.base import Images, RecordedSequence
from slam.sequences.calibration import naming
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given, flag, metres_per_unit
from slam.sequences.images import Size, halves
from slam.sequences.pairs import Listing, distinct, in_order, pair_up
from slam.sequences.rigs import calibration_files, read_rig, require_size
from slam.sequences.ros_bag import (
    Bag,
    Message,
    camera_info,
    choose_topics,
    is_rectified,
    open_bag,
    rig_by_messages,
)  # fmt: skip

#: Options besides those of all formats.
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


def open_folder(path: Path, options: Given, faults: FaultLog) -> RecordedSequence:
    """Open a recording; all of it is read once, for the stamps."""
    with open_bag(path) as bag:
        topics = choose_topics(bag, options)
        infos = [camera_info(bag, topic) for topic in topics.infos]
        messages = [_stamps(bag, topic, faults) for topic in dict.fromkeys(topics.images)]
        image = bag.first_image(topics.images[0])
    left, *right = _in_time(messages, faults)
    pairs = distinct(pair_up(left, right[0] if right else None, options, faults), faults)
    one = image if right else halves(image, topics.images[0])[0]
    size = one.shape[1], one.shape[0]
    if "calibration" in options:
        rig = read_rig(calibration_files(path if path.is_dir() else path.parent, options), size, options)
    else:
        where = Path(" and ".join(topics.infos))
        rectified = flag(options, "rectified") if "rectified" in options else all(map(is_rectified, topics.images))
        with naming(where):
            rig = rig_by_messages(infos, rectified, metres_per_unit(options))
        require_size(size, rig, where)
    rows = np.array([[-1 if row is None else int(row) for row in n] for n in (pairs.left.names, pairs.partners)])
    source = RosPairs(pairs.stamps, path, messages, rows[: len(messages)].T, (image.shape[1], image.shape[0]))
    return RecordedSequence(path.stem, "ros", options.get("kind", "handheld"), rig, source)


class Messages(NamedTuple):
    """When the messages of a topic were taken, by their headers, and recorded, in the order of the recording [ns]."""

    topic: str
    stamps: IntArray
    recorded: IntArray


@dataclass(frozen=True, eq=False)
class RosPairs:
    """A frame source: two topics of a recording, already paired, or one with images side by side."""

    stamps: Array  # times (N,) [s], strictly increasing
    path: Path  # of the recording
    topics: list[Messages]  # of the left and the right images; one of images that are side by side
    rows: IntArray  # which messages of each topic are the frames, -1 for none (N, 1 or 2)
    size: Size  # width and height that every message's image must have

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the images of frames `start` to `stop`; an error in place of one that is damaged."""
        frames = [
            [(m.topic, row) for m, row in zip(self.topics, rows) if row >= 0] for rows in self.rows[start:stop].tolist()
        ]
        wanted = {place for frame in frames for place in frame}
        ahead: dict[tuple[str, int], Message] = {}  # read before their turn, where messages are out of order
        recorded = {m.topic: m.recorded for m in self.topics}
        since, counts = None, dict.fromkeys(recorded, 0)  # where to begin, and each topic's first row there
        if all((np.diff(times) >= 0).all() for times in recorded.values()):
            since = min(int(recorded[topic][row]) for topic, row in wanted)
            counts = {topic: int(np.searchsorted(times, since)) for topic, times in recorded.items()}
        with open_bag(self.path) as bag:
            messages = bag.messages(counts, since)
            for frame in frames:
                while not all(place in ahead for place in frame):
                    message = next(messages, None)
                    if message is None:
                        return
                    place = message.topic, counts[message.topic]
                    counts[message.topic] += 1
                    if place in wanted:
                        ahead[place] = message
                images = [self._image(bag, ahead.pop(place), place) for place in frame]
                if len(self.topics) == 1 and isinstance(images[0], np.ndarray):
                    images = list(halves(images[0], self.topics[0].topic))
                yield images[0], images[1] if len(images) > 1 else None

    def _image(self, bag: Bag, message: Message, place: tuple[str, int]) -> np.ndarray | SequenceError:
        try:
            return bag.image(message, f"{place[0]}, message {place[1]}", self.size)
        except SequenceError as error:
            return error


def _in_time(topics: list[Messages], faults: FaultLog) -> list[Listing]:
    """The messages of both topics in order of time; the names are their rows.

    Messages out of order are sorted. Where a clock was set back, time goes on as the recording's own clock did, by
    the left topic for both.
    """
    listings, shifts = [], list[int]()
    for topic, stamps, recorded in topics:
        stamps, found, start = stamps.copy(), list[int](), 1
        while (row := _set_back(stamps, start)) is not None:
            found.append(int(recorded[row] - recorded[row - 1] - stamps[row] + stamps[row - 1]))
            shift = shifts[len(found) - 1] if len(found) <= len(shifts) else found[-1]
            stamps[row:] += shift
            line = f"{topic}: the clock was set back by {1e-9 * shift:.3f} s at message {row}"
            faults.report("clock", f"{line}; time goes on by the clock of the recording")
            start = row + 1
        shifts = shifts or found
        late = np.maximum.accumulate(stamps) - stamps
        rows = np.flatnonzero(late <= _LATEST)
        rows = rows[np.argsort(stamps[rows], kind="stable")]
        disordered, wrong = int(((late > 0) & (late <= _LATEST)).sum()), len(stamps) - len(rows)
        if disordered:
            faults.report("order", f"{topic}: {disordered} messages are out of order; sorted by their stamps")
        if wrong:
            faults.report("stamps", f"{topic}: {wrong} of {len(stamps)} stamps run backwards; left out")
        listing = Listing(Path(topic), stamps[rows], [str(row) for row in rows.tolist()], True)
        listings.append(in_order(listing, topic, faults))
    return listings


def _set_back(stamps: IntArray, start: int) -> int | None:
    """The first row, from `start` on, from which on a clock is behind what it was, and stays so; None for none."""
    late = stamps < np.maximum.accumulate(stamps)
    edges = np.flatnonzero(np.diff(late, prepend=False, append=False)).reshape(-1, 2)
    for first, end in edges.tolist():
        behind, length = stamps[first - 1] - stamps[first], end - first
        # Late messages fill a gap; after a clock was set back there are messages of the same times twice.
        twice = int(((stamps[:first] >= stamps[first]) & (stamps[:first] <= stamps[end - 1])).sum())
        again = length > 1 and 2 * twice >= length
        if first >= start and (again or length > _LATE or (end == len(stamps) and behind > _LATEST)):
            return int(first)
    return None


def _stamps(bag: Bag, topic: str, faults: FaultLog) -> Messages:
    """Stamps of all messages of a topic; where their headers hold none, when they were recorded."""
    stamps, recorded = [], []
    for message in bag.messages([topic]):
        stamp = bag.read(message).header.stamp
        stamps.append(int(stamp.sec) * 10**9 + int(stamp.nanosec))
        recorded.append(message.time)
    if not stamps:
        raise SequenceError(f"{bag.path}: topic {topic} has no messages")
    if not any(stamps):
        faults.report("stamps", f"{topic}: the images have no stamps; the times of recording are taken")
        stamps = recorded
    return Messages(topic, np.array(stamps, np.int64), np.array(recorded, np.int64))
