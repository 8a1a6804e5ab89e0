"""Options of the smoother back end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_not_negative


@dataclass(frozen=True)
class SmootherConfig:
    """Options of `SmootherBackend`.

    Attributes:
        track: most poses that a smart factor spans; a landmark that is measured for longer continues in a new one. With
            a lag, no more than the lag and one: a factor ends before its first pose leaves.
        lag: number of poses with measurements before the newest one that are smoothed with it; older ones are
            marginalised, so that neither time nor memory grows with the run. Null (in Python None) keeps all and
            revises the whole path.
        landmarks: most landmarks that are variables of the graph. Where a frame measures no more than these, those that
            are measured for longer than a smart factor spans become variables, and keep what it says of them; but only
            while they are linear in space to less than a pixel's noise.
        past: number of poses before those of the lag, at least, whose measurements are kept (half as many poses more
            before they are thrown away): where landmarks are seen again, or measurements are mended, they say where
            those are.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    track: int = 20
    lag: int | None = 16
    landmarks: int = 20
    past: int = 50

    def __post_init__(self) -> None:
        ranges = {"track": (2, 10**6), "lag": (2, 10**6), "landmarks": (0, 10**6), "past": (0, 10**6)}
        require_not_negative(self, ranges, "smoother")
