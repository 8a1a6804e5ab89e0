"""What OpenCV captures: cameras by number, by a GStreamer pipeline or by an address in a network, and video files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError

_TIMEOUT = 5000  # [ms] for an answer from the network


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep OpenCV, and ffmpeg below it, from printing what is about to be reported as an error of ours."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = cv2.utils.logging
    before = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)


def open_device(address: str, width: int | None = None, height: int | None = None, fps: float | None = None) -> Any:
    """Open a camera as a ``cv2.VideoCapture``.

    Args:
        address: a number; a GStreamer pipeline that ends in ``appsink``; or ``rtsp://…`` or another address
            of a network.
        width: asked of the camera [px]; None for its own choice.
        height: the same.
        fps: the same [1/s].

    Raises:
        SequenceError: it cannot be opened, or is a file.
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
    if "!" in address and not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
        return ": this OpenCV was built without GStreamer"
    if "://" not in address and "!" not in address and not Path(address).exists():
        return ": there is no such file or device"
    return ""
