"""The rig's error remaining in a back end's estimate while self-calibration continues."""

from __future__ import annotations

from slam.calibration.consider import SchmidtFilter
from slam.calibration.correction import Revision
from slam.calibration.estimator import SelfCalibration
from slam.data import Estimate
from slam.interfaces import Backend, RevisingBackend
from slam.models import EstimatorModels
from slam.rig_error import CommonError


class RemainingRigError:
    """Tracks the corrections with which a back end's measurements and path were made, and their uncertainty.

    Args:
        calibration: the self-calibration.
        models: noise of the pixels, and of the motion.

    Attributes:
        uncertainty: what the rig's uncertainty adds to the covariances of poses and landmarks.
        measured_with: the correction of all measurements given to the back end.
    """

    def __init__(self, calibration: SelfCalibration, models: EstimatorModels) -> None:
        self._calibration = calibration
        self.measured_with = calibration.applied
        self.uncertainty = SchmidtFilter(calibration.model, models, self.measured_with.parameters)

    def apply(self, backend: Backend) -> Revision | None:
        """Correct features by the present posterior from now on; returns the change, or None.

        For a back end that can revise, a change means processing all its measurements again, so it waits until the
        change is significant.
        """
        # 0.5: Change of the correction, in standard deviations of the disparities' error, for a back end to revise
        # its past.
        return self._calibration.apply(0.5 if isinstance(backend, RevisingBackend) else 0.0)

    def revise(self, backend: Backend, restarted: bool) -> Revision | None:
        """Correct a back end's earlier measurements, if it can revise them; returns the change, or None.

        Args:
            backend: the present one.
            restarted: part of the path is an earlier back end's and cannot be revised.
        """
        applied, reviser = self._calibration.applied, backend if isinstance(backend, RevisingBackend) else None
        if not restarted and reviser is not None and reviser.revises_path:
            self.uncertainty.path_follows(applied.parameters)
        else:
            self.uncertainty.path_keeps(applied.parameters, backend.positions, landmarks_follow=reviser is not None)
        if reviser is None or applied is self.measured_with:
            return None
        revision = Revision(self.measured_with, applied)
        reviser.revise(revision.rows)
        self.measured_with = revision.after
        return revision

    def added_to(self, estimate: Estimate) -> Estimate:
        """The back end's estimate with the rig's uncertainty added."""
        if not self._calibration.config.enabled:
            return estimate
        return self.uncertainty.added_to(estimate, self._calibration.covariance)

    def common(self, as_reported: bool) -> CommonError:
        """The part of the pose's error that it shares with those of other frames.

        Args:
            as_reported: for poses as reported in each frame, with the correction of that time; else for the present
                path, in which a back end may have revised earlier poses.
        """
        if not self._calibration.config.enabled:
            return CommonError()
        made_with = self._calibration.applied.parameters if as_reported else self.uncertainty.kept
        return CommonError(*self.uncertainty.shared(self._calibration.covariance, made_with))
