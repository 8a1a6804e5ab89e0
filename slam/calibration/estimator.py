"""The self-calibration: learns the rig's error while the system runs, and corrects pixels by it."""

from __future__ import annotations

from typing import Any

import numpy as np

from slam.calibration.config import SelfCalibrationConfig
from slam.calibration.correction import Revision, RigCorrection
from slam.calibration.evidence import Accumulator
from slam.calibration.model import RigModel
from slam.calibration.motion import pair_evidence, parallax
from slam.calibration.posterior import RigPosterior, solve
from slam.calibration.prior import prior_information
from slam.calibration.rows import row_evidence
from slam.calibration.views import View, match, pair_of
from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array

_BLOCK_OF_ROWS, _BLOCK_OF_PAIRS = 8, 4  # frames, pairs: times over which errors are surely correlated
_MOST_ROWS = 250  # of a frame: more say little more


class SelfCalibration:
    """The rig's error: its posterior, and the view that waits for a partner.

    Args:
        rig: the cameras.
        config: settings.

    Attributes:
        pairs: number of pairs of views that the posterior rests on.
        unsolved: number of pairs for which no motion was found.
    """

    def __init__(self, rig: StereoRig, config: SelfCalibrationConfig) -> None:
        self.rig = rig
        self.config = config
        self.model = RigModel(rig)
        n = len(self.model.names)
        self._prior = prior_information(self.model, config.prior_scale)
        self._rows = Accumulator(n, config.inflation, _BLOCK_OF_ROWS)
        self._motion = Accumulator(n, config.inflation, _BLOCK_OF_PAIRS)
        self._mean, self._covariance = np.zeros(n), np.linalg.inv(self._prior)
        self._first: View | None = None
        self._seen = 0
        self.unsolved = 0
        self.applied = RigCorrection(self.model, np.zeros(n))

    @property
    def pairs(self) -> int:
        """Number of pairs of views that the posterior rests on."""
        return self._motion.count

    @property
    def posterior(self) -> RigPosterior:
        """What is believed of the rig's error now."""
        model = self.model
        covariance = self._covariance.copy()
        for name in ("right_cx", "right_cy"):
            i = model.names.index(name)
            covariance[i, i] += (self.config.systematic / model.focal) ** 2
        return RigPosterior(model.names, model.units, self._mean.copy(), covariance)

    def apply(self, least: float = 0.0) -> Revision | None:
        """Correct features by what is known now; returns the change, None where there is none.

        Nothing is corrected before motion has been seen: rows alone say too little of the disparity. Where disparities
        would change by less than `least` standard deviations (root mean square over the image), features are corrected
        as before.
        """
        step = self._mean - self.applied.parameters
        if not self.config.enabled or not self.pairs or not step.any():
            return None
        if least:
            far = self.model.field(self._far())[:, 2]
            variance = np.einsum("ni,ij,nj->n", far, self.posterior.covariance, far).mean()
            if np.square(far @ step).mean() <= least**2 * variance:
                return None
        before, self.applied = self.applied, RigCorrection(self.model, self._mean.copy())
        return Revision(before, self.applied)

    def correct(self, features: StereoFeatures) -> StereoFeatures:
        """Features with the applied correction."""
        if not self.config.enabled or not self.applied.parameters.any():
            return features
        return self.applied.features(features)

    def observe(self, features: StereoFeatures, T_world_left: Array) -> None:
        """Learn from one frame.

        Args:
            features: of the frame as measured, not corrected.
            T_world_left: the left camera's pose (4, 4) as the system has it; a first guess.
        """
        if not self.config.enabled:
            return
        view = View.of(self.model, features, T_world_left)
        self._seen += 1
        if len(view) < self.config.minimum_common:
            return
        some = np.linspace(0, len(view) - 1, min(len(view), _MOST_ROWS)).astype(int)
        self._rows.add(row_evidence(self.model, view.points[some], view.vertical[some], self._mean))
        if self._first is None:
            self._first = view
            return
        common = len(match(self._first, view)[0])
        if common > max(self.config.kept_share * len(self._first), self.config.minimum_common):
            return
        if common >= self.config.minimum_common:
            self._learn(self._first, view)
        self._first = view

    def summary(self) -> dict[str, Any]:
        """What has been found, as plain types: the posterior without the residual fields, and what it rests on."""
        posterior = self.posterior.marginal(self.model.physical)
        return {"pairs": self.pairs, "unsolved_pairs": self.unsolved, **posterior.to_json()}

    def _learn(self, first: View, second: View) -> None:
        """Bayes' rule with what a pair of views and all rows so far say."""
        c = self.config
        pair = pair_of(self.model, first, second, self._mean, self._seen)
        if len(pair.first) < c.minimum_common:
            self.unsolved += 1
            return
        if parallax(self.model, pair) < c.minimum_parallax:
            return
        evidence = pair_evidence(self.model, pair, self._mean, c.pixel_sigma, c.disparity_sigma)
        if evidence is None:
            self.unsolved += 1
            return
        self._motion.add(evidence)
        for part in (self._rows, self._motion):
            part.judge(self._mean, self._covariance)
        self._mean, self._covariance = solve(self._prior, [self._rows.total(), self._motion.total()])

    def _far(self) -> Array:
        """Far points (N, 3) [px] spread over the image."""
        grid = self.model.grid()
        return np.column_stack([self.model.focal * grid, np.zeros(len(grid))])
