"""The reference pose, held in the solver while poses leave it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam.geometry.se3 import Array

_FIRMER = 1e4  # numerics: information with which a pose is held, as a multiple of what is known of it
_PULLED = 0.25  # squared standard deviations


@dataclass(frozen=True)
class Held:
    """A pose that is held much firmer than it is known, so that the others do not move through the world with it.

    What is measured says next to nothing of where all variables stand together in the world. What it seems to say,
    where not all of them were linearised at the same values, would move them about. So the reference pose is held, and
    let go for a moment when poses leave: then all are linearised together.

    Attributes:
        key: its variable.
        T: where it is held (4, 4).
        information: what is known of it by all that left (6, 6).
        covariance: what is known of it in truth, by what is measured from the others as well (6, 6).
    """

    key: int
    T: Array
    information: Array
    covariance: Array

    def informed(self, P: Array) -> Held:
        """With the truth from its covariance P (6, 6) in a solver that holds it, all linearised at the same values."""
        Q = np.linalg.inv(P) - _FIRMER * self.information
        Q = 0.5 * (Q + Q.T)
        return replace(self, covariance=np.linalg.inv(Q)) if np.linalg.eigvalsh(Q).min() > 0 else self

    def factor(self) -> gtsam.NonlinearFactor:
        """What holds it."""
        noise = gtsam.noiseModel.Gaussian.Information(_FIRMER * self.information)
        return gtsam.PriorFactorPose3(self.key, gtsam.Pose3(self.T), noise)

    def pulled(self, T: Array) -> bool:
        """Whether it would move by a good part of its standard deviation if let go, when it stands at T (4, 4) now."""
        x = gtsam.Pose3.Logmap(gtsam.Pose3(self.T).between(gtsam.Pose3(T)))
        return bool(_FIRMER**2 * x @ self.information @ x > _PULLED)

    def let_go(self, P: Array, by_held: Array, held: Array) -> Array:
        """A covariance P (..., n, n) as it is while the pose is not held.

        `by_held` (..., n, 6) is the covariance with the held pose, `held` (6, 6) the held pose's own in the solver.
        """
        Kt = np.linalg.solve(held, np.swapaxes(by_held, -1, -2))
        return np.asarray(P + np.swapaxes(Kt, -1, -2) @ (self.covariance - held) @ Kt)
