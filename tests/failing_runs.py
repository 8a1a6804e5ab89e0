"""For runs that end badly: a sequence of features that breaks, and a front end that gives them."""

from collections.abc import Iterator

import numpy as np

from slam.data import StereoFeatures, StereoFrame
from tests.fuzz.harness import scene

FRAMES = 5


class Scripted:
    """A sequence of features without images, that may end in an error or an interrupt."""

    name, format, kind = "scripted", "test", "handheld"
    ground_truth = None

    def __init__(self, error: BaseException | None, at: int) -> None:
        self.rig, self.features = scene()
        self.warnings: list[str] = []
        self._error, self._at = error, at

    def __len__(self) -> int:
        return FRAMES

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        for k in range(FRAMES):
            if self._error is not None and k == self._at:
                raise self._error
            yield StereoFrame(k, 0.0, np.zeros((0, 0), np.uint8), None)


class Features:
    """Gives the features of a frame by its number."""

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        return scene()[1][frame.index]
