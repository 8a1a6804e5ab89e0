"""The rig's error that is left in what a back end has estimated, while self-calibration goes on learning."""

from __future__ import annotations

from slam.calibration.consider import RigUncertainty
from slam.calibration.correction import Revision
from slam.calibration.estimator import SelfCalibration
from slam.data import Estimate
from slam.interfaces import Backend, RevisingBackend
from slam.models import EstimatorModels
from slam.rig_error import CommonError

#: Standard deviations of the disparities' error by which a correction must change for a back end to revise the past.
_REVISION = 0.5


class RemainingRigError:
    """Which corrections a back end's measurements and its path were made with, and how uncertain they are.

    Args:
        calibration: what is known of the rig.
        models: noise of the pixels, and of the motion.

    Attributes:
        uncertainty: what the rig's uncertainty adds to the covariances of poses and landmarks.
        given: the correction of all that the back end was given.
    """

    def __init__(self, calibration: SelfCalibration, models: EstimatorModels) -> None:
        self._calibration = calibration
        self.given = calibration.applied
        self.uncertainty = RigUncertainty(calibration.model, models, self.given.parameters)

    def apply(self, backend: Backend) -> Revision | None:
        """Correct features by what is known now; returns the change, None where there is none.

        A back end that can revise has to weigh all its measurements anew then: for it, that waits for a change that is
        significant.
        """
        return self._calibration.apply(_REVISION if isinstance(backend, RevisingBackend) else 0.0)

    def revise(self, backend: Backend, restarted: bool) -> Revision | None:
        """Correct what a back end was given before, if it can do that; returns the change, None where there is none.

        Args:
            backend: the present one.
            restarted: the path has a part of an earlier back end, which stays as it is.
        """
        applied, reviser = self._calibration.applied, backend if isinstance(backend, RevisingBackend) else None
        if not restarted and reviser is not None and reviser.revises_path:
            self.uncertainty.path_follows(applied.parameters)
        else:
            self.uncertainty.path_keeps(applied.parameters, backend.positions, landmarks_follow=reviser is not None)
        if reviser is None or applied is self.given:
            return None
        revision = Revision(self.given, applied)
        reviser.revise(revision.rows)
        self.given = revision.after
        return revision

    def added_to(self, estimate: Estimate) -> Estimate:
        """The back end's estimate with the rig's uncertainty, which it knows nothing of."""
        if not self._calibration.config.enabled:
            return estimate
        return self.uncertainty.added_to(estimate, self._calibration.posterior.covariance)

    def common(self, as_given: bool) -> CommonError:
        """The part of the pose's error that it shares with those of other frames.

        Args:
            as_given: of poses as they were given in each frame, by the correction of that time; else of the path as it
                is now, in which a back end may have revised earlier poses.
        """
        if not self._calibration.config.enabled:
            return CommonError()
        made_with = self._calibration.applied.parameters if as_given else self.uncertainty.kept
        return CommonError(*self.uncertainty.shared(self._calibration.posterior.covariance, made_with))
