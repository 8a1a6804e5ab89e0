"""Live cameras as sequences: two devices, or one whose images hold the left and the right one side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

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
from slam.sequences.images import Size, halves, recorded_size, require_same_size, size_text

#: Options besides ``kind`` and ``mask``.
OPTIONS = frozenset({"left", "right", "swap", "width", "height", "fps", "wait"}) | rigs.OPTIONS

#: How long frames are waited for where a camera gives none [s].
WAIT = 10.0

_AGAIN = 0.25  # [s] between two attempts to open a camera again
_LONGEST_WAIT = 86400.0
_OLD = 1.0  # [s] after which a camera that nobody read is opened again: its images have waited in a queue
_WIDEST = 100_000

Pair = tuple[float, np.ndarray, np.ndarray]  # stamp [s], left and right image
T = TypeVar("T")


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
        self._addresses, self._swap = addresses, flag(options, "swap")
        sides = [number(options, name, 1, _WIDEST) for name in ("width", "height")]
        wanted = [None if side is None else int(side) for side in sides]
        self._wanted = *wanted, number(options, "fps", 1e-3, 1e5)
        wait = number(options, "wait", 0.0, _LONGEST_WAIT)
        self._wait = WAIT if wait is None else wait
        self._origin = time.time() - time.monotonic()
        self._cameras: _Cameras | None
        self._cameras = cameras = self._open()
        try:
            missing = f"{self.name}: there is no calibration.yaml or the like in {Path.cwd()}"
            missing += f"; name the file: '{self.name}?calibration=FILE'"
            paths = rigs.calibration_files(Path.cwd(), options, missing)
            _, left, _ = self._waited(cameras.read, "it is open, but gives no images")  # some take a moment
            self.rig = self._rig(paths, (left.shape[1], left.shape[0]), options)
            self._masks = read_masks(options.get("mask"), Path.cwd(), self.rig)
        except BaseException:
            cameras.release()
            raise

    def _rig(self, paths: list[Path], size: Size, options: Mapping[str, str]) -> StereoRig:
        """The rig of the calibration, which must be for images of this size."""
        try:
            return rigs.read_rig(paths, size, options)
        except SequenceError as error:
            hint = "" if self._wanted[0] else "; ask the camera for another size with width=… and height=…"
            raise SequenceError(f"{self.name}: {error}{hint}") from None

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
        kept, self._cameras = self._cameras, None
        if kept is not None and time.monotonic() - kept.last_read > _OLD:
            kept.release()
            kept = None
        cameras = kept or self._open()
        index, last, expected = 0, -math.inf, recorded_size(self.rig)
        with ExitStack() as stack, FaultLog(self.warnings) as faults:
            stack.callback(lambda: cameras.release())  # whichever they are in the end
            while stop is None or index < stop:
                pair = cameras.read()
                if pair is None:
                    cameras.release()
                    began = time.monotonic()
                    faults.report("silent", f"{self.name}: no more frames; they are waited for {self._wait:g} s")
                    cameras, pair = self._waited(self._again, f"no frames for {self._wait:g} s (see wait=…)")
                    faults.report("back", f"{self.name}: frames again after {time.monotonic() - began:.1f} s")
                if pair[1].shape[::-1] != expected:  # as of one that was opened again
                    now = f"images are {size_text(pair[1].shape[::-1])} now"
                    raise SequenceError(f"{self.name}: {now}; they were {size_text(expected)}, as in the calibration")
                if pair[0] > last:  # the clock of the machine may have been set back
                    last = pair[0]
                    if index >= start:
                        yield at_the_door(StereoFrame(index, *pair), self.rig, self._masks)
                    index += 1

    def _waited(self, attempt: Callable[[], T | None], silent: str) -> T:
        """What an attempt gives in the end; raises SequenceError where it gives nothing for so long."""
        began = time.monotonic()
        while (found := attempt()) is None:
            if time.monotonic() - began >= self._wait:
                raise SequenceError(f"{self.name}: {silent}")
            time.sleep(_AGAIN)
        return found

    def _again(self) -> tuple[_Cameras, Pair] | None:
        """The cameras, opened again, with their first images; None where they stay silent."""
        try:
            cameras = self._open()
            pair = cameras.read()
        except SequenceError:
            return None
        if pair is not None:
            return cameras, pair
        cameras.release()
        return None

    def _open(self) -> _Cameras:
        return _Cameras(self._addresses, self._swap, self._origin, self._wanted)


class _Cameras:
    """The open devices: two, or one with both images side by side.

    Args:
        addresses: of the devices.
        swap: the right image comes first.
        origin: time since 1970 when the monotonic clock was zero [s].
        wanted: width, height and rate that are asked of a camera; None for its own choice.
    """

    def __init__(self, addresses: list[str], swap: bool, origin: float, wanted: tuple[Any, ...]) -> None:
        self._swap, self._origin = swap, origin
        self._name = "camera:" + ",".join(map(devices.without_password, addresses))
        self.last_read = time.monotonic()
        self._devices: list[Any] = []
        try:
            for address in addresses:
                self._devices.append(devices.open_device(address, *wanted))
        except BaseException:
            self.release()
            raise

    def read(self) -> Pair | None:
        """The next pair; None where a camera gives none. SequenceError where the two differ in size.

        All are grabbed before any is decoded: so they lie as close together in time as they can.
        """
        if not all([device.grab() for device in self._devices]):
            return None
        self.last_read = time.monotonic()
        images = [image for device in self._devices if (image := devices.read_image(device)) is not None]
        if len(images) < len(self._devices):
            return None
        left, right = halves(images[0], self._name) if len(images) == 1 else images
        require_same_size(left.shape[::-1], right.shape[::-1], f"{self._name}, left", f"{self._name}, right")
        left, right = (right, left) if self._swap else (left, right)
        return self._origin + self.last_read, left, right

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
    addresses = [text] if "!" in text else [part.strip() for part in text.split(",")]
    if "left" in options or "right" in options:
        if text or not ("left" in options and "right" in options):
            raise ConfigurationError("camera: name both left=… and right=…, and no other address")
        addresses = [options["left"], options["right"]]
    if len(addresses) > 2 or not all(addresses):
        hint = "name one device with both images side by side (camera:0), or two (camera:0,1)"
        raise ConfigurationError(f"camera: {hint}")
    plain = [a if a.isdecimal() or "!" in a or "://" in a else str(expanded(a)) for a in addresses]
    return CameraSequence(plain, options)
