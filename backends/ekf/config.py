"""Options of the EKF back end."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_positive
from slam.errors import ConfigurationError

MEASUREMENTS = ("stereo", "left")
LANDMARKS = ("inverse_depth", "euclidean")


@dataclass(frozen=True)
class EkfConfig:
    """Options of `EkfBackend`.

    Attributes:
        papers: the papers' own filter, printed as it is there: the left pixel alone, one linearisation, landmarks in
            the world, a covariance that is not transported. The other options do not count then.
        measurement: ``"stereo"`` measures (uL, vL, uR), ``"left"`` the left pixel alone, as the papers do (paper A, V).
        iterations: most linearisations in an update; 1 is the papers' filter (paper A, Eq. 11). More are made only in
            updates where the first is not linear to within the noise.
        landmarks: coordinates of a landmark in the state: ``"inverse_depth"`` by the camera that saw it first, or
            ``"euclidean"`` in the world, as the papers do. See `backends.ekf.landmarks`.
        consistent: keep the unobservable pose of the whole map (where the world's origin is and which way it faces)
            from seeming to be measured: the covariance is transported to the corrected state after each update. With
            stereo measurements only.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    papers: bool = False
    measurement: str = "stereo"
    iterations: int = 5
    landmarks: str = "inverse_depth"
    consistent: bool = True

    def __post_init__(self) -> None:
        require_positive(self, {"iterations": (1, 1000)}, "ekf")
        for name, known in (("measurement", MEASUREMENTS), ("landmarks", LANDMARKS)):
            if getattr(self, name) not in known:
                raise ConfigurationError(f"ekf: {name} must be one of {known}, got {getattr(self, name)!r}")

    def resolved(self) -> EkfConfig:
        """The options that count: those of the papers' filter where it is asked for."""
        if self.papers:
            return EkfConfig(True, "left", 1, "euclidean", False)
        return self
