"""Self-calibration: errors of the rig's calibration, estimated from the images alone, with their uncertainty.

docs/selfcalibration.md derives the estimator. May import `slam.geometry` and the data.
"""

from slam.calibration.config import SelfCalibrationConfig
from slam.calibration.estimator import RemainingRigError, SelfCalibration
from slam.calibration.model import Revision, RigCorrection, RigModel
from slam.calibration.posterior import RigPosterior
from slam.calibration.saved import SavedCalibration, load_calibration, save_calibration

__all__ = [
    "RemainingRigError",
    "Revision",
    "RigCorrection",
    "RigModel",
    "RigPosterior",
    "SavedCalibration",
    "SelfCalibration",
    "SelfCalibrationConfig",
    "load_calibration",
    "save_calibration",
]
