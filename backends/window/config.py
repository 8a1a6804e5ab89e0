"""Options of the window back end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_not_negative


@dataclass(frozen=True)
class WindowConfig:
    """Options of `WindowBackend`.

    Attributes:
        poses: number of poses whose measurements are kept and linearised again with every frame.
        reference: frames after which another pose becomes the one that the marginal prior is relative to.
        lag: least number of poses that are revised with what later frames measure; older ones are final.
        landmarks: most landmarks that keep their covariance with the poses once the first pose that saw them has left.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    poses: int = 8
    reference: int = 10
    lag: int = 50
    landmarks: int = 100

    def __post_init__(self) -> None:
        ranges = {"poses": (3, 10**3), "reference": (1, 10**6), "lag": (0, 10**5), "landmarks": (0, 10**5)}
        require_not_negative(self, ranges, "window")
