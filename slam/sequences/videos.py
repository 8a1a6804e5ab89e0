"""Two video files as a frame source: frame number i of one goes with frame number i of the other."""

from __future__ import annotations

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
from slam.sequences.devices import quiet_libraries, read_image
from slam.sequences.faults import FaultLog
from slam.sequences.given import FASTEST, SLOWEST
from slam.sequences.images import MOST_PIXELS, Size, halved, halves, require_same_size

#: Endings of video files, in lower case.
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg"})

_MOST_FRAMES = 10_000_000  # of a video, four days of it: what a header says may be anything


@dataclass(frozen=True, eq=False)
class VideoPairs:
    """A frame source: two videos."""

    stamps: Array  # times (N,) [s]: frame number by frame rate
    left: Path
    right: Path | None  # None where the left one has both images side by side
    size: Size  # width and height of the frames

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode frames `start` to `stop`, in grey; a video that ends too early ends the sequence with a line.

        A video cannot be entered in the middle without errors, so what is skipped is passed over, though not
        converted.
        """
        paths = [path for path in (self.left, self.right) if path is not None]
        with ExitStack() as stack:
            videos = [stack.enter_context(open_video(path)) for path in paths]
            with quiet_libraries():
                for _ in range(start):
                    for video in videos:
                        video.grab()
            for index in range(start, stop):
                images = [read_image(video) if video.grab() else None for video in videos]
                for path, image in zip(paths, images):
                    if image is None:
                        faults.report("videos", f"{path}: ends or is damaged at frame {index} of {len(self.stamps)}")
                whole = [image for image in images if image is not None]
                if len(whole) < len(images):
                    return
                yield halves(whole[0], str(self.left)) if self.right is None else (whole[0], whole[1])


def open_videos(left: Path, right: Path | None, rate: float | None, faults: FaultLog) -> VideoPairs:
    """The frame source of two videos, or of one side by side; `rate` [1/s] overrides what the left one says of itself.

    Raises:
        SequenceError: a file is no readable video, the frame sizes differ, or the frame rate is not known.
    """
    (count_left, rate_left, size_left) = _describe(left)
    count_right, size_right = count_left, size_left
    if right is None:
        size_left = size_right = halved(size_left, str(left))
    else:
        count_right, _, size_right = _describe(right)
    require_same_size(size_left, size_right, left, right)
    if count_left != count_right:
        line = f"{left} has {count_left} frames, {right} has {count_right}: the surplus is left out"
        faults.report("videos", line)
    rate = rate or rate_left
    if not SLOWEST <= rate <= FASTEST:
        raise SequenceError(f"{left}: the frame rate is not known, add fps=…")
    return VideoPairs(np.arange(min(count_left, count_right)) / rate, left, right, size_left)


@contextmanager
def open_video(path: Path) -> Iterator[Any]:
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


def _describe(path: Path) -> tuple[int, float, Size]:
    """Number of frames, frame rate [1/s] and frame size of a video; frames are counted where the file does not say."""
    import cv2

    with open_video(path) as video:
        claimed, rate = video.get(cv2.CAP_PROP_FRAME_COUNT), float(video.get(cv2.CAP_PROP_FPS))
        count = int(min(claimed, _MOST_FRAMES)) if claimed > 0 else 0
        first = read_image(video) if video.grab() else None
        if first is None:
            raise SequenceError(f"{path}: no frame of the video can be decoded")
        if count <= 0:
            count = 1
            with quiet_libraries():
                while count < _MOST_FRAMES and video.grab():
                    count += 1
    return count, rate, (first.shape[1], first.shape[0])
