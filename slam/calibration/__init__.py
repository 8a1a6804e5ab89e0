"""The rig as something estimated: what its calibration is off by, from the images alone, with a posterior.

Imports data, rig and geometry; the system imports it. docs/selfcalibration.md derives the estimator.
"""

from slam.calibration.config import SelfCalibrationConfig
from slam.calibration.correction import Revision, RigCorrection
from slam.calibration.estimator import SelfCalibration
from slam.calibration.model import RigModel
from slam.calibration.posterior import RigPosterior

__all__ = ["Revision", "RigCorrection", "RigModel", "RigPosterior", "SelfCalibration", "SelfCalibrationConfig"]
