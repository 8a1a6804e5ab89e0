"""Options of the smoother back end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.errors import ConfigurationError

_MOST = 1_000_000  # poses or landmarks
_LEAST_ERROR, _MOST_ERROR = 1e-9, 1e6  # [px]


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
        _require_whole(self.track, "track", 2)
        _require_whole(self.explicit, "explicit", 0)
        _require_whole(self.window, "window", 2)
        if self.lag is not None:
            _require_whole(self.lag, "lag", self.window)
        value = self.relinearise
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (number and (isinstance(value, int) or np.isfinite(value)) and value > 0):
            raise ConfigurationError(f"smoother: relinearise must be positive and finite, got {value!r}")
        if not _LEAST_ERROR <= value <= _MOST_ERROR:
            raise ConfigurationError(
                f"smoother: relinearise must lie between {_LEAST_ERROR:g} and {_MOST_ERROR:g}, got {value}"
            )


def _require_whole(value: object, name: str, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ConfigurationError(f"smoother: {name} must be an integer of at least {least}, got {value!r}")
    if value > _MOST:
        raise ConfigurationError(f"smoother: {name} must be at most {_MOST}, got {value}")
