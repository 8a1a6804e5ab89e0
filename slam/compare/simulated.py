"""A synthetic world's own features in place of a front end's: no image is made, so that trials take little time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slam.data import StereoFeatures, StereoFrame
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.stamps import frame_range
from slam.geometry.trajectory import Trajectory
from slam.worlds import WorldSequence
from slam.worlds.sequence import ObjectPoses
from slam.worlds.world import World


@dataclass(frozen=True)
class SimulatedFrontend:
    """Features straight from a world's landmarks, with its noise, misses and outliers; keeps the `Frontend` protocol.

    Attributes:
        world: the recording of the world.
    """

    world: WorldSequence

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """Features of the frame of this number; its images are not looked at."""
        return self.world.observations(frame.index)


@dataclass(frozen=True)
class WithoutImages:
    """A world whose frames have no images; keeps the `Sequence` protocol, whose texts hold here too.

    Attributes:
        recording: of the world.
    """

    recording: WorldSequence

    @property
    def name(self) -> str:
        """Short name."""
        return self.recording.name

    @property
    def format(self) -> str:
        """Name of the format."""
        return self.recording.format

    @property
    def rig(self) -> StereoRig:
        """The two cameras."""
        return self.recording.rig

    @property
    def kind(self) -> str:
        """Kind of motion."""
        return self.recording.kind

    @property
    def ground_truth(self) -> Trajectory:
        """The left camera's true path."""
        return self.recording.ground_truth

    @property
    def warnings(self) -> list[str]:
        """What was found wrong."""
        return self.recording.warnings

    @property
    def values(self) -> dict[str, object]:
        """The world's options, the seed among them."""
        return self.recording.values

    @property
    def world(self) -> World:
        """What is recorded."""
        return self.recording.world

    @property
    def stamps(self) -> Array:
        """Times of the frames (N,) [s]."""
        return self.recording.stamps

    def objects(self, k: int) -> ObjectPoses:
        """Poses of the moving objects in frame k."""
        return self.recording.objects(k)

    def object_ids(self, k: int) -> np.ndarray:
        """Which object each pixel of frame k's left image would show (H, W)."""
        return self.recording.object_ids(k)

    def __len__(self) -> int:
        return len(self.recording)

    def __iter__(self) -> Iterator[StereoFrame]:
        return self.frames()

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Numbers and stamps of frames, with images of one black pixel."""
        first, last = frame_range(start, stop, len(self))
        nothing = np.zeros((1, 1), np.uint8)
        for k in range(first, last):
            yield StereoFrame(k, float(self.recording.stamps[k]), nothing, None)
