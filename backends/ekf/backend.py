"""The papers' filter, and what is changed in it by default (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from backends.ekf.filter import LandmarkFilter
from backends.ekf.landmarks import COORDINATES
from backends.ekf.motion import EulerCamera
from slam.bounds import from_options, require_not_negative
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels, SlideModel

MEASUREMENTS = ("stereo", "left")


@dataclass(frozen=True)
class EkfConfig:
    """Options of `EkfBackend`.

    Attributes:
        papers: closest to the papers' filter: the left pixel alone, one linearisation, landmarks in the world, all of
            them in the state, a covariance that is not transported, features that do not slide. No other option may be
            set then. What stays is the outlier test with readmission, the recovery, what a long gap does, and the
            angles' own world.
        measurement: ``"stereo"`` measures (uL, vL, uR), ``"left"`` the left pixel alone, as the papers do (paper A, V).
        iterations: most linearisations in an update; 1 is the papers' filter (paper A, Eq. 11). More are made only in
            updates where the first is not linear to within the noise.
        landmarks: coordinates of a landmark in the state: ``"inverse_depth"`` by the camera that saw it first, or
            ``"euclidean"`` in the world, as the papers do. See `backends.ekf.landmarks`.
        kept: most landmarks that keep their covariance with the camera and each other, besides those of a prior map and
            those that the last frame measured; of others, those that were measured longest ago leave the state. Null
            (in Python None) keeps all, as the papers do. See `backends.ekf.state.FilterState`.
        consistent: keep the unobservable pose of the whole map (where the world's origin is and which way it faces)
            from seeming to be measured: the covariance is transported to the corrected state after each update.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    papers: bool = False
    measurement: str = "stereo"
    iterations: int = 20
    landmarks: str = "inverse_depth"
    kept: int | None = 200
    consistent: bool = True

    def __post_init__(self) -> None:
        require_not_negative(self, {"iterations": (1, 1000), "kept": (0, 10**6)}, "ekf")
        if self.papers and replace(self, papers=False) != EkfConfig():
            raise ConfigurationError("ekf: papers=true chooses the other options itself; leave them out")
        for name, known in (("measurement", MEASUREMENTS), ("landmarks", tuple(COORDINATES))):
            if getattr(self, name) not in known:
                raise ConfigurationError(f"ekf: {name} must be one of {known}, got {getattr(self, name)!r}")


class EkfBackend(LandmarkFilter):
    """Extended Kalman filter over the camera's motion and the landmarks: the papers' state estimator, made consistent.

    The state is ``[r, φ, v, ω]`` (12), world position, Euler angles, world velocity and angle rates (paper B, section
    2), then three coordinates per landmark. The camera moves at constant velocity disturbed by impulses, with
    the printed W and, with ``papers=True``, the printed A (`backends.ekf.motion`). A landmark enters with its full
    cross-covariance (paper A, Eqs. 8 and 10).

    By default this is not the papers' plain filter: `EkfConfig` says what differs, and what ``papers=True`` undoes.
    The angles refer to a world of their own in both (`backends.ekf.motion`).

    Args:
        rig: the cameras, rectified.
        models: noise, priors, motion and gate.
        options: see `EkfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    name = "ekf"

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.config = from_options(EkfConfig, "ekf", options)
        use = self.config
        if use.papers:
            use = EkfConfig(measurement="left", iterations=1, landmarks="euclidean", kept=None, consistent=False)
            models = replace(models, slide=SlideModel())
        first = EulerCamera.first(models, use.consistent)
        stereo = use.measurement == "stereo"
        super().__init__(rig, models, first, COORDINATES[use.landmarks], use.iterations, use.kept, stereo)
