"""What OpenCV captures: video files, as a frame source, and cameras by number, pipeline or address."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError
from slam.files import require_content
from slam.geometry.se3 import Array
from slam.sequences.base import Images
from slam.sequences.faults import FaultLog
from slam.sequences.images import MOST_PIXELS, Size, halves, require_same_size
from slam.sequences.options import FASTEST, SLOWEST

#: Endings of video files, in lower case.
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg"})

_TIMEOUT = 5000  # [ms] for an answer from the network
_MOST_FRAMES = 10_000_000  # of a video, four days of it: what a header says may be anything


@dataclass(frozen=True, eq=False)
class VideoPairs:
    """A frame source: two videos, or one with both images side by side."""

    stamps: Array  # times (N,) [s]: frame number by frame rate
    paths: list[Path]

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode frames `start` to `stop`, in grey; a video that ends too early ends the sequence with a line.

        A video cannot be entered in the middle without errors, so what is skipped is passed over, though not
        converted.
        """
        with ExitStack() as stack:
            videos = [stack.enter_context(_open(path)) for path in self.paths]
            with quiet_libraries():
                for _ in range(start):
                    for video in videos:
                        video.grab()
            for index in range(start, stop):
                images = [read_image(video) if video.grab() else None for video in videos]
                for path, image in zip(self.paths, images):
                    if image is None:
                        faults.report("videos", f"{path}: ends or is damaged at frame {index} of {len(self.stamps)}")
                if any(image is None for image in images):
                    return
                yield tuple(images)


def open_videos(paths: list[Path], rate: float | None, faults: FaultLog) -> tuple[VideoPairs, Size]:
    """The frame source of two videos, or of one side by side, and the size of a camera's images.

    `rate` [1/s] overrides what videos say of themselves.

    SequenceError where a file is no readable video, frame sizes or rates differ, or the frame rate is not known.
    """
    counts, images, rates = zip(*(_beginning(path) for path in paths))
    left, right = halves(images[0], paths[0]) if len(paths) == 1 else images
    require_same_size(left, right, *paths)
    if rate is None and abs(rates[0] - rates[-1]) * min(counts) > 0.5 * rates[0]:  # more than half a frame in the end
        said = f"{paths[0]} has {rates[0]:.6g} frames per second, {paths[1]} has {rates[1]:.6g}"
        raise SequenceError(f"{said}: frames of one number are not of one moment; where they are, add fps=…")
    if counts[0] != counts[-1]:
        line = f"{paths[0]} has {counts[0]} frames, {paths[1]} has {counts[1]}: the surplus is left out"
        faults.report("videos", line)
    rate = rate or rates[0]
    if not SLOWEST <= rate <= FASTEST:
        raise SequenceError(f"{paths[0]}: the frame rate is not known, add fps=…")
    return VideoPairs(np.arange(min(counts)) / rate, paths), (left.shape[1], left.shape[0])


def _beginning(path: Path) -> tuple[int, np.ndarray, float]:
    """A video's number of frames, its first image, and its frame rate [1/s]."""
    import cv2

    with _open(path) as video, quiet_libraries():
        claimed, rate = video.get(cv2.CAP_PROP_FRAME_COUNT), float(video.get(cv2.CAP_PROP_FPS))
        first = read_image(video) if video.grab() else None
        if first is None:
            raise SequenceError(f"{path}: no frame of the video can be decoded")
        count = int(min(claimed, _MOST_FRAMES)) if claimed > 0 else 1
        while claimed <= 0 and count < _MOST_FRAMES and video.grab():  # it does not say
            count += 1
        return count, first, rate


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """A ``cv2.VideoCapture``, released in the end; SequenceError where the file is no readable video."""
    import cv2

    require_content(path)  # a pipe would be waited for
    with quiet_libraries():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)  # others take a name for a pattern
    try:
        if not capture.isOpened():
            raise SequenceError(f"{path}: not a readable video")
        if capture.get(cv2.CAP_PROP_FRAME_WIDTH) * capture.get(cv2.CAP_PROP_FRAME_HEIGHT) > MOST_PIXELS:
            raise SequenceError(f"{path}: frames of more than {MOST_PIXELS} pixels are not read")
        yield capture
    finally:
        with quiet_libraries():
            capture.release()


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep OpenCV, and ffmpeg below it, from printing what is about to be reported as an error of ours."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = getattr(cv2.utils, "logging", cv2)  # before OpenCV 5, the functions are in `cv2` itself
    before = logging.setLogLevel(0)  # 0: silent
    try:
        yield
    finally:
        logging.setLogLevel(before)


def open_device(address: str, width: float | None = None, height: float | None = None, fps: float | None = None) -> Any:
    """Open a camera as a ``cv2.VideoCapture``; SequenceError where it cannot be opened, or is a file.

    Its address is a number; a GStreamer pipeline that ends in ``appsink``; or ``rtsp://…`` or another address of a
    network. Width and height [px] and `fps` [1/s] are asked of it; None for its own choice.
    """
    import cv2

    if "!" not in address and "://" not in address and os.path.isfile(address):  # noqa: PTH113 unlike Path's, no errors
        hint = f"with both images side by side it is run as '{address}?layout=sbs', at its own rate with --live"
        raise SequenceError(f"camera:{address}: a file, not a camera; {hint}")
    with quiet_libraries():
        if address.isdecimal() and len(address) < 4:
            capture = cv2.VideoCapture(int(address))
        elif "!" in address:
            capture = cv2.VideoCapture(address, cv2.CAP_GSTREAMER)
        elif "://" in address:
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT]
            capture = cv2.VideoCapture(address, cv2.CAP_FFMPEG, limits)
        else:
            capture = cv2.VideoCapture(address)
        if not capture.isOpened():
            raise SequenceError(f"camera:{without_password(address)}: cannot be opened{_hint(address)}")
        wanted = ((cv2.CAP_PROP_FRAME_WIDTH, width), (cv2.CAP_PROP_FRAME_HEIGHT, height), (cv2.CAP_PROP_FPS, fps))
        for name, value in wanted:
            if value is not None:
                capture.set(name, value)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # images that wait in a queue are old
    return capture


def read_image(device: Any) -> np.ndarray | None:
    """The grabbed image in grey (H, W), as stored in 8 or 16 bits; None where there is none."""
    import cv2

    try:
        with quiet_libraries():
            good, image = device.retrieve()
    except cv2.error:
        return None
    if not good or image is None or image.size == 0:
        return None
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def without_password(address: str) -> str:
    """An address as it may be shown."""
    scheme, mark, rest = address.partition("://")
    return f"{scheme}{mark}{rest.rpartition('@')[2]}" if mark else address


def _hint(address: str) -> str:
    """What may be the reason."""
    import cv2

    if address.isdecimal():
        there = sorted(str(path) for path in Path("/dev").glob("video*"))
        return f": there are {', '.join(there)}" if there else ": this machine shows no camera (/dev/video*)"
    if "!" in address:
        known = cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER)
        return "" if known else ": this OpenCV was built without GStreamer"
    return "" if "://" in address or Path(address).exists() else ": there is no such file or device"
