"""Settings of the SURF front end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_not_negative
from slam.errors import ConfigurationError

_RANGES = {  # least and largest values
    "features": (1, 100_000),
    "threads": (1, 256),
    "octaves": (1, 4),
    "layers": (2, 3),
    "min_depth": (1e-6, 1e9),
    "max_depth": (1e-6, float("inf")),
    "epipolar": (0.1, 100.0),
}


@dataclass(frozen=True)
class SurfConfig:
    """Settings of the SURF front end, checked when made.

    Attributes:
        features: number of features aimed at in the left image.
        threshold: D_threshold (paper A, III.A) on OpenCV's scale for 8-bit images; a front end begins with it, and
            adapts it from frame to frame to keep the number of features.
        octaves: number of octaves, 1 to 4 (paper A: 2).
        layers: number of layers searched in each octave, 2 or 3.
        descriptor: dimensions of the descriptors, 16 (paper A, III.B) or 64.
        upright: features have no orientation; for cameras that do not roll.
        min_depth, max_depth: range of depths [m] looked for in stereo matching; max_depth may be infinite.
        epipolar: largest distance of the right pixel from the epipolar line [px].
        threads: number of threads; the results do not depend on it.

    Raises:
        ConfigurationError: a value is out of its range; the line names the key.
    """

    features: int = 800
    threshold: float = 300.0
    octaves: int = 2
    layers: int = 2
    descriptor: int = 64
    upright: bool = True
    min_depth: float = 0.3
    max_depth: float = float("inf")
    epipolar: float = 1.5
    threads: int = 2

    def __post_init__(self) -> None:
        require_not_negative(self, _RANGES, "surf")
        if self.descriptor not in (16, 64):
            raise ConfigurationError(f"surf: descriptor must be 16 or 64, got {self.descriptor}")
        if self.min_depth > self.max_depth:
            raise ConfigurationError(f"surf: min_depth {self.min_depth} lies above max_depth {self.max_depth}")
