"""The measurement update, gated and iterated: what it makes of a prior. The filter's state is not changed here.

In the papers' order: the innovation (`backends.ekf.innovation`), the gate, the gain ``K = P Hᵀ S⁻¹``, the corrected
state ``x + K ν`` and its covariance ``P − K S Kᵀ`` (paper A, Eq. 11). What is kept is ``y = S⁻¹ ν``: the state changes
by ``P Hᵀ y``. From the inside out:

- `_iterated`: an iterated EKF's update by given landmarks.
- `_without_outliers`: takes out those that the others contradict.
- `gated_correction`: of those in the gate; then with those that the solution predicts after all.
- `_plausible`: none where so few agree as wrong observations may by chance.
- `correction`: linearised at the prior, at the caller's guess, or (`_restarted`) at a pose on which landmarks agree.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf

from backends.ekf.camera import from_body_axes, prior
from backends.ekf.covariance import CAMERA, HEAD, POSE
from backends.ekf.innovation import Correction, Linearisation, Update
from slam.data import BoolArray
from slam.geometry import se3
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array
from slam.window.gating import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, by_chance
from slam.window.recovery import Search

#: A step is the last where the measurements it predicts linearly are right to this share of their noise: `iterations`
#: are made only as long as they are not, in a long step or a fast camera's first. More would do harm: they move points
#: to where noisy pixels want them, and claim information that is not there (drives at 0.1: four times the NEES of 1.0).
_LINEAR = 1.0
#: Their errors together may move the pose by this share of its deviations: with a wide prior all have the same sign.
_POSE_SHARE = 0.25


def correction(update: Update, guess: Array | None, search: Search) -> Correction | None:
    """Solve with the prior, or where it fails the pose, that most observations agree with; None where there is none.

    If most observations contradict the prediction, it is the prediction that is wrong: by more than its linearisation
    holds for, so the guess, a pose (4, 4), is tried; or, after an impulse that the motion model does not expect, a gap,
    or a stretch with hardly anything to see, by more than it can be. Then the camera restarts where the landmarks see
    it, in the same map. An agreement of a minority counts only if nothing else is found; of two, the larger. `search`
    is only called where nothing else helps. Raises LinAlgError where the reason is numerical.
    """
    if not (np.isfinite(update.camera.pose).all() and math.isfinite(update.covariance.P.trace())):
        raise LinAlgError("the predicted state is not finite")
    minorities, error, majority = [], None, (len(update.z) + 1) // 2
    for camera in (update.camera, *(() if guess is None else (update.camera.at(guess),))):
        try:
            agreed = _plausible(update.linearised(camera))
        except LinAlgError as reason:  # another start may do
            error = reason
            continue
        if agreed is not None and agreed.used.sum() >= majority:
            return agreed
        minorities += [] if agreed is None else [agreed]
    found = _restarted(update, search, max(MIN_CONSENSUS, majority))
    if found is None and not minorities and error is not None:
        raise error
    return found or max(minorities, key=lambda one: one.used.sum(), default=None)


def _restarted(update: Update, search: Search, least: int) -> Correction | None:
    """At the pose on which landmarks agree, if at least so many do."""
    T = search() if len(update.z) >= least else None
    if T is None:
        return None
    before, there = update.camera.pose, update.regular_towards(T)
    far, turned = np.linalg.norm(T[:3, 3] - before[:3, 3]), se3.rotation_angle(before[:3, :3].T @ T[:3, :3])
    noise = from_body_axes(there.camera, prior(update.measure.models, (float(far), float(turned))))
    there = changed(there, covariance=there.covariance.camera_moved(np.eye(CAMERA), noise))
    with suppress(LinAlgError):
        found = gated_correction(there.linearised(there.camera.at(T)))
        return found if found is not None and found.used.sum() >= least else None
    return None


def _plausible(at: Linearisation) -> Correction | None:
    """What agrees with a prediction; None where it is less than a third, and as many wrong ones might agree by chance.

    Such an agreement could move the pose anywhere.
    """
    found, update = gated_correction(at), at.update
    agreed = np.zeros(len(at.h), bool) if found is None else found.used
    if len(agreed) < MIN_OBSERVATIONS or ONE_AGREES_IN * agreed.sum() >= len(agreed):
        return found
    return None if by_chance(update.z, agreed, at.distances, update.measure.models.gate_probability) else found


def gated_correction(at: Linearisation) -> Correction | None:
    """Solve with what passes the gate and agrees; then once more with what the solution predicts after all.

    None where nothing is left. Raises LinAlgError where S or the pose's covariance is not positive definite, or the
    new state not finite.
    """
    found = _with_readmitted(at)
    if found is not None:
        regular = at.update.regular_towards(found.camera.pose)
        if regular is not at.update:  # the coordinates of its error are nearly singular there
            found = _with_readmitted(regular.linearised(regular.camera.at(found.camera.pose)))
    if found is not None and dpotrf(found.pose_covariance, lower=1)[1] != 0:
        raise LinAlgError("the pose's covariance would not stay positive definite")
    return found


def _with_readmitted(at: Linearisation) -> Correction | None:
    """By the landmarks that each lie within the gate, and again where the solution predicts more."""
    found, limits = _without_outliers(at, at.distances <= at.update.limits), at.update.limits
    if found is not None:
        there = found.at.valid.any(axis=1) & np.isfinite(at.distances)
        more = ~found.used & there & (found.conditional_distances <= limits)
        found = (_without_outliers(at, found.used | more) or found) if more.any() else found
    return found


def _without_outliers(at: Linearisation, used: BoolArray) -> Correction | None:
    """Solve with some landmarks (mask (M,)), and take out what the other measurements contradict, the worst first.

    A wrong match spoils the tests of its neighbours, so a round takes out only landmarks at least half as far off as
    the worst one, until all that is left agrees; None where nothing is left.
    """
    while used.any():
        found = _iterated(at, used)
        used = found.used
        excess = np.where(used, found.conditional_distances / at.update.limits, 0.0)
        worst = excess.max()
        if worst <= 1:
            return found if used.any() else None
        used = used & (excess <= max(1.0, 0.5 * worst))
    return None


def _iterated(at: Linearisation, used: BoolArray) -> Correction:
    """An update by some landmarks (mask (M,)), first linearised as it is there, then at each solution (Gauss-Newton).

    One iteration is taken as it is: the papers' filter. What comes to lie behind the camera counts no more. Without the
    transport of the covariance this ends at the maximum of the posterior. With it H leaves out what would measure the
    gauge, and the end is off that by what is of second order in a step.
    """
    update, found = at.update, None
    for _ in range(update.iterations):
        if found is not None:
            at = update.linearised(found.camera, found.change[HEAD:])
        used = used & at.valid.any(axis=1)
        found = at.solved(used)
        if not np.isfinite(found.change).all() or np.abs((found.change - at.change)[3:6]).max() > np.pi:
            raise LinAlgError("a step is not finite, or turns the camera by more than half a turn")
        if update.iterations == 1 or _linear(found):
            return found
    assert found is not None  # there is one iteration at least
    return changed(found, linear=False)


def _linear(found: Correction) -> bool:
    """Whether the measurements change by a step as the Jacobian says, as far as the pose depends on it."""
    now, update = found.at, found.at.update
    step = (found.change - now.change)[update.indices]
    relative = step[POSE:].reshape(-1, 3) - now.N @ step[:POSE]
    errors = update.pixels_from(found.camera, found.change) - now.h - (now.H_landmark @ relative[:, :, None])[:, :, 0]
    errors = np.where(now.valid & found.used[:, None], errors, 0.0)
    if not np.abs(errors).max() < _LINEAR * update.sigma:
        return False
    shift = found.whitened(errors.reshape(-1)) @ found.whitened_pose
    return bool((shift**2 <= _POSE_SHARE**2 * found.pose_covariance.diagonal()).all())
