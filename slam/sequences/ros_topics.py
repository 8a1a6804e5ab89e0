"""Which topics of a ROS recording are the two cameras of a stereo rig, and the rig by their CameraInfo messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.naming import suggestion
from slam.sequences.calibration import array, naming
from slam.sequences.calibration_keys import Entries, rig_of
from slam.sequences.given import layout_of
from slam.sequences.names import SIDES
from slam.sequences.ros_bag import COMPRESSED, DEPTH, RAW, Bag, naming_recording

_INFO = "sensor_msgs/msg/CameraInfo"
_IMAGES = (RAW, COMPRESSED)
_SAME_PLACE = 1e-6  # [m] from a pair's left camera
_LISTED = 12  # topics named in a message


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """A CameraInfo message of ROS 1 or 2."""

    size: tuple[int, int]  # width and height [px]
    model: str  # name of the distortion model
    K: Array  # camera matrix (3, 3) of the raw image
    D: Array  # its distortion coefficients
    R: Array  # rotation (3, 3) from raw to rectified camera axes
    P: Array  # projection (3, 4) of the rectified image; ``P[0, 3] = -fx B`` of the right camera of a pair

    @classmethod
    def read(cls, recording: Bag, topic: str) -> CameraInfo:
        """The first message of a topic, of ROS 1, which writes matrices in capitals, or 2.

        Raises:
            CalibrationError: there is none, it holds what no calibration holds, or only a part of the image is given.
        """
        message = recording.first(topic)
        if message is None:
            raise CalibrationError(f"{recording.path}: topic {topic} has no messages")
        with naming_recording(recording.path), naming(Path(topic)):
            shapes = {"K": (3, 3), "D": None, "R": (3, 3), "P": (3, 4)}
            matrices = {
                n: array(getattr(message, n, getattr(message, n.lower(), None)), n, s) for n, s in shapes.items()
            }
            size = int(message.width), int(message.height)
            roi = int(message.roi.width), int(message.roi.height)
            if max(int(message.binning_x), int(message.binning_y)) > 1 or roi not in ((0, 0), size):
                raise CalibrationError("binning and regions of interest are not supported")
            return cls(size, str(message.distortion_model), **matrices)

    @property
    def baseline_term(self) -> float:
        """``-P[0, 3] / P[0, 0]``: how far the camera stands to the right of the pair's left one [m]; NaN for no P."""
        return float(-self.P[0, 3] / self.P[0, 0]) if self.P[0, 0] > 0 else float("nan")


def rig_from_camera_infos(infos: Sequence[CameraInfo], rectified: bool, unit: float = 1.0) -> StereoRig:
    """The rig of the rectified or of the raw images; the baseline in ``P`` is in units of so many metres.

    Raises:
        CalibrationError: a camera is not calibrated, or not as one of a pair; or the rig is impossible.
    """
    for side, info in zip(("left", "right"), infos):
        if not (info.P[0, 0] > 0 and info.K[0, 0] > 0):
            raise CalibrationError(f"the {side} camera is not calibrated: K or P is zero")
    if infos[0].size != infos[1].size:
        raise CalibrationError("the images of the two cameras differ in size")
    names = "cameramatrix", "distcoeffs", "rectificationmatrix", "projectionmatrix", "distortionmodel", "size"
    files = [dict(zip(names, zip(names, (i.K, i.D, i.R, i.P, i.model, i.size)))) for i in infos]
    return rig_of(Entries(files), infos[0].size, unit, rectified, False)


@dataclass(frozen=True, eq=False)
class Topics:
    """The topics of a stereo rig."""

    left: str  # of the images; the same where they are side by side
    right: str
    infos: tuple[CameraInfo, ...] = ()  # the cameras' calibrations; none where a file is named in their place
    info_names: str = ""  # the topics of these

    @property
    def rectified(self) -> bool:
        """Whether the images are rectified, by ROS's names for topics (``image_rect``, ``image_rect_raw``)."""
        return all("rect" in _base(topic).rpartition("/")[2] for topic in (self.left, self.right))


def choose_topics(recording: Bag, options: Mapping[str, str]) -> Topics:
    """The topics by the options ``left``, ``right``, ``left_info``, ``right_info``; without them those of a pair.

    A pair are two cameras whose messages say so: the same size and focal length of the rectified images, and a baseline
    in the right one's projection. Depth images do not count. Where a calibration is named, names decide.

    Raises:
        SequenceError: a topic is not there, or there is not exactly one pair.
        CalibrationError: there is no calibration.
        ConfigurationError: one of the two images is named and the other is not.
    """
    if layout_of(options) is not None:
        images = [topic for topic in _of_kind(recording, _IMAGES) if not _is_depth(recording, topic)]
        if "left" not in options and len(images) != 1:
            there = f"{len(images)} topics of images, where layout=sbs needs one"
            raise SequenceError(f"{recording.path}: {there}: add left=/… of {_listed(images)}")
        topic = _named(recording, options["left"], _IMAGES) if "left" in options else images[0]
        return _with_infos(recording, (topic, topic), options)
    if ("left" in options) != ("right" in options):
        raise ConfigurationError("name both topics: left=/…&right=/…")
    if "left" in options:
        named = _named(recording, options["left"], _IMAGES), _named(recording, options["right"], _IMAGES)
        return _with_infos(recording, named, options)
    pairs = list(_pairs_by_name(recording) if "calibration" in options else _pairs_by_messages(recording))
    if len(pairs) == 1:
        return pairs[0]
    images = _of_kind(recording, _IMAGES)
    if pairs:
        found = "; ".join(f"left={pair.left}&right={pair.right}" for pair in pairs[:3])
        raise SequenceError(f"{recording.path}: several stereo pairs, choose one: {found}")
    if not images:
        raise SequenceError(f"{recording.path}: no images; its topics are {_listed(sorted(recording.kinds))}")
    raise SequenceError(
        f"{recording.path}: its camera messages name no stereo pair: add left=/…&right=/… of {_listed(images)}, "
        "and calibration=FILE where the cameras are not calibrated"
    )


def _with_infos(recording: Bag, images: tuple[str, str], options: Mapping[str, str]) -> Topics:
    """Images with their cameras' messages, named or in the same name space, unless a calibration is named."""
    names = []
    for side, topic in zip(("left", "right"), () if "calibration" in options else images):
        usual = f"{_space(topic)}/camera_info"
        if f"{side}_info" in options:
            names.append(_named(recording, options[f"{side}_info"], (_INFO,)))
        elif recording.kinds.get(usual) == _INFO:
            names.append(usual)
        else:
            known = _listed(_of_kind(recording, (_INFO,)))
            raise CalibrationError(
                f"{recording.path}: no {usual} for {topic}: add {side}_info=/… (there are {known}) or calibration=FILE"
            )
    return Topics(*images, tuple(CameraInfo.read(recording, name) for name in names), " and ".join(names))


def _pairs_by_messages(recording: Bag) -> Iterator[Topics]:
    """All pairs of cameras that say that they are one."""
    cameras = []
    for name in _of_kind(recording, (_INFO,)):
        images = [t for t in _preferred(recording) if _space(t) == _space(name) and not _is_depth(recording, t)]
        if images and recording.first(name) is not None:
            cameras.append((images[0], name, CameraInfo.read(recording, name)))
    for left, left_name, a in cameras:
        for right, right_name, b in cameras:
            same = a.size == b.size and a.P[0, 0] == b.P[0, 0]
            if same and abs(a.baseline_term) < _SAME_PLACE and b.baseline_term > _SAME_PLACE:
                yield Topics(left, right, (a, b), f"{left_name} and {right_name}")


def _pairs_by_name(recording: Bag) -> list[Topics]:
    """Pairs of topics of images that differ in one of the usual names for left and right, one of each two cameras."""
    images = _preferred(recording)
    found: dict[tuple[str, str], Topics] = {}
    for topic in images:
        for names in SIDES:
            other = topic.replace(*names)
            if other != topic and other in images and not _is_depth(recording, topic):
                spaces = _space(topic), _space(other)
                found.setdefault(spaces if spaces[0] != spaces[1] else (topic, other), Topics(topic, other))
    return list(found.values())


def _named(recording: Bag, topic: str, kinds: tuple[str, ...]) -> str:
    """A topic that must be there, and of one of these types."""
    known = _of_kind(recording, kinds)
    if topic not in known:
        there = f"it holds {recording.kinds[topic]}" if topic in recording.kinds else "there is none"
        hint = suggestion(topic, known)
        raise SequenceError(f"{recording.path}: topic {topic}: {there}{hint}; there are {_listed(known)}")
    return topic


def _of_kind(recording: Bag, kinds: tuple[str, ...]) -> list[str]:
    return sorted(topic for topic, kind in recording.kinds.items() if kind in kinds)


def _is_depth(recording: Bag, topic: str) -> bool:
    """Whether a topic holds depth images, or nothing."""
    message = recording.first(topic)
    if message is None or recording.kinds[topic] == COMPRESSED:
        return message is None or "compressedDepth" in topic
    with naming_recording(recording.path):
        return message.encoding in DEPTH


def _preferred(recording: Bag) -> list[str]:
    """Topics of images in the order in which they are chosen: rectified, raw before compressed, grey before colour."""

    def key(topic: str) -> Any:
        name = _base(topic).rpartition("/")[2]
        return "rect" not in name, recording.kinds[topic] == COMPRESSED, "color" in name

    return sorted(_of_kind(recording, _IMAGES), key=key)


def _base(topic: str) -> str:
    """A topic without what names its compression."""
    base, _, last = topic.rpartition("/")
    return base if last.startswith("compressed") else topic


def _space(topic: str) -> str:
    """The name space of a camera's topic."""
    return _base(topic).rpartition("/")[0]


def _listed(topics: list[str]) -> str:
    more = f", … ({len(topics)})" if len(topics) > _LISTED else ""
    return (", ".join(topics[:_LISTED]) or "none") + more
