"""The measurement update, gated and iterated: what it makes of a prior. The filter's state is not changed here.

In the papers' order: the innovation (`backends.ekf.innovation`), the gate, the gain ``K = P Hᵀ S⁻¹``, the corrected
state ``x + K ν`` and its covariance ``P − K S Kᵀ`` (paper A, Eq. 11). What is kept is ``y = S⁻¹ ν``: the state changes
by ``P Hᵀ y``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf

from backends.ekf.covariance import HEAD, POSE
from backends.ekf.innovation import Linearisation, Solution, Update, diagonal_blocks
from slam.data import BoolArray
from slam.geometry.se3 import Array
from slam.window.gating import squared_distances

#: A step is the last where the measurements it predicts linearly are right to this share of their noise. Iterating
#: further than needed does harm: it moves points to where noisy pixels want them, and claims information that is not
#: there (drives at 0.1: four times the NEES of 1.0). A long step, or a fast camera's first, cannot do without.
_LINEAR = 1.0
#: Their errors together may move the pose by this share of its deviations: with a wide prior all have the same sign.
_POSE_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Gated:
    """Which landmarks each lie within the gate of their own innovation covariance."""

    used: BoolArray  # (M,)
    limits: Array  # of the gate (M,)
    distances: Array  # squared, of the innovations (M,); NaN where none is predicted
    at: Linearisation  # where they are from


def gate(update: Update, T: Array | None = None) -> Gated:
    """Test each landmark by itself, with its innovation linearised at the prior, or with the camera at a pose T (4, 4).

    Raises LinAlgError where S is not positive definite.
    """
    at = update.linearised(None if T is None else update.camera.at(T))
    limits = update.measure.limits(update.z)
    own = squared_distances(at.nu.reshape(-1, 3), diagonal_blocks(at.S))
    if not np.isfinite(own).all():
        raise LinAlgError("the predicted innovations are not finite or not positive definite")
    distances = np.where(np.isfinite(at.z).all(axis=1), own, np.nan)
    return Gated(np.asarray(distances <= limits), limits, distances, at)


def solve(gated: Gated) -> Solution | None:
    """Solve with what passed the gate and agrees; then once more with what the solution predicts after all.

    None where nothing is left. Raises LinAlgError where S or the pose's covariance is not positive definite, or the
    new state not finite.
    """
    found, update = _with_readmitted(gated), gated.at.update
    if found is not None:
        faced = update.facing(found.camera.pose)
        if faced is not update:  # the coordinates of its error are nearly singular there
            found, update = _with_readmitted(gate(faced, found.camera.pose)), faced
    if found is not None and dpotrf(found.pose_covariance, lower=1)[1] != 0:
        raise LinAlgError("the pose's covariance would not stay positive definite")
    return found


def _with_readmitted(gated: Gated) -> Solution | None:
    """With what passed the gate, and again where the solution predicts more."""
    found = _agreeing(gated, gated.used)
    if found is not None:
        there = found.at.seen.any(axis=1) & np.isfinite(gated.distances)
        more = ~found.used & there & (found.distances <= gated.limits)
        found = (_agreeing(gated, found.used | more) or found) if more.any() else found
    return found


def _agreeing(gated: Gated, used: BoolArray) -> Solution | None:
    """Solve with some landmarks (mask (M,)), and take out what the other measurements contradict, the worst first.

    A wrong match spoils the tests of its neighbours, so a round takes out only landmarks at least half as far off as
    the worst one, until all that is left agrees; None where nothing is left.
    """
    while used.any():
        found = _iterate(gated.at, used)
        used = found.used
        excess = np.where(used, found.distances / gated.limits, 0.0)
        worst = excess.max()
        if worst <= 1:
            return found if used.any() else None
        used = used & (excess <= max(1.0, 0.5 * worst))
    return None


def _iterate(at: Linearisation, used: BoolArray) -> Solution:
    """An update by some landmarks (mask (M,)), first linearised as it is there, then at each solution (Gauss-Newton).

    One iteration is taken as it is: the papers' filter.
    What comes to lie behind the camera counts no more. Without the transport of the covariance this ends at the maximum
    of the posterior. With it H leaves out what would measure the gauge, and the end is off that by what is of second
    order in a step.
    """
    update, found = at.update, None
    for _ in range(update.iterations):
        if found is not None:
            at = update.linearised(found.camera, found.change[HEAD:])
        used = used & at.seen.any(axis=1)
        found = at.solved(used)
        if not np.isfinite(found.change).all() or np.abs((found.change - at.change)[3:6]).max() > np.pi:
            raise LinAlgError("a step is not finite, or turns the camera by more than half a turn")
        if update.iterations == 1 or _linear(found):
            return found
    assert found is not None  # there is one iteration at least
    return replace(found, linear=False)


def _linear(found: Solution) -> bool:
    """Whether the measurements change by a step as the Jacobian says, as far as the pose depends on it."""
    now, update = found.at, found.at.update
    step = (found.change - now.change)[update.numbers]
    seen = step[POSE:].reshape(-1, 3) - now.lever @ step[:POSE]
    errors = update.predicted(found.camera, found.change) - now.z - (now.own @ seen[:, :, None])[:, :, 0]
    errors = np.where(now.seen & found.used[:, None], errors, 0.0)
    if not np.abs(errors).max() < _LINEAR * update.sigma:
        return False
    shift = found.weighted(errors.reshape(-1)) @ now.HP[:, :POSE]
    return bool((shift**2 <= _POSE_SHARE**2 * found.pose_covariance.diagonal()).all())
