"""Live cameras as sequences: two devices, or one whose images hold the left and the right one side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.trajectory import Trajectory
from slam.sequences import captures as devices
from slam.sequences.base import as_used, read_masks
from slam.sequences.faults import FaultLog
from slam.sequences.images import halves, recorded_size, require_same_size, size_text
from slam.sequences.options import CALIBRATION, Options, read_options
from slam.sequences.rigs import calibration_files, read_rig

OPTIONS = CALIBRATION | {"left", "right", "width", "height", "fps", "wait"}

#: How long frames are waited for where a camera gives none [s].
WAIT = 10.0

_AGAIN = 0.25  # [s] between two attempts to get an image

Pair = tuple[float, np.ndarray, np.ndarray]  # stamp [s], left and right image
T = TypeVar("T")


def open_camera(text: str) -> CameraSequence:
    """A camera by its text, ``camera:`` left out; a question mark may be part of an address in a network."""
    name, mark, query = text.rpartition("?")
    if not mark or ("://" in name and not set(read_options(query)) <= OPTIONS):
        name, query = text, ""
    return CameraSequence(name, Options(query, "camera", OPTIONS))


class CameraSequence:
    """A camera as a sequence without an end. It keeps the `Sequence` protocol, but its length is not known.

    Stamps are this machine's time when the images were grabbed [s since 1970]. A camera that gives no frames is opened
    again and again for a while; one that stays silent ends the sequence with an error. `frames` opens it anew: images
    that waited in a queue until then are old.

    Its text is the address, or two joined by a comma, see `slam.sequences.captures.open_device`; empty where the
    options ``left`` and ``right`` name them.

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
        if "left" in options or "right" in options:
            if text or not ("left" in options and "right" in options):
                raise ConfigurationError("camera: name both left=… and right=…, and no other address")
            addresses = [options["left"], options["right"]]
        if len(addresses) > 2 or not all(addresses):
            hint = "name one device with both images side by side (camera:0), or two (camera:0,1)"
            raise ConfigurationError(f"camera: {hint}")
        addresses = [a if a.isdecimal() or "!" in a or "://" in a else str(expanded(a)) for a in addresses]
        self.name = "camera:" + ",".join(devices.without_password(a) for a in addresses)
        self.kind = options.get("kind", "handheld")
        self.warnings: list[str] = []
        self._addresses, self._swap = addresses, options.get("swap", False)
        self._wanted = [options.get(name) for name in ("width", "height", "fps")]
        self._wait = options.get("wait", WAIT)
        self._origin = time.time() - time.monotonic()  # since 1970 when the monotonic clock was zero [s]
        opened = self._open()
        try:
            missing = f"{self.name}: there is no calibration.yaml or the like in {Path.cwd()}"
            missing += f"; name the file: '{self.name}?calibration=FILE'"
            paths = calibration_files(Path.cwd(), options, missing)
            silent = "it is open, but gives no images"
            _, left, _ = self._waited(lambda: self._read(opened), silent)  # some take a moment
            self.rig = read_rig(paths, (left.shape[1], left.shape[0]), options)
            self._masks = read_masks(options.get("mask"), Path.cwd(), self.rig)
        except SequenceError as error:
            hint = "; ask the camera for another size with width=… and height=…" if "images are" in str(error) else ""
            raise SequenceError(f"{self.name}: {str(error).removeprefix(f'{self.name}: ')}{hint}") from None
        finally:
            _release(opened)

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
        opened, index, last, expected = self._open(), 0, -math.inf, recorded_size(self.rig)
        try:
            with FaultLog(self.warnings) as faults:
                while stop is None or index < stop:
                    pair = self._read(opened)
                    if pair is None:
                        _release(opened)
                        began = time.monotonic()
                        faults.report("silent", f"{self.name}: no more frames; they are waited for {self._wait:g} s")
                        opened, pair = self._waited(self._again, f"no frames for {self._wait:g} s (see wait=…)")
                        faults.report("back", f"{self.name}: frames again after {time.monotonic() - began:.1f} s")
                    if pair[1].shape[::-1] != expected:  # as of one that was opened again
                        now = f"images are {size_text(pair[1].shape[::-1])} now"
                        was = f"they were {size_text(expected)}, as in the calibration"
                        raise SequenceError(f"{self.name}: {now}; {was}")
                    if pair[0] > last:  # the clock of the machine may have been set back
                        last = pair[0]
                        if index >= start:
                            yield as_used(StereoFrame(index, *pair), self.rig, self._masks)
                        index += 1
        finally:
            _release(opened)

    def _waited(self, attempt: Callable[[], T | None], silent: str) -> T:
        """What an attempt gives in the end; raises SequenceError where it gives nothing for so long."""
        began = time.monotonic()
        while (found := attempt()) is None:
            if time.monotonic() - began >= self._wait:
                raise SequenceError(f"{self.name}: {silent}")
            time.sleep(_AGAIN)
        return found

    def _again(self) -> tuple[list[Any], Pair] | None:
        """The devices, opened again, with their first images; None where they stay silent."""
        try:
            opened = self._open()
        except SequenceError:
            return None
        pair = self._read(opened)
        if pair is None:
            _release(opened)
            return None
        return opened, pair

    def _open(self) -> list[Any]:
        """The devices: two, or one with both images side by side."""
        opened: list[Any] = []
        try:
            for address in self._addresses:
                opened.append(devices.open_device(address, *self._wanted))
        except BaseException:
            _release(opened)
            raise
        return opened

    def _read(self, opened: list[Any]) -> Pair | None:
        """The next pair; None where a camera gives none. SequenceError where the two differ in size.

        All are grabbed before any is decoded: so they lie as close together in time as they can.
        """
        if not all([device.grab() for device in opened]):
            return None
        stamp = self._origin + time.monotonic()
        images = [image for device in opened if (image := devices.read_image(device)) is not None]
        if len(images) < len(opened):
            return None
        left, right = halves(images[0], self.name) if len(images) == 1 else images
        require_same_size(left, right, f"{self.name}, left", f"{self.name}, right")
        return (stamp, right, left) if self._swap else (stamp, left, right)


def _release(opened: list[Any]) -> None:
    for device in opened:
        device.release()
