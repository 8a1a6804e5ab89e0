"""Options of the smoother back end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_not_negative


@dataclass(frozen=True)
class SmootherConfig:
    """Options of `SmootherBackend`.

    Attributes:
        track: observations after which a landmark's smart factor is finished; each landmark's own limit lies between
            `track` and twice that, so that no frame finishes them all.
        explicit: most landmarks in view that become variables of their own when their smart factor is finished;
            they constrain the trajectory over any length of time. The others continue in a new smart factor.
        relinearise: error of linearised pixels beyond which a variable is relinearised [px], approximately: in
            every tenth frame. Ten times as much in the other frames; nearly zero when the whole path or map is
            requested.
        window: poses whose joint covariance is computed in every frame; older ones are taken as fixed to the oldest.
        lag: least number of poses that stay variables. Older ones are marginalised, so that neither time nor memory
            grows with the run. Null (in Python None) keeps all poses and revises the whole path.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    track: int = 10
    explicit: int = 300
    relinearise: float = 0.01
    window: int = 12
    lag: int | None = 50

    def __post_init__(self) -> None:
        ranges = {"track": (2, 10**6), "explicit": (0, 10**6), "relinearise": (1e-9, 10**6), "window": (2, 10**6)}
        require_not_negative(self, {**ranges, "lag": (self.window, 10**6)}, "smoother")
