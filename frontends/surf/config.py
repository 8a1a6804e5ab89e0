"""Settings of the SURF front end."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from slam.errors import ConfigurationError
from slam.options import from_options


@dataclass(frozen=True)
class SurfConfig:
    """Settings of the SURF front end, checked when made.

    Attributes:
        features: number of features aimed at in the left image.
        threshold: D_threshold at the start (paper A, III.A), on OpenCV's scale for 8-bit images.
        adaptive: adapt D_threshold from frame to frame to keep the number of features.
        min_threshold, max_threshold: limits of D_threshold in the adaptation.
        octaves: number of octaves, 1 to 4 (paper A: 2).
        layers: number of layers searched in each octave, 2 or 3.
        descriptor: dimensions of the descriptors, 16 (paper A, III.B) or 64.
        upright: features have no orientation; for cameras that do not roll.
        localise: find position and size in a continuous scale space: features stay in place when the image moves
            or grows, at some cost in time.
        grid: columns and rows of the grid over which features are spread; each cell has an equal share.
        min_depth, max_depth: range of depths [m] looked for in stereo matching; max_depth may be infinite.
        epipolar: largest distance of the right pixel from the epipolar line [px].
        min_correlation: least normalised correlation of the left and right image patches.
        uniqueness: largest ratio of ``1 - correlation`` of the best and the next best place on the epipolar line.
        threads: number of threads; the results do not depend on it.

    Raises:
        ConfigurationError: a value is out of its range; the line names the key.
    """

    features: int = 800
    threshold: float = 300.0
    adaptive: bool = True
    min_threshold: float = 5.0
    max_threshold: float = 20000.0
    octaves: int = 2
    layers: int = 2
    descriptor: int = 64
    upright: bool = True
    localise: bool = True
    grid: tuple[int, int] = (8, 5)
    min_depth: float = 0.3
    max_depth: float = float("inf")
    epipolar: float = 1.5
    min_correlation: float = 0.8
    uniqueness: float = 0.8
    threads: int = 2

    def __post_init__(self) -> None:
        for key, least, most in _RANGES:
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
                raise ConfigurationError(f"{key}: must be a number from {least} to {most}, not {value!r}")
        for key, choices in _CHOICES:
            if getattr(self, key) not in choices or isinstance(getattr(self, key), float):
                raise ConfigurationError(f"{key}: must be one of {choices}, not {getattr(self, key)!r}")
        grid = self.grid
        if not (isinstance(grid, (tuple, list)) and len(grid) == 2 and all(_is_count(n) for n in grid)):
            raise ConfigurationError(f"grid: must be two whole numbers of at least 1, not {grid!r}")
        if max(grid) > _MOST_CELLS:
            raise ConfigurationError(f"grid: at most {_MOST_CELLS} columns and rows, not {grid!r}")
        object.__setattr__(self, "grid", (int(grid[0]), int(grid[1])))
        for key in ("features", "threads"):
            if not _is_count(getattr(self, key)):
                raise ConfigurationError(f"{key}: must be a whole number of at least 1, not {getattr(self, key)!r}")
        if self.min_threshold > self.max_threshold:
            raise ConfigurationError(
                f"min_threshold: {self.min_threshold} lies above max_threshold {self.max_threshold}"
            )
        if self.min_depth >= self.max_depth:
            raise ConfigurationError(f"min_depth: {self.min_depth} does not lie below max_depth {self.max_depth}")

    @classmethod
    def with_options(cls, config: SurfConfig | None = None, **options: Any) -> SurfConfig:
        """A configuration (by default the default one) with some of its values replaced.

        Raises:
            ConfigurationError: an option is not known or out of its range.
        """
        base = {} if config is None else {f.name: getattr(config, f.name) for f in fields(cls)}
        return from_options(cls, "surf", {**base, **options})


_MOST_CELLS = 1000  # guard: bound of a setting

_RANGES = (
    ("features", 1, 100_000),
    ("threads", 1, 256),
    ("threshold", 0.0, 1e9),
    ("min_threshold", 0.0, 1e9),
    ("max_threshold", 0.0, 1e9),
    ("min_depth", 1e-6, 1e9),
    ("max_depth", 1e-6, float("inf")),
    ("epipolar", 0.1, 100.0),
    ("min_correlation", 0.0, 1.0),
    ("uniqueness", 0.0, 1.0),
)
_CHOICES: tuple[tuple[str, tuple[Any, ...]], ...] = (
    ("adaptive", (True, False)),
    ("octaves", (1, 2, 3, 4)),
    ("layers", (2, 3)),
    ("descriptor", (16, 64)),
    ("upright", (True, False)),
    ("localise", (True, False)),
)


def _is_count(value: Any) -> bool:
    """A whole number of at least 1?"""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and int(value) >= 1
