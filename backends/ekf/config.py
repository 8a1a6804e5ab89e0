"""Options of the EKF back end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.errors import ConfigurationError

MEASUREMENTS = ("stereo", "left")
LANDMARKS = ("inverse_depth", "euclidean")

_MOST_ITERATIONS = 1000  # bound of a setting


@dataclass(frozen=True)
class EkfConfig:
    """Options of `EkfBackend`.

    Attributes:
        measurement: ``"stereo"`` measures (uL, vL, uR), ``"left"`` the left pixel alone, as the papers do (paper A, V).
        iterations: most linearisations in an update; 1 is the papers' filter (paper A, Eq. 11). More are made only in
            updates where the first is not linear to within the noise.
        landmarks: coordinates of a landmark in the state: ``"inverse_depth"`` by the camera that saw it first, or
            ``"euclidean"`` in the world, as the papers do. See `backends.ekf.landmarks`.
        consistent: keep the unobservable pose of the whole map (where the world's origin is and which way it faces)
            from seeming to be measured: the covariance is transported to the corrected state after each update. With
            stereo measurements only.

    The papers' filter is ``measurement="left", iterations=1, landmarks="euclidean"``, printed as it is there.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    measurement: str = "stereo"
    iterations: int = 5
    landmarks: str = "inverse_depth"
    consistent: bool = True

    def __post_init__(self) -> None:
        if self.measurement not in MEASUREMENTS:
            raise ConfigurationError(f"ekf: measurement must be one of {MEASUREMENTS}, got {self.measurement!r}")
        if self.landmarks not in LANDMARKS:
            raise ConfigurationError(f"ekf: landmarks must be one of {LANDMARKS}, got {self.landmarks!r}")
        if isinstance(self.iterations, bool) or not isinstance(self.iterations, int) or self.iterations < 1:
            raise ConfigurationError(f"ekf: iterations must be an integer of at least 1, got {self.iterations!r}")
        if self.iterations > _MOST_ITERATIONS:
            raise ConfigurationError(f"ekf: iterations must be at most {_MOST_ITERATIONS}, got {self.iterations}")
        if not isinstance(self.consistent, bool):
            raise ConfigurationError(f"ekf: consistent must be true or false, got {self.consistent!r}")
