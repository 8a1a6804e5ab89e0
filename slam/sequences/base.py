"""What a sequence is, the one class behind all recorded ones, and the log of their faults."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError, one_line
from slam.files import expanded
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.stamps import frame_range, require_frame
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.naming import sequence_line
from slam.sequences.images import both, read_image, recorded_size, size_text

logger = logging.getLogger("slam.sequences")


@runtime_checkable
class Sequence(Protocol):
    """A stereo recording of any length: iterating it decodes one frame at a time, in constant memory.

    Recorded sequences keep this protocol, and so do the synthetic worlds. Its length is the number of listed frames;
    iterating yields fewer where left images turn out to be unreadable.
    """

    @property
    def name(self) -> str:
        """Short name, for reports and file names."""

    @property
    def format(self) -> str:
        """Name of the format, see `slam.sequences.formats`."""

    @property
    def rig(self) -> StereoRig:
        """The two cameras that took the images."""

    @property
    def kind(self) -> str:
        """Kind of motion, ``"driving"`` or ``"handheld"``: which `slam.models.KINDS` suits."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """The left camera's true path ``T_world_left`` at the stamps that the format has; None where it has none."""

    @property
    def warnings(self) -> list[str]:
        """What was found wrong so far, one line each; what iterating finds is added."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[StereoFrame]: ...

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Frames `start` up to, but without, `stop`, in order of time; frames outside are not decoded.

        Raises:
            SequenceError: `start` is negative or not before the end, or `stop` is not after `start`.
        """
        ...


def is_live(frames: object) -> bool:
    """Whether frames come from a camera, which waits for nobody, does not end, and has no number of frames."""
    return bool(getattr(frames, "live", False))


#: So many faults of one kind are reported one by one; the others are counted.
_LINES_PER_KIND = 5


class FaultLog:
    """Keeps faults in `lines`, one each, and says them unless it is `quiet`; a context manager.

    The first few faults of a kind get a line each; the number of the others is reported when the log is closed. A line
    that is known already (a second pass over the same sequence) is said again, but kept once.
    """

    def __init__(self, lines: list[str], quiet: bool = False) -> None:
        self._lines, self._quiet = lines, quiet
        self._counts: Counter[str] = Counter()

    def report(self, kind: str, line: str) -> None:
        """Report one fault; faults of the same `kind` are counted together."""
        self._counts[kind] += 1
        if self._counts[kind] <= _LINES_PER_KIND:
            self._keep(line)

    def _keep(self, line: str) -> None:
        line = one_line(line)
        if line not in self._lines:
            self._lines.append(line)
        if not self._quiet:
            logger.warning("%s", line)

    def __enter__(self) -> FaultLog:
        return self

    def __exit__(self, *_: object) -> None:
        for what, count in self._counts.items():
            if count > _LINES_PER_KIND:
                self._keep(f"{what}: {count} in all, {count - _LINES_PER_KIND} not listed")


#: An image as it was read, or why it could not be; None where there is none.
Image = np.ndarray | SequenceError | None

#: The left and the right image of each frame, or one that holds both, side by side.
Images = Generator[tuple[Image, ...], None, None]

#: Decodes the images of frames from one number up to another; they may end early, with a fault.
Decoder = Callable[[int, int, FaultLog], Images]

#: Of the left and the right camera (H, W) bool, False where the image is not to be used; None for all of it.
Masks = tuple[np.ndarray | None, np.ndarray | None]


def attempt(read: Callable[..., np.ndarray], *arguments: Any) -> np.ndarray | SequenceError:
    """The image that a call gives, or why it gives none."""
    try:
        return read(*arguments)
    except SequenceError as error:
        return error


@dataclass(frozen=True, eq=False)
class RecordedSequence:
    """A sequence on disk. It keeps the `Sequence` protocol; properties are described there."""

    name: str
    format: str
    kind: str
    rig: StereoRig
    stamps: Array  # times of the listed frames (N,) [s], strictly increasing
    decode: Decoder
    ground_truth: Trajectory | None = None
    truth_noise: TruthNoise = field(default_factory=TruthNoise)  # how well the ground truth is known
    warnings: list[str] = field(default_factory=list)
    masks: Masks = (None, None)  # where the images of both cameras may be used
    swap: bool = False  # what is decoded as left is the right camera's

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[StereoFrame]:
        return self.frames()

    __repr__ = sequence_line

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Frames `start` up to, but without, `stop`; see `Sequence.frames`."""
        first, last = frame_range(start, stop, len(self))
        if stop is not None and stop > last:
            with FaultLog(self.warnings) as faults:
                faults.report("frames", f"{self.name}: frames {start}:{stop} asked for, it has {len(self)}")
        return self._read(first, last)

    def frame(self, k: int) -> StereoFrame:
        """Frame k alone, as ``sequence[k]``; SequenceError where there is none, or its left image is unreadable."""
        first = require_frame(self.name, k, len(self))
        found = list(self._read(first, first + 1))
        if not found:
            raise SequenceError(f"{self.name}: the left image of frame {first} cannot be read (see its warnings)")
        return found[0]

    __getitem__ = frame

    def _read(self, start: int, stop: int) -> Iterator[StereoFrame]:
        """Decode lazily; a left image that cannot be read costs the frame, a right one itself."""
        with FaultLog(self.warnings) as faults, closing(self.decode(start, stop, faults)) as images:
            for index, found in zip(range(start, stop), images):
                left, right = both(found, self.name)
                if self.swap:
                    left, right = right, left
                if isinstance(left, SequenceError):
                    faults.report("left images unreadable, frames skipped", f"frame {index} skipped: {left}")
                    continue
                if isinstance(right, SequenceError):
                    line = f"frame {index} is given without its right image: {right}"
                    faults.report("right images unreadable, frames given without them", line)
                    right = None
                if left is not None:
                    yield as_used(index, float(self.stamps[index]), left, right, self.rig, self.masks)


def as_used(
    index: int, stamp: float, left: np.ndarray, right: np.ndarray | None, rig: StereoRig, masks: Masks
) -> StereoFrame:
    """A frame of images as recorded, turned as the rig is, with the masks of both cameras."""
    if rig.turns:
        left = np.ascontiguousarray(np.rot90(left, rig.turns))
        right = None if right is None else np.ascontiguousarray(np.rot90(right, rig.turns))
    return StereoFrame(index, stamp, left, right, *masks)


def read_masks(text: str | None, folder: Path, rig: StereoRig) -> Masks:
    """The masks by the option ``mask``: an image, as recorded, for both cameras, or two joined by a comma."""
    if text is None:
        return None, None
    names = text.split(",")
    if len(names) > 2 or not any(names):
        raise ConfigurationError(f"mask must be one image, or two joined by a comma, got {text!r}")
    return _mask(names[0], folder, rig), _mask(names[-1], folder, rig)


def _mask(name: str, folder: Path, rig: StereoRig) -> np.ndarray | None:
    if not name:
        return None
    path = folder / expanded(name)
    try:
        mask = np.rot90(read_image(path) > 0, rig.turns)
    except SequenceError as error:
        raise SequenceError(f"mask: {error}") from error
    if mask.shape != (rig.height, rig.width):
        raise ConfigurationError(
            f"mask {path}: images are {size_text(recorded_size(rig))}, the mask is of another size"
        )
    if not mask.any():
        raise ConfigurationError(f"mask {path}: it is black all over, so that nothing is left of the images")
    return mask
