"""ROS recordings as sequences: ``.bag`` files of ROS 1, folders, ``.mcap`` and ``.db3`` files of ROS 2.

They are read by the package rosbags, which is loaded when one is opened.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.geometry.rig import StereoRig
from slam.geometry.stamps import IntArray
from slam.naming import suggestion
from slam.sequences.base import FaultLog, Images, RecordedSequence, attempt
from slam.sequences.calibration import Entries, naming
from slam.sequences.images import Size, both
from slam.sequences.names import SIDES
from slam.sequences.options import Options
from slam.sequences.pairs import Listing, in_order, pair_up
from slam.sequences.rigs import calibration_files, read_rig, rig_of
from slam.sequences.ros_bag import COMPRESSED, DEPTH, INFO, RAW, Bag, open_bag

#: Endings of files, in lower case.
SUFFIXES = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")

_LATEST = 10**9  # [ns] that a message is late; more is a wrong stamp, or the clock
_AROUND = 5  # messages whose median says how far the recording's clock is ahead of the camera's
_SAME_PLACE = 1e-6  # [m] from a pair's left camera
_LISTED = 12  # topics named in a message


def matches_folder(path: Path) -> bool:
    """Whether a path is a ROS recording by its ending or, for a folder, by its ``metadata.yaml``."""
    if not path.is_dir():
        return path.name.lower().endswith(SUFFIXES) and path.is_file()
    return (path / "metadata.yaml").is_file() and any(file.name.endswith(SUFFIXES) for file in path.iterdir())


def open_folder(path: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """Open a recording; all of it is read once, for the stamps."""
    with open_bag(path) as bag:
        topics = _image_topics(bag, options)
        read = [_stamps(bag, topic, faults) for topic in topics]
        image = bag.first_image(topics[0])
        size = both([image] * len(topics), topics[0])[0].shape[::-1]
        if "calibration" in options or len(topics) == 1:
            rig = read_rig(calibration_files(path if path.is_dir() else path.parent, options), size, options)
        else:
            rig = _rig_of_topics(bag, topics, size, options)
    sides, back = [], list[int]()
    for topic, (taken, recorded) in zip(topics, read):
        listing, found = _in_time(topic, taken, recorded, back, faults)
        sides.append(listing)
        back = back or found
    pairs = pair_up(sides, options, faults)
    rows = [np.array([*side.names, -1], int)[own] for side, own in zip(sides, pairs.rows.T)]
    clocks = {topic: times for topic, (_, times) in zip(topics, read)}
    decode = partial(_decode, path, clocks, np.stack(rows, axis=1), image.shape[::-1])
    return RecordedSequence(path.stem, "ros", options.get("kind", "handheld"), rig, pairs.stamps, decode)


def _decode(
    path: Path, recorded: dict[str, IntArray], rows: IntArray, size: Size, start: int, stop: int, faults: FaultLog
) -> Images:
    """The images of the messages `rows` (N, 1 or 2) of the topics, -1 for none, with times of recording [ns]."""
    frames = [
        [(topic, row) if row >= 0 else None for topic, row in zip(recorded, frame)]
        for frame in rows[start:stop].tolist()
    ]
    wanted = {place for frame in frames for place in frame if place}
    since, counts = None, dict.fromkeys(recorded, 0)  # where to begin, and each topic's first row there
    if all((np.diff(times) >= 0).all() for times in recorded.values()):
        since = min(int(recorded[topic][row]) for topic, row in wanted)
        counts = {topic: int(np.searchsorted(times, since)) for topic, times in recorded.items()}
    ahead: dict[tuple[str, int], bytes] = {}  # read before their turn, where messages are out of order
    with open_bag(path) as bag:
        messages = bag.messages(counts, since)
        for frame in frames:
            while not all(place in ahead for place in frame if place):
                topic, _, data = next(messages, ("", 0, b""))
                if not topic:
                    return
                if (topic, counts[topic]) in wanted:
                    ahead[topic, counts[topic]] = data
                counts[topic] += 1
            yield tuple(
                None if place is None else attempt(bag.image, *place, ahead.pop(place), size) for place in frame
            )


def _stamps(bag: Bag, topic: str, faults: FaultLog) -> tuple[IntArray, IntArray]:
    """When a topic's messages were taken, by their headers or, without stamps there, as recorded; and recorded [ns]."""
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
    return np.array(stamps, np.int64), np.array(recorded, np.int64)


def _in_time(
    topic: str, taken: IntArray, recorded: IntArray, back: list[int], faults: FaultLog
) -> tuple[Listing, list[int]]:
    """The messages of a topic in order of time, their rows as names, and by how much its clock was set back [ns].

    Messages out of order are sorted, and those with wrong stamps left out. Where a clock was set back, time goes on as
    the recording's own clock did, by what the left topic's was set `back` for both.
    """
    steps, ahead = np.abs(np.diff(taken)), recorded - taken
    usual = np.array([_usual(ahead, row - _AROUND // 2) for row in range(len(taken))])
    rows = np.flatnonzero(np.abs(ahead - usual) <= max(_LATEST, _AROUND * (np.median(steps) if len(steps) else 0)))
    stamps, ahead, found = taken[rows], ahead[rows], list[int]()
    for at in (np.flatnonzero(np.diff(stamps) < 0) + 1).tolist():
        shift = round(_usual(ahead, at) - _usual(ahead, at - _AROUND))
        if 2 * shift > stamps[:at].max() - stamps[at] > 0 and (len(rows) - at > _AROUND // 2 or shift > _LATEST):
            found.append(shift)
            shift = back[len(found) - 1] if len(found) <= len(back) else shift
            stamps[at:] += shift
            ahead[at:] -= shift
            line = f"{topic}: the clock was set back by {1e-9 * shift:.3f} s at message {rows[at]}"
            faults.report("clock", f"{line}; time goes on by the clock of the recording")
    late = int((stamps < np.maximum.accumulate(stamps)).sum())
    if late:
        faults.report("order", f"{topic}: {late} messages are out of order; sorted by their stamps")
    if len(rows) < len(taken):
        line = f"{topic}: {len(taken) - len(rows)} of {len(taken)} stamps are far from when they were recorded"
        faults.report("stamps", f"{line}; left out")
    order = np.argsort(stamps, kind="stable")
    listing = Listing(Path(topic), stamps[order], [str(row) for row in rows[order].tolist()], True)
    return in_order(listing, topic, faults), found


def _usual(ahead: IntArray, start: int) -> float:
    """How far the recording's clock usually is ahead of the stamps, in a few messages from `start` on [ns]."""
    return float(np.median(ahead[max(0, start) : start + _AROUND]))


def _image_topics(bag: Bag, options: Mapping[str, Any]) -> list[str]:
    """The topics of left and right images, or the one of both side by side, by options or those of the only pair."""
    sides = ("left",) if options.get("layout") is not None else ("left", "right")
    there = bag.topics(RAW, COMPRESSED)
    if any(side in options for side in sides):
        if not all(side in options for side in sides):
            raise ConfigurationError("name both topics: left=/…&right=/…")
        named = [options[side] for side in sides]
        for topic in named:
            if topic not in there:
                what = f"it holds {bag.kinds[topic]}" if topic in bag.kinds else "there is none"
                hint = f"{what}{suggestion(topic, there)}; there are {_listed(there)}"
                raise SequenceError(f"{bag.path}: topic {topic}: {hint}")
        if len(sides) > len(set(named)):
            raise ConfigurationError(f"left and right are the same topic, {named[0]}")
        return named
    if not there:
        raise SequenceError(f"{bag.path}: no images; its topics are {_listed(sorted(bag.kinds))}")
    cameras = _cameras(bag)
    if sides == ("left",):
        if len(cameras) != 1:
            line = f"{len(cameras)} topics of images, where layout=sbs needs one: add left=/… of {_listed(cameras)}"
            raise SequenceError(f"{bag.path}: {line}")
        return cameras
    pairs = _pairs_by_name(cameras) if "calibration" in options else _pairs_by_messages(bag, cameras)
    if len(pairs) > 1:
        found = "; ".join("left={}&right={}".format(*pair) for pair in pairs[:3])
        raise SequenceError(f"{bag.path}: several stereo pairs, choose one: {found}")
    if not pairs:
        raise SequenceError(
            f"{bag.path}: its camera messages name no stereo pair: add left=/…&right=/… of {_listed(there)}, "
            "and calibration=FILE where the cameras are not calibrated"
        )
    return list(pairs[0])


def _rig_of_topics(bag: Bag, images: list[str], size: Size, options: Mapping[str, Any]) -> StereoRig:
    """The rig by the CameraInfo messages of the images, of a size: of the rectified images, or of the raw ones."""
    topics = [f"{_split(topic)[0]}/camera_info" for topic in images]
    for topic, image in zip(topics, images):
        if bag.kinds.get(topic) != INFO:
            there = _listed(bag.topics(INFO))
            raise CalibrationError(f"{bag.path}: no {topic} for {image} (there are {there}): add calibration=FILE")
    infos, where = [bag.camera_info(topic) for topic in topics], Path(" and ".join(topics))
    rectified = options.get("rectified", all("rect" in _split(topic)[1] for topic in images))
    with naming(where):
        for side, info in zip(("left", "right"), infos):
            if not (info["p"][1][0] > 0 and info["k"][1][0] > 0):
                raise CalibrationError(f"the {side} camera is not calibrated: K or P is zero")
        if infos[0]["size"][1] != infos[1]["size"][1]:
            raise CalibrationError("the images of the two cameras differ in size")
    return rig_of(Entries(infos), where, size, {**options, "rectified": rectified})


def _pairs_by_messages(bag: Bag, images: list[str]) -> list[tuple[str, str]]:
    """Cameras of one size and focal length whose CameraInfo has a baseline in the right one's projection."""
    cameras: dict[str, tuple[str, object, float]] = {}  # by name space: topic, what is equal in a pair, place [m]
    for topic in images:
        space = _split(topic)[0]
        name = f"{space}/camera_info"
        if space not in cameras and bag.kinds.get(name) == INFO and bag.first(name) is not None:
            info = bag.camera_info(name)
            P = info["p"][1]  # fx, 0, cx, -fx times its place, …
            if P[0] > 0:
                cameras[space] = topic, (info["size"][1], P[0]), -P[3] / P[0]
    return [
        (left, right)
        for left, a, at_left in cameras.values()
        for right, b, at_right in cameras.values()
        if a == b and abs(at_left) < _SAME_PLACE and at_right > _SAME_PLACE
    ]


def _pairs_by_name(images: list[str]) -> list[tuple[str, str]]:
    """Pairs of topics of images that differ in one of the usual names for left and right, one of each two cameras."""
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for topic in images:
        for names in SIDES:
            other = topic.replace(*names)
            if other != topic and other in images:
                spaces = _split(topic)[0], _split(other)[0]
                found.setdefault(spaces if spaces[0] != spaces[1] else (topic, other), (topic, other))
    return list(found.values())


def _cameras(bag: Bag) -> list[str]:
    """Topics of images, not of depth, in the order in which they are taken: rectified, raw, and grey ones first."""

    def order(topic: str) -> tuple[bool, ...]:
        name = _split(topic)[1]
        return "rect" not in name, bag.kinds[topic] == COMPRESSED, "color" in name

    def depth(topic: str) -> bool:
        message = bag.first(topic)
        packed = bag.kinds[topic] == COMPRESSED
        return message is None or ("compressedDepth" in topic if packed else message.encoding in DEPTH)

    return sorted((topic for topic in bag.topics(RAW, COMPRESSED) if not depth(topic)), key=order)


def _split(topic: str) -> tuple[str, str]:
    """The name space of a camera's topic, and its last name without what names its compression."""
    space, _, last = topic.rpartition("/")
    space, _, last = space.rpartition("/") if last.startswith("compressed") else (space, "", last)
    return space, last


def _listed(topics: list[str]) -> str:
    more = f", … ({len(topics)})" if len(topics) > _LISTED else ""
    return (", ".join(topics[:_LISTED]) or "none") + more
