"""The right-invariant EKF as a form of the filter that `backends.ekf` runs: another camera, another error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from backends.ekf.filter import EkfBackend, Form
from backends.ekf.landmarks import InverseDepth
from backends.iekf.camera import InvariantCamera
from slam.bounds import from_options, require_positive
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels


@dataclass(frozen=True)
class IekfConfig:
    """Options of `IekfBackend`.

    Attributes:
        iterations: most linearisations in an update; 1 is the filter of the literature. More are made only in updates
            where the first is not linear to within the noise.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    iterations: int = 5

    def __post_init__(self) -> None:
        require_positive(self, {"iterations": (1, 1000)}, "iekf")


def IekfBackend(rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> EkfBackend:  # noqa: B008
    """Right-invariant extended Kalman filter over the camera's motion and the landmarks.

    Gate, update, iteration, recovery, and the landmarks that leave the dense state are those of `backends.ekf`; what is
    its own is the motion on SO(3) instead of Euler angles, and the invariant error, for which no covariance has to be
    transported (`backends.iekf.camera` says why). A landmark that leaves the dense state takes its error in the world
    as it is with it, and comes back to the invariant one.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        options: see `IekfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """
    return EkfBackend(rig, models, form=_form, **options)


def _form(models: EstimatorModels, options: dict[str, Any]) -> Form:
    config = from_options(IekfConfig, "iekf", options)
    camera, P = InvariantCamera.first(models)
    return Form("iekf", config, camera, P, InverseDepth(), config.iterations)
