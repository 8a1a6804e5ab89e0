"""A synthetic world's own features in place of a front end's: no image is made, so that trials take little time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.data import StereoFeatures, StereoFrame
from slam.geometry.stamps import frame_range
from slam.worlds import WorldSequence


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


class WithoutImages:
    """A world's recording whose frames have images of one black pixel; all else is that of the recording."""

    def __init__(self, recording: WorldSequence) -> None:
        self._recording = recording

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def __len__(self) -> int:
        return len(self._recording)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Numbers and stamps of frames."""
        nothing = np.zeros((1, 1), np.uint8)
        for k in range(*frame_range(start, stop, len(self))):
            yield StereoFrame(k, float(self._recording.stamps[k]), nothing, None)
