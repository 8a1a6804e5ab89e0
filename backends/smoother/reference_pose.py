"""The reference pose, held in place in the bounded solver."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam.geometry.se3 import Array

_FIRMER = 1e4  # numerics: information with which a pose is held, as a multiple of what is known of it
_STRAIN = 0.25  # squared standard deviations


@dataclass(frozen=True, eq=False)
class ReferencePose:
    """A pose held by a prior much stronger than what is known of it, so that the whole problem does not drift.

    Measurements say next to nothing about where all variables together are in the world. With variables linearised at
    different values they seem to, and would move all of them. So the reference pose is held; when poses are
    marginalised it is released for a moment, with all variables linearised together.

    Attributes:
        key: its variable.
        T: where it is held (4, 4).
        information: what the marginalised part says of it (6, 6).
        covariance: its true covariance (6, 6), also given what is measured from the other poses.
    """

    key: int
    T: Array
    information: Array
    covariance: Array

    def with_covariance_from(self, P: Array) -> ReferencePose:
        """With its true covariance, from its covariance P (6, 6) in a solver that holds it.

        All variables are linearised at the same values there.
        """
        Q = np.linalg.inv(P) - _FIRMER * self.information
        Q = 0.5 * (Q + Q.T)
        return replace(self, covariance=np.linalg.inv(Q)) if np.linalg.eigvalsh(Q).min() > 0 else self

    def factor(self) -> gtsam.NonlinearFactor:
        """The prior that holds it."""
        noise = gtsam.noiseModel.Gaussian.Information(_FIRMER * self.information)
        return gtsam.PriorFactorPose3(self.key, gtsam.Pose3(self.T), noise)

    def is_strained(self, T: Array) -> bool:
        """Whether it would move by half a standard deviation if released, when its value is T (4, 4) now."""
        x = gtsam.Pose3.Logmap(gtsam.Pose3(self.T).between(gtsam.Pose3(T)))
        return bool(_FIRMER**2 * x @ self.information @ x > _STRAIN)

    def released(self, P: Array, by_held: Array, held: Array) -> Array:
        """A covariance P (..., n, n) as if the pose was not held.

        `by_held` (..., n, 6) is the covariance with the held pose, `held` (6, 6) the held pose's own in the solver.
        """
        Kt = np.linalg.solve(held, np.swapaxes(by_held, -1, -2))
        return np.asarray(P + np.swapaxes(Kt, -1, -2) @ (self.covariance - held) @ Kt)
