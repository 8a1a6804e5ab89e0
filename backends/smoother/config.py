"""Options of the smoother back end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_not_negative


@dataclass(frozen=True)
class SmootherConfig:
    """Options of `SmootherBackend`.

    Attributes:
        motion: median displacement of the landmarks in the image, as a share of the focal length, from which on a frame
            becomes a pose of the graph; 0 takes every measured frame.
        overlap: a frame also becomes one if less than this share of its landmarks was measured from the last one.
        track: most poses that a smart factor spans; a landmark that is measured for longer continues in a new one. With
            a lag, a factor ends before its first pose leaves.
        lag: number of poses that are smoothed; older ones are marginalised, so that neither time nor memory grows
            with the run. Null (in Python None) keeps all poses and revises the whole path.
        landmarks: most landmarks that are variables of the graph: those that are measured for longer than a smart
            factor spans keep what it says of them in this way, for as long as they are in the map.
        past: number of poses, at least, whose measurements are kept, to revise the path when measurements are mended.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    motion: float = 0.02
    overlap: float = 0.9
    track: int = 20
    lag: int | None = 16
    landmarks: int = 20
    past: int = 50

    def __post_init__(self) -> None:
        ranges = {"motion": (0, 10), "overlap": (0, 1), "track": (2, 10**6), "lag": (2, 10**6), "past": (0, 10**6)}
        ranges["landmarks"] = (0, 10**6)
        require_not_negative(self, ranges, "smoother")
