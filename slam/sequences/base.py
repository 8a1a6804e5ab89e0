"""What a sequence is, and the one class behind all recorded ones."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.rig import StereoRig, quarter_turn
from slam.geometry.se3 import Array
from slam.geometry.stamps import frame_range, require_frame
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.naming import sequence_line
from slam.sequences.faults import FaultLog
from slam.sequences.images import halves, read_image, recorded_size, size_text


@runtime_checkable
class Sequence(Protocol):
    """A stereo recording of any length: iterating it decodes one frame at a time, in constant memory.

    Recorded sequences keep this protocol, and so do the synthetic worlds. Its length is the number of listed frames;
    iterating yields fewer where left images turn out to be unreadable.
    """

    @property
    def name(self) -> str:
        """Short name, for reports and file names."""
        ...

    @property
    def format(self) -> str:
        """Name of the format, see `slam.sequences.formats`."""
        ...

    @property
    def rig(self) -> StereoRig:
        """The two cameras that took the images."""
        ...

    @property
    def kind(self) -> str:
        """Kind of motion, ``"driving"`` or ``"handheld"``: which `slam.models.KINDS` suits."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """The left camera's true path ``T_world_left`` at the stamps that the format has; None where it has none."""
        ...

    @property
    def warnings(self) -> list[str]:
        """What was found wrong so far, one line each; what iterating finds is added."""
        ...

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


#: An image as it was read, or why it could not be; None where there is none.
Image = np.ndarray | SequenceError | None

#: The left and the right image of each frame, or one that holds both, side by side.
Images = Generator[tuple[Image, ...], None, None]

#: Of the left and the right camera (H, W) bool, False where the image is not to be used; None for all of it.
Masks = tuple[np.ndarray | None, np.ndarray | None]


class FrameSource(Protocol):
    """Where a recorded sequence's images come from."""

    @property
    def stamps(self) -> Array:
        """Times of the frames (N,) [s], strictly increasing."""
        ...

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the images of frames `start` to `stop`; they may end early, with a fault."""
        ...


@dataclass(frozen=True, eq=False)
class RecordedSequence:
    """A sequence on disk. It keeps the `Sequence` protocol; properties are described there."""

    name: str
    format: str
    kind: str
    rig: StereoRig
    source: FrameSource  # where the images come from
    ground_truth: Trajectory | None = None
    truth_noise: TruthNoise = field(default_factory=TruthNoise)  # how well the ground truth is known
    warnings: list[str] = field(default_factory=list)
    masks: Masks = (None, None)  # where the images of both cameras may be used
    swap: bool = False  # what the source gives as left is the right camera's

    @property
    def stamps(self) -> Array:
        """Times of the listed frames (N,) [s]."""
        return self.source.stamps

    def __len__(self) -> int:
        return len(self.source.stamps)

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
        found = next(self._read(first, first + 1), None)
        if found is None:
            raise SequenceError(f"{self.name}: the left image of frame {first} cannot be read (see its warnings)")
        return found

    __getitem__ = frame

    def _read(self, start: int, stop: int) -> Iterator[StereoFrame]:
        """Decode lazily and sum up repeated faults at the end, also where the caller stops early.

        A left image that cannot be read costs the frame, a right one itself.
        """
        with FaultLog(self.warnings) as faults, closing(self.source.images(start, stop, faults)) as images:
            for index, (left, *other) in zip(range(start, stop), images):
                right = other[0] if other else None
                if not other and isinstance(left, np.ndarray):
                    left, right = halves(left, self.name)
                if self.swap:
                    left, right = right, left
                if isinstance(right, SequenceError) and not isinstance(left, SequenceError):
                    line = f"frame {index} is given without its right image: {right}"
                    faults.report("right images unreadable, frames given without them", line)
                if isinstance(left, SequenceError):
                    faults.report("left images unreadable, frames skipped", f"frame {index} skipped: {left}")
                elif left is not None:
                    right = right if isinstance(right, np.ndarray) else None
                    yield as_used(StereoFrame(index, float(self.stamps[index]), left, right), self.rig, self.masks)


def turned(truth: Trajectory | None, rig: StereoRig) -> Trajectory | None:
    """The path of the left camera as recorded as that of the camera that is turned as the rig is."""
    if truth is None or not rig.turns:
        return truth
    Q = np.eye(4)
    Q[:3, :3] = quarter_turn(-rig.turns)
    return Trajectory(truth.stamps, truth.poses @ Q)


def as_used(frame: StereoFrame, rig: StereoRig, masks: Masks) -> StereoFrame:
    """A frame as recorded, turned as the rig is, with the masks of both cameras."""
    if rig.turns:
        right = None if frame.right is None else np.ascontiguousarray(np.rot90(frame.right, rig.turns))
        frame = replace(frame, left=np.ascontiguousarray(np.rot90(frame.left, rig.turns)), right=right)
    none = masks[0] is None and masks[1] is None
    return frame if none else replace(frame, left_mask=masks[0], right_mask=masks[1])


def read_masks(text: str | None, folder: Path, rig: StereoRig) -> Masks:
    """The masks by the option ``mask``: one image for both cameras, or two joined by a comma, one perhaps empty.

    Masks are of the images as recorded, before they are turned; names are relative to `folder`. SequenceError where one
    cannot be read, ConfigurationError where it is of another size than the images, or covers all of them.
    """
    if text is None:
        return None, None
    names = text.split(",")
    if len(names) > 2 or not any(names):
        raise ConfigurationError(f"mask must be one image, or two joined by a comma, got {text!r}")
    masks: list[np.ndarray | None] = [None] * len(names)
    for at, path in ((at, folder / expanded(name)) for at, name in enumerate(names) if name):
        try:
            mask = np.rot90(read_image(path) > 0, rig.turns)
        except SequenceError as error:
            raise SequenceError(f"mask: {error}") from error
        if mask.shape != (rig.height, rig.width):
            size = size_text(recorded_size(rig))
            raise ConfigurationError(f"mask {path}: images are {size}, the mask is of another size")
        if not mask.any():
            raise ConfigurationError(f"mask {path}: it is black all over, so that nothing is left of the images")
        masks[at] = mask
    return masks[0], masks[-1]
