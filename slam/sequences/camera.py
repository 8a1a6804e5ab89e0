"""Live cameras as sequences: two devices, or one whose images hold the left and the right one side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.sequences import devices, rigs
from slam.sequences.door import at_the_door, read_masks
from slam.sequences.faults import FaultLog
from slam.sequences.given import flag, number
from slam.sequences.images import halves, require_same_size, size_text

#: Options besides ``kind``.
OPTIONS = frozenset({"left", "right", "swap", "width", "height", "fps", "wait"}) | rigs.OPTIONS

#: How long frames are waited for where a camera gives none [s].
WAIT = 10.0

_AGAIN = 0.25  # [s] between two attempts to open a camera again
_LONGEST_WAIT = 86400.0
_OLD = 1.0  # [s] after which a camera that nobody read is opened again: its images have waited in a queue
_WIDEST = 100_000

Pair = tuple[float, np.ndarray, np.ndarray]


class CameraSequence:
    """A camera as a sequence without an end. It keeps the `Sequence` protocol, but its length is not known.

    Stamps are this machine's time when the images were grabbed [s since 1970]. A camera that gives no frames is opened
    again and again for a while; one that stays silent ends the sequence with an error.

    Args:
        addresses: one device or two, see `slam.sequences.devices.open_device`.
        options: those of `OPTIONS` that are given.

    Raises:
        SequenceError: a camera cannot be opened, gives no image, or one of another size than the calibration is for.
        CalibrationError: the calibration is missing, unreadable or impossible.
        ConfigurationError: an option has an impossible value.
    """

    format = "camera"
    ground_truth: Trajectory | None = None
    live = True

    def __init__(self, addresses: list[str], options: Mapping[str, str]) -> None:
        self.name = "camera:" + ",".join(devices.without_password(a) for a in addresses)
        self.kind = options.get("kind", "handheld")
        self.warnings: list[str] = []
        self._addresses = addresses
        self._size_wanted = tuple(_whole(options, name) for name in ("width", "height"))
        self._fps = number(options, "fps", 1e-3, 1e5)
        wait = number(options, "wait", 0.0, _LONGEST_WAIT)
        self._wait = WAIT if wait is None else wait
        self._swap = flag(options, "swap")
        self._origin = time.time() - time.monotonic()
        self._cameras: _Cameras | None = self._open()
        try:
            missing = f"{self.name}: there is no calibration.yaml or the like in {Path.cwd()}"
            missing += f"; name the file: '{self.name}?calibration=FILE'"
            paths = rigs.calibration_files(Path.cwd(), options, missing)
            _, left, _ = self._first(self._cameras)
            self.rig: StereoRig = self._rig(paths, (left.shape[1], left.shape[0]), options)
            self._masks = read_masks(options.get("mask"), Path.cwd(), self.rig)
        except BaseException:
            self._cameras.release()
            raise

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
        cameras = self._fresh()
        index, last = 0, -math.inf
        with ExitStack() as stack, FaultLog(self.warnings) as faults:
            stack.callback(lambda: cameras.release())  # whichever they are in the end
            while stop is None or index < stop:
                pair = cameras.read()
                if pair is None:
                    cameras.release()
                    cameras, pair = self._again(faults)
                self._require_size(pair[1])
                if pair[0] > last:  # the clock of the machine may have been set back
                    last = pair[0]
                    if index >= start:
                        yield at_the_door(StereoFrame(index, *pair), self.rig, self._masks)
                    index += 1

    def _fresh(self) -> _Cameras:
        """The open cameras, whose next images are of now."""
        cameras, self._cameras = self._cameras, None
        if cameras is not None and time.monotonic() - cameras.last_read > _OLD:
            cameras.release()
            cameras = None
        return cameras or self._open()

    def _require_size(self, image: np.ndarray) -> None:
        """Raise where a camera has changed the size of its images, as one may that was opened again."""
        size, expected = image.shape[::-1], (self.rig.width, self.rig.height)
        if size != (expected[::-1] if self.rig.turns % 2 else expected):
            raise SequenceError(
                f"{self.name}: images are {size_text(size)} now; they were {size_text(expected)}, as in the calibration"
            )

    def _again(self, faults: FaultLog) -> tuple[_Cameras, Pair]:
        """The cameras, opened again, with their first images.

        Raises:
            SequenceError: they stay silent.
        """
        began = time.monotonic()
        faults.report("silent", f"{self.name}: no more frames; they are waited for {self._wait:g} s")
        while True:
            try:
                cameras = self._open()
                pair = cameras.read()
                if pair is not None:
                    faults.report("back", f"{self.name}: frames again after {time.monotonic() - began:.1f} s")
                    return cameras, pair
                cameras.release()
            except SequenceError:
                pass
            if time.monotonic() - began >= self._wait:
                raise SequenceError(f"{self.name}: no frames for {self._wait:g} s (see wait=…)")
            time.sleep(_AGAIN)

    def _open(self) -> _Cameras:
        width, height = self._size_wanted
        return _Cameras(self._addresses, self._swap, self._origin, (width, height, self._fps))

    def _first(self, cameras: _Cameras) -> Pair:
        """The first images: some cameras take a moment."""
        began = time.monotonic()
        while True:
            pair = cameras.read()
            if pair is not None:
                return pair
            if time.monotonic() - began >= self._wait:
                raise SequenceError(f"{self.name}: it is open, but gives no images")
            time.sleep(_AGAIN)

    def _rig(self, paths: list[Path], size: tuple[int, int], options: Mapping[str, str]) -> StereoRig:
        """The rig of the calibration, which must be for images of this size."""
        try:
            return rigs.read_rig(paths, size, options)
        except SequenceError as error:
            hint = "" if self._size_wanted[0] else "; ask the camera for another size with width=… and height=…"
            raise SequenceError(f"{self.name}: {error}{hint}") from None


class _Cameras:
    """The open devices: two, or one with both images side by side.

    Args:
        addresses: of the devices.
        swap: the right image comes first.
        origin: time since 1970 when the monotonic clock was zero [s].
        wanted: width, height and rate that are asked of a camera; None for its own choice.
    """

    def __init__(
        self,
        addresses: list[str],
        swap: bool,
        origin: float,
        wanted: tuple[int | None, int | None, float | None],
    ) -> None:
        self._swap, self._origin, self._name = (
            swap,
            origin,
            "camera:" + ",".join(map(devices.without_password, addresses)),
        )
        self.last_read = time.monotonic()
        self._devices: list[devices.Device] = []
        try:
            for address in addresses:
                self._devices.append(devices.open_device(address, *wanted))
        except BaseException:
            self.release()
            raise

    def read(self) -> Pair | None:
        """Stamp [s], left and right image; None where a camera gives none.

        All are grabbed before any is decoded: so they lie as close together in time as they can.

        Raises:
            SequenceError: the two images differ in size, or one cannot be halved.
        """
        if not all([device.grab() for device in self._devices]):
            return None
        self.last_read = time.monotonic()
        stamp = self._origin + self.last_read
        images = [image for device in self._devices if (image := devices.read_image(device)) is not None]
        if len(images) < len(self._devices):
            return None
        left, right = halves(images[0], self._name) if len(images) == 1 else (images[0], images[1])
        require_same_size(left.shape[::-1], right.shape[::-1], f"{self._name}, left", f"{self._name}, right")
        return (stamp, right, left) if self._swap else (stamp, left, right)

    def release(self) -> None:
        """Close them."""
        for device in self._devices:
            device.release()


def open_camera(text: str, options: Mapping[str, str]) -> CameraSequence:
    """Open one camera or two.

    Args:
        text: the address, or two joined by a comma; empty where the options ``left`` and ``right`` name them.
        options: those of `OPTIONS` that are given.

    Raises:
        SequenceError, CalibrationError: as `CameraSequence`.
        ConfigurationError: an option has an impossible value; no camera is named, or more than two.
    """
    if "left" in options or "right" in options:
        if text or not ("left" in options and "right" in options):
            raise ConfigurationError("camera: name both left=… and right=…, and no other address")
        addresses = [options["left"], options["right"]]
    else:
        addresses = [text] if "!" in text else [part.strip() for part in text.split(",")]
    if len(addresses) > 2 or not all(addresses):
        raise ConfigurationError(
            "camera: name one device with both images side by side (camera:0), or two (camera:0,1)"
        )
    plain = [a if a.isdecimal() or "!" in a or "://" in a else str(expanded(a)) for a in addresses]
    return CameraSequence(plain, options)


def _whole(options: Mapping[str, str], name: str) -> int | None:
    value = number(options, name, 1, _WIDEST)
    return None if value is None else int(value)
