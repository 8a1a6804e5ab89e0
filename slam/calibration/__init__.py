"""Self-calibration: errors of the rig's calibration, estimated from the images alone, with their uncertainty.

docs/selfcalibration.md derives the estimator. May import `slam.geometry` and the data.
"""

from slam.calibration.config import SelfCalibrationConfig as SelfCalibrationConfig
from slam.calibration.estimator import RemainingRigError as RemainingRigError
from slam.calibration.estimator import SelfCalibration as SelfCalibration
from slam.calibration.model import Revision as Revision
from slam.calibration.model import RigCorrection as RigCorrection
from slam.calibration.model import RigModel as RigModel
from slam.calibration.posterior import RigPosterior as RigPosterior
from slam.calibration.saved import SavedCalibration as SavedCalibration
from slam.calibration.saved import load_calibration as load_calibration
from slam.calibration.saved import save_calibration as save_calibration
