"""Live cameras as sequences: two devices, or one whose images hold the left and the right one side by side."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.trajectory import Trajectory
from slam.query import read_query
from slam.sequences.base import FaultLog, as_used, read_masks
from slam.sequences.images import both, grabbed_image, quiet_libraries, recorded_size, require_same_size, size_text
from slam.sequences.options import CALIBRATION, Options
from slam.sequences.rigs import calibration_files, read_rig

OPTIONS = CALIBRATION | {"width", "height", "fps", "wait"}

#: How long frames are waited for where a camera gives none [s].
WAIT = 10.0

_AGAIN = 0.25  # [s] between two attempts to get an image
_TIMEOUT = 5000  # [ms] for an answer from the network

Pair = tuple[float, np.ndarray, np.ndarray]  # stamp [s], left and right image


def open_camera(text: str) -> CameraSequence:
    """A camera by its text, ``camera:`` left out; a question mark may be part of an address in a network."""
    name, mark, query = text.rpartition("?")
    if not mark or ("://" in name and not set(read_query(query)) <= OPTIONS):
        name, query = text, ""
    return CameraSequence(name, Options(query, "camera", OPTIONS))


class CameraSequence:
    """A camera as a sequence without an end. It keeps the `Sequence` protocol, but its length is not known.

    Stamps are this machine's time when the images were grabbed [s since 1970]. A camera that gives no frames is opened
    again and again for a while; one that stays silent ends the sequence with an error. `frames` opens it anew: images
    that waited in a queue until then are old.

    Its text is the address, or two joined by a comma, see `open_device`.

    Raises:
        SequenceError: a camera cannot be opened, gives no image, or one of another size than the calibration is for.
        CalibrationError: the calibration is missing, unreadable or impossible.
        ConfigurationError: no camera is named, or more than two.
    """

    format = "camera"
    ground_truth: Trajectory | None = None
    live = True

    def __init__(self, text: str, options: Mapping[str, Any]) -> None:
        addresses = [text] if "!" in text else [part.strip() for part in text.split(",")]
        if len(addresses) > 2 or not all(addresses):
            hint = "name one device with both images side by side (camera:0), or two (camera:0,1)"
            raise ConfigurationError(f"camera: {hint}")
        addresses = [a if a.isdecimal() or "!" in a or "://" in a else str(expanded(a)) for a in addresses]
        self.name = "camera:" + ",".join(without_password(a) for a in addresses)
        self.kind = options.get("kind", "handheld")
        self.warnings: list[str] = []
        self._addresses, self._swap = addresses, options.get("swap", False)
        self._wanted = [options.get(name) for name in ("width", "height", "fps")]
        self._wait = options.get("wait", WAIT)
        self._origin = time.time() - time.monotonic()  # since 1970 when the monotonic clock was zero [s]
        with self._opened() as devices:
            paths = calibration_files(Path.cwd(), options)
            _, left, _ = self._waited_for(devices, "it is open, but gives no images")  # some take a moment
            try:
                self.rig = read_rig(paths, (left.shape[1], left.shape[0]), options)
                self._masks = read_masks(options.get("mask"), Path.cwd(), self.rig)
            except SequenceError as error:
                hint = "; ask the camera for another size with width=… and height=…"
                raise SequenceError(f"{self.name}: {error}{hint if 'images are' in str(error) else ''}") from None

    def __len__(self) -> int:
        raise TypeError(f"{self.name}: a camera has no number of frames")

    def __iter__(self) -> Iterator[StereoFrame]:
        return self.frames()

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Frames from now on, without the first `start` and, where `stop` is given, as many as that all together."""
        if start < 0 or (stop is not None and stop <= start):
            raise SequenceError(f"frames {start}:{stop} asked for: none")
        return self._frames(start, stop)

    def _frames(self, start: int, stop: int | None) -> Iterator[StereoFrame]:
        index, last, expected = 0, -math.inf, recorded_size(self.rig)
        with self._opened() as devices, FaultLog(self.warnings) as faults:
            while stop is None or index < stop:
                pair = self._read(devices)
                if pair is None:
                    began = time.monotonic()
                    faults.report("silent", f"{self.name}: no more frames; they are waited for {self._wait:g} s")
                    pair = self._waited_for(devices, f"no frames for {self._wait:g} s (see wait=…)", anew=True)
                    faults.report("back", f"{self.name}: frames again after {time.monotonic() - began:.1f} s")
                stamp, left, right = pair
                if left.shape[::-1] != expected:  # as of one that was opened again
                    was = f"they were {size_text(expected)}, as in the calibration"
                    raise SequenceError(f"{self.name}: images are {size_text(left.shape[::-1])} now; {was}")
                if stamp > last:  # the clock of the machine may have been set back
                    last = stamp
                    if index >= start:
                        yield as_used(index, stamp, left, right, self.rig, self._masks)
                    index += 1

    def _waited_for(self, devices: list[Any], silent: str, anew: bool = False) -> Pair:
        """The next pair, of devices that are opened `anew` before each attempt; SequenceError where none comes."""
        began = time.monotonic()
        while True:
            if anew:
                with suppress(SequenceError):
                    self._open(devices)
            pair = self._read(devices)
            if pair is not None:
                return pair
            if time.monotonic() - began >= self._wait:
                raise SequenceError(f"{self.name}: {silent}")
            time.sleep(_AGAIN)

    @contextmanager
    def _opened(self) -> Iterator[list[Any]]:
        """The devices, two or one with both images side by side; released in the end."""
        devices: list[Any] = []
        try:
            self._open(devices)
            yield devices
        finally:
            _release(devices)

    def _open(self, devices: list[Any]) -> None:
        _release(devices)
        for address in self._addresses:
            devices.append(open_device(address, *self._wanted))

    def _read(self, devices: list[Any]) -> Pair | None:
        """The next pair, both grabbed before any is decoded, to be close in time; None where a camera gives none."""
        if len(devices) < len(self._addresses) or not all([device.grab() for device in devices]):
            return None
        stamp = self._origin + time.monotonic()
        images = [image for device in devices if (image := grabbed_image(device)) is not None]
        if len(images) < len(devices):
            return None
        left, right = both(images, self.name)
        require_same_size(left, right, f"{self.name}, left", f"{self.name}, right")
        return (stamp, right, left) if self._swap else (stamp, left, right)


def _release(devices: list[Any]) -> None:
    while devices:
        devices.pop().release()


def open_device(address: str, width: float | None = None, height: float | None = None, fps: float | None = None) -> Any:
    """Open a camera as a ``cv2.VideoCapture``; SequenceError where it cannot be opened, or is a file.

    Its address is a number; a GStreamer pipeline that ends in ``appsink``; or ``rtsp://…`` or another address of a
    network. Width and height [px] and `fps` [1/s] are asked of it; None for its own choice.
    """
    import cv2

    pipeline, network, number = "!" in address, "://" in address, address.isdecimal() and len(address) < 4
    if not pipeline and not network and os.path.isfile(address):  # noqa: PTH113 unlike Path's, no errors
        hint = f"with both images side by side it is run as '{address}?layout=sbs', at its own rate with --live"
        raise SequenceError(f"camera:{address}: a file, not a camera; {hint}")
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT] if network else []
    library = cv2.CAP_GSTREAMER if pipeline else cv2.CAP_FFMPEG if network else cv2.CAP_ANY
    with quiet_libraries():
        capture = cv2.VideoCapture(int(address) if number else address, library, limits)
        if not capture.isOpened():
            raise SequenceError(f"camera:{without_password(address)}: cannot be opened{_hint(address)}")
        wanted = ((cv2.CAP_PROP_FRAME_WIDTH, width), (cv2.CAP_PROP_FRAME_HEIGHT, height), (cv2.CAP_PROP_FPS, fps))
        for name, value in wanted:
            if value is not None:
                capture.set(name, value)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # images that wait in a queue are old
    return capture


def without_password(address: str) -> str:
    """An address as it may be shown."""
    scheme, mark, rest = address.partition("://")
    return f"{scheme}{mark}{rest.rpartition('@')[2]}" if mark else address


def _hint(address: str) -> str:
    import cv2

    if address.isdecimal():
        there = sorted(str(path) for path in Path("/dev").glob("video*"))
        return f": there are {', '.join(there)}" if there else ": this machine shows no camera (/dev/video*)"
    if "!" in address:
        known = cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER)
        return "" if known else ": this OpenCV was built without GStreamer"
    return "" if "://" in address or Path(address).exists() else ": there is no such file or device"
