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
from slam.sequences.faults import FaultLog
from slam.sequences.images import Size, halves
from slam.sequences.options import Options
from slam.sequences.pairs import Listing, in_order, pair_up
from slam.sequences.rigs import calibration_files, read_rig
from slam.sequences.ros_bag import Bag, open_bag
from slam.sequences.ros_topics import image_topics, rig_of_topics

#: Options besides those of all formats.
OPTIONS = frozenset({"left_info", "right_info"})

#: Endings of files, in lower case.
SUFFIXES = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")

_METADATA, _ROS_2, _BEGINNING = "metadata.yaml", b"rosbag2_bagfile_information", 4096

_LATEST = 10**9  # [ns] that a message is late; more is a wrong stamp, or the clock
_AROUND = 5  # messages whose median says how far the recording's clock is ahead of the camera's


def matches_folder(path: Path) -> bool:
    """Whether a path is a ROS recording by its ending or, for a folder, by its ``metadata.yaml``."""
    if not path.is_dir():
        return path.name.lower().endswith(SUFFIXES) and path.is_file()
    metadata = path / _METADATA
    return metadata.is_file() and (
        any(file.name.endswith(SUFFIXES) for file in path.iterdir()) or _ROS_2 in metadata.read_bytes()[:_BEGINNING]
    )


def open_folder(path: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """Open a recording; all of it is read once, for the stamps."""
    with open_bag(path) as bag:
        topics = image_topics(bag, options)
        messages = [_stamps(bag, topic, faults) for topic in topics]
        image = bag.first_image(topics[0])
        one = image if len(topics) == 2 else halves(image, topics[0])[0]
        size = one.shape[1], one.shape[0]
        if "calibration" in options:
            home = path if path.is_dir() else path.parent
            rig = read_rig(calibration_files(home, options), size, options)
        else:
            rig = rig_of_topics(bag, topics, size, options)
    left, *right = _in_time(messages, faults)
    pairs = pair_up(left, right[0] if right else None, options, faults)
    rows = [np.array([*listing.names, -1], int)[pairs.rows[:, side]] for side, listing in enumerate([left, *right])]
    source = RosPairs(pairs.stamps, path, messages, np.stack(rows, axis=1), (image.shape[1], image.shape[0]))
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
        ahead: dict[tuple[str, int], bytes] = {}  # read before their turn, where messages are out of order
        recorded = {m.topic: m.recorded for m in self.topics}
        since, counts = None, dict.fromkeys(recorded, 0)  # where to begin, and each topic's first row there
        if all((np.diff(times) >= 0).all() for times in recorded.values()):
            since = min(int(recorded[topic][row]) for topic, row in wanted)
            counts = {topic: int(np.searchsorted(times, since)) for topic, times in recorded.items()}
        with open_bag(self.path) as bag:
            messages = bag.messages(counts, since)
            for frame in frames:
                while not all(place in ahead for place in frame):
                    topic, _, data = next(messages, ("", 0, b""))
                    if not topic:
                        return
                    place = topic, counts[topic]
                    counts[topic] += 1
                    if place in wanted:
                        ahead[place] = data
                images = [self._image(bag, ahead.pop(place), place) for place in frame]
                yield *images, *[None] * (len(self.topics) - len(images))

    def _image(self, bag: Bag, data: bytes, place: tuple[str, int]) -> np.ndarray | SequenceError:
        try:
            return bag.image(place[0], data, f"{place[0]}, message {place[1]}", self.size)
        except SequenceError as error:
            return error


def _in_time(topics: list[Messages], faults: FaultLog) -> list[Listing]:
    """The messages of both topics in order of time; the names are their rows.

    Messages out of order are sorted, and those with wrong stamps left out. Where a clock was set back, time goes on as
    the recording's own clock did, by the left topic for both.
    """
    listings, shifts = [], list[int]()
    for topic, taken, recorded in topics:
        rows = np.arange(len(taken))
        steps = np.abs(np.diff(taken))
        ahead = recorded - taken
        usual = np.array([_usual(ahead, row - _AROUND // 2) for row in rows.tolist()])
        rows = rows[np.abs(ahead - usual) <= max(_LATEST, _AROUND * (np.median(steps) if len(steps) else 0))]
        stamps, ahead, found = taken[rows], ahead[rows], list[int]()
        latest, start = -np.inf, 0
        for at in (np.flatnonzero(np.diff(stamps) < 0) + 1).tolist():
            latest, start = max(latest, stamps[start:at].max()), at
            shift = round(_usual(ahead, at) - _usual(ahead, at - _AROUND))
            if 2 * shift > latest - stamps[at] > 0 and (len(rows) - at > _AROUND // 2 or shift > _LATEST):
                found.append(shift)
                shift = shifts[len(found) - 1] if len(found) <= len(shifts) else shift
                stamps[at:] += shift
                ahead[at:] -= shift
                line = f"{topic}: the clock was set back by {1e-9 * shift:.3f} s at message {rows[at]}"
                faults.report("clock", f"{line}; time goes on by the clock of the recording")
        shifts = shifts or found
        late = int((stamps < np.maximum.accumulate(stamps)).sum())
        if late:
            faults.report("order", f"{topic}: {late} messages are out of order; sorted by their stamps")
        if len(rows) < len(taken):
            line = f"{topic}: {len(taken) - len(rows)} of {len(taken)} stamps are far from when they were recorded"
            faults.report("stamps", f"{line}; left out")
        order = np.argsort(stamps, kind="stable")
        listing = Listing(Path(topic), stamps[order], [str(row) for row in rows[order].tolist()], True)
        listings.append(in_order(listing, topic, faults))
    return listings


def _usual(ahead: IntArray, start: int) -> float:
    """How far the recording's clock usually is ahead of the stamps, in a few messages from `start` on [ns]."""
    return float(np.median(ahead[max(0, start) : start + _AROUND]))


def _stamps(bag: Bag, topic: str, faults: FaultLog) -> Messages:
    """Stamps of all messages of a topic; where their headers hold none, when they were recorded."""
    stamps, recorded = [], []
    for _, time, data in bag.messages([topic]):
        stamp = bag.read(topic, data).header.stamp
        stamps.append(int(stamp.sec) * 10**9 + int(stamp.nanosec))
        recorded.append(time)
    if not stamps:
        raise SequenceError(f"{bag.path}: topic {topic} has no messages")
    if not any(stamps):
        faults.report("stamps", f"{topic}: the images have no stamps; the times of recording are taken")
        stamps = recorded
    return Messages(topic, np.array(stamps, np.int64), np.array(recorded, np.int64))
