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
        explicit: how many landmarks in view at most become variables of their own when their smart factor is finished;
            they tie the trajectory together over any time. The others go on in a new smart factor.
        relinearise: error of linearised pixels beyond which a variable is linearised anew [px], approximately: in
            every tenth frame; ten times as much in the others, next to nothing when the whole path or map is asked for.
        window: poses whose joint covariance is asked for in every frame; what is older is taken to move with them.
        lag: poses that stay variables, at least; what is older is marginalised, so that neither time nor memory grows
            with the run. Null (in Python None) keeps all of them and revises the whole path.

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
