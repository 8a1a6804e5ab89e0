"""Self-calibration: errors of the rig's calibration, estimated from the images alone, with their uncertainty.

docs/selfcalibration.md derives the estimator. May import `slam.geometry` and the data.
"""

from slam.calibration.config import SelfCalibrationConfig
from slam.calibration.correction import Revision, RigCorrection
from slam.calibration.estimator import SelfCalibration
from slam.calibration.kept import KeptCalibration, load_calibration, save_calibration
from slam.calibration.model import RigModel
from slam.calibration.posterior import RigPosterior
from slam.calibration.remaining import RemainingRigError

__all__ = [
    "KeptCalibration",
    "RemainingRigError",
    "Revision",
    "RigCorrection",
    "RigModel",
    "RigPosterior",
    "SelfCalibration",
    "SelfCalibrationConfig",
    "load_calibration",
    "save_calibration",
]
