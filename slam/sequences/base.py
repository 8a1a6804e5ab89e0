"""What a sequence is, and the one class behind all recorded ones."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from slam.data import StereoFrame
from slam.errors import SequenceError
from slam.geometry.rig import StereoRig, quarter_turn
from slam.geometry.se3 import Array
from slam.geometry.stamps import frame_range
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.naming import sequence_line
from slam.sequences.door import Masks, at_the_door
from slam.sequences.faults import FaultLog


@runtime_checkable
class Sequence(Protocol):
    """A stereo recording of any length: iterating it decodes one frame at a time, in constant memory.

    Recorded sequences keep this protocol, and so do the synthetic worlds.
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

    def __len__(self) -> int:
        """Number of listed frames; iterating yields fewer where left images turn out to be unreadable."""
        ...

    def __iter__(self) -> Iterator[StereoFrame]:
        """All frames in order of time."""
        ...

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Frames `start` up to, but without, `stop`; frames outside are not decoded.

        Raises:
            SequenceError: `start` is negative or not before the end, or `stop` is not after `start`.
        """
        ...


def is_live(frames: object) -> bool:
    """Whether frames come from a camera, which waits for nobody, does not end, and has no number of frames."""
    return bool(getattr(frames, "live", False))


#: An image as it was read, or why it could not be; None where there is none.
Image = np.ndarray | SequenceError | None

#: The left and the right image of each frame.
Images = Generator[tuple[Image, Image], None, None]


class FrameSource(Protocol):
    """Where a recorded sequence's images come from."""

    @property
    def stamps(self) -> Array:
        """Times of the frames (N,) [s], strictly increasing."""
        ...

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the left and right images of frames `start` to `stop`; they may end early, with a fault."""
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
    # a positions-only track (N, 4) of rows ``stamp [s], forward, right, third [m]``, good in the plane only; None where
    # there is none. It is no pose and in no camera's axes: compare positions after alignment
    gps: Array | None = None
    warnings: list[str] = field(default_factory=list)
    truth_noise: TruthNoise = field(default_factory=TruthNoise)  # how well the ground truth is known
    masks: Masks = (None, None)  # of both cameras, where their images may be used; see `slam.sequences.door`

    def __post_init__(self) -> None:
        if self.ground_truth is not None and self.rig.turns:
            truth, Q = self.ground_truth, np.eye(4)
            Q[:3, :3] = quarter_turn(-self.rig.turns)
            object.__setattr__(self, "ground_truth", Trajectory(truth.stamps, truth.poses @ Q))

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
        return self._read(*frame_range(start, stop, len(self)))

    def _read(self, start: int, stop: int) -> Iterator[StereoFrame]:
        """Decode lazily and sum up repeated faults at the end, also where the caller stops early.

        A left image that cannot be read costs the frame, a right one itself.
        """
        with FaultLog(self.warnings) as faults, closing(self.source.images(start, stop, faults)) as images:
            for index, (left, right) in zip(range(start, stop), images):
                if isinstance(right, SequenceError) and not isinstance(left, SequenceError):
                    line = f"frame {index} is given without its right image: {right}"
                    faults.report("right images unreadable, frames given without them", line)
                if isinstance(left, SequenceError):
                    faults.report("left images unreadable, frames skipped", f"frame {index} skipped: {left}")
                elif left is not None:
                    right = right if isinstance(right, np.ndarray) else None
                    yield at_the_door(StereoFrame(index, float(self.stamps[index]), left, right), self.rig, self.masks)
