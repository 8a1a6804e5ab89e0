"""Runs a system's front end: from images to features, with timing and warnings about the input."""

from __future__ import annotations

from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from slam.data import StereoFeatures, StereoFrame
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry.rig import StereoRig
from slam.input.features import documented, outside_masks
from slam.input.warnings import InputWarnings, shows_something
from slam.interfaces import Frontend
from slam.models import EstimatorModels
from slam.runtime.compilation import Stages
from slam.runtime.threads import OneThread, one_blas_thread
from slam.third_party import named_failures


@dataclass(frozen=True, eq=False)
class Extracted:
    """A frame and what the front end found in it."""

    frame: StereoFrame  # as given, but for a right image that is a copy
    features: StereoFeatures
    milliseconds: dict[str, float]  # wall time of the extraction
    checksum: tuple[int, int] | None  # of the images, see `checksum_of`


def checksum_of(frame: StereoFrame) -> tuple[int, int] | None:
    """Checksums of the bytes of left and right image, by which repeated images are known; None if left shows nothing.

    Images of a camera that stands still differ by their noise.
    """
    left, right = (
        crc32(np.ascontiguousarray(image).data) if shows_something(image) else None
        for image in (frame.left, frame.right)
    )
    return None if left is None else (left, right or 0)


class Extractor:
    """Extracts features of frames, in one thread at a time, which may differ from the system's.

    The front end's settings give the largest row difference of left and right features.
    """

    def __init__(self, frontend: Frontend | None, rig: StereoRig, models: EstimatorModels) -> None:
        rows = getattr(getattr(frontend, "config", None), "epipolar", 1.5)  # [px]: as SURF, where it does not say
        self._rig, self.input_warnings = rig, InputWarnings(rig, models, rows)
        self._extracting = OneThread("this system's front end")

    @one_blas_thread
    def extract(self, frontend: Frontend | None, frame: StereoFrame) -> Extracted:
        """A frame with its features; where it raises, what is known of the frames before is unchanged.

        Raises ConfigurationError without a front end, MeasurementError where this is no frame or the features are not
        as documented, SequenceError as `InputWarnings`, SlamError where another thread is extracting or the front end
        failed.
        """
        if frontend is None:
            raise ConfigurationError("this system has no front end: use process_features")
        if not isinstance(frame, StereoFrame):
            raise MeasurementError(f"a frame must be a StereoFrame, got {type(frame).__name__}")
        stages = Stages()
        with self._extracting:
            checksum, copy = self.input_warnings.copied(frame, checksum_of(frame))
            used = replace(frame, right=None) if copy else frame
            with stages.stage("extract"), named_failures(f"frame {frame.index}", frontend):
                features = outside_masks(documented(frontend.extract(used), self._rig), used, self._rig)
            self.input_warnings.look(used, features)
            self.input_warnings.used(frame, checksum, copy)
        return Extracted(used, features, stages.milliseconds, checksum)
