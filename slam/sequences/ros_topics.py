"""Which topics of a ROS recording are the two cameras, and the rig that they describe."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.geometry.rig import StereoRig
from slam.naming import suggestion
from slam.sequences.calibration import Entries, naming
from slam.sequences.images import Size
from slam.sequences.names import SIDES
from slam.sequences.rigs import require_size, rig_of
from slam.sequences.ros_bag import COMPRESSED, DEPTH, INFO, RAW, Bag

_SAME_PLACE = 1e-6  # [m] from a pair's left camera
_LISTED = 12  # topics named in a message


def image_topics(bag: Bag, options: Mapping[str, Any]) -> list[str]:
    """The topics of the left and the right images by options, or those of the only pair; one of both side by side.

    A pair are two cameras whose messages say so: the same size and focal length of the rectified images, and a baseline
    in the right one's projection. Depth images do not count. Where a calibration is named, names decide.

    SequenceError where a topic is not there, or there is not exactly one pair; ConfigurationError where one of the two
    is named and the other is not, or both are the same.
    """
    sides = ("left",) if options.get("layout") is not None else ("left", "right")
    if any(side in options for side in sides):
        if not all(side in options for side in sides):
            raise ConfigurationError("name both topics: left=/…&right=/…")
        named = [_named(bag, options[side], RAW, COMPRESSED) for side in sides]
        if len(sides) > len(set(named)):
            raise ConfigurationError(f"left and right are the same topic, {named[0]}")
        return named
    there = bag.topics(RAW, COMPRESSED)
    if not there:
        raise SequenceError(f"{bag.path}: no images; its topics are {_listed(sorted(bag.kinds))}")
    if sides == ("left",):
        cameras = _cameras(bag)
        if len(cameras) != 1:
            line = f"{len(cameras)} topics of images, where layout=sbs needs one: add left=/… of {_listed(cameras)}"
            raise SequenceError(f"{bag.path}: {line}")
        return cameras
    pairs = _pairs_by_name(bag) if "calibration" in options else _pairs_by_messages(bag)
    if len(pairs) > 1:
        found = "; ".join("left={}&right={}".format(*pair) for pair in pairs[:3])
        raise SequenceError(f"{bag.path}: several stereo pairs, choose one: {found}")
    if not pairs:
        raise SequenceError(
            f"{bag.path}: its camera messages name no stereo pair: add left=/…&right=/… of {_listed(there)}, "
            "and calibration=FILE where the cameras are not calibrated"
        )
    return list(pairs[0])


def rig_of_topics(bag: Bag, images: list[str], size: Size, options: Mapping[str, Any]) -> StereoRig:
    """The rig by the CameraInfo messages of the images, of a size: of the rectified images, or of the raw ones.

    CalibrationError where there are none, a camera is not calibrated, or not as one of a pair, or the rig is
    impossible; SequenceError where it is for images of another size.
    """
    topics = []
    for side, topic in zip(("left", "right"), images * (3 - len(images))):
        usual = f"{_split(topic)[0]}/camera_info"
        if f"{side}_info" in options:
            topics.append(_named(bag, options[f"{side}_info"], INFO))
        elif bag.kinds.get(usual) == INFO:
            topics.append(usual)
        else:
            there = f"add {side}_info=/… (there are {_listed(bag.topics(INFO))}) or calibration=FILE"
            raise CalibrationError(f"{bag.path}: no {usual} for {topic}: {there}")
    infos, where = [bag.camera_info(topic) for topic in topics], Path(" and ".join(topics))
    rectified = options.get("rectified", all("rect" in _split(topic)[1] for topic in images))
    with naming(where):
        for side, info in zip(("left", "right"), infos):
            if not (info["projectionmatrix"][1][0, 0] > 0 and info["cameramatrix"][1][0, 0] > 0):
                raise CalibrationError(f"the {side} camera is not calibrated: K or P is zero")
        if infos[0]["size"][1] != infos[1]["size"][1]:
            raise CalibrationError("the images of the two cameras differ in size")
        rig = rig_of(Entries(infos), infos[0]["size"][1], options.get("unit", 1.0), rectified, False)
    require_size(size, rig, where)
    return rig


def _pairs_by_messages(bag: Bag) -> list[tuple[str, str]]:
    """All pairs of cameras whose CameraInfo says that they are one."""
    cameras: dict[str, tuple[str, object, float]] = {}  # by name space: topic, what is equal in a pair, place [m]
    for topic in _cameras(bag):
        space = _split(topic)[0]
        name = f"{space}/camera_info"
        if space not in cameras and bag.kinds.get(name) == INFO and bag.first(name) is not None:
            info = bag.camera_info(name)
            P = info["projectionmatrix"][1]
            if P[0, 0] > 0:
                cameras[space] = topic, (info["size"][1], P[0, 0]), -P[0, 3] / P[0, 0]
    return [
        (left, right)
        for left, a, at_left in cameras.values()
        for right, b, at_right in cameras.values()
        if a == b and abs(at_left) < _SAME_PLACE and at_right > _SAME_PLACE
    ]


def _pairs_by_name(bag: Bag) -> list[tuple[str, str]]:
    """Pairs of topics of images that differ in one of the usual names for left and right, one of each two cameras."""
    images = _cameras(bag)
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for topic in images:
        for names in SIDES:
            other = topic.replace(*names)
            if other != topic and other in images:
                spaces = _split(topic)[0], _split(other)[0]
                found.setdefault(spaces if spaces[0] != spaces[1] else (topic, other), (topic, other))
    return list(found.values())


def _named(bag: Bag, topic: str, *kinds: str) -> str:
    """A topic that must be there, and of one of these types."""
    known = bag.topics(*kinds)
    if topic not in known:
        there = f"it holds {bag.kinds[topic]}" if topic in bag.kinds else "there is none"
        raise SequenceError(f"{bag.path}: topic {topic}: {there}{suggestion(topic, known)}; there are {_listed(known)}")
    return topic


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
