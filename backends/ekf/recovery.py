"""What the filter tries where most observations contradict its prediction.

Then the prediction is wrong, not the observations. There are three cases, tried in turn:

- It is so far off that its linearisation does not hold: the update is linearised where the matches agree on a pose.
- An impulse was larger than the motion model expects, or the camera turned as the Euler model cannot follow: the
  process noise is inflated.
- The filter is lost, after a long gap or a stretch with hardly anything to see: the landmarks agree on a pose that no
  impulse explains. The camera restarts there, in the same map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from scipy.special import bdtrc

from backends.ekf.solve import Gated, Posterior, UnsolvableError, Update, gate, solve
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.models import EstimatorModels
from slam.window.gating import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, share_by_chance

#: The pose (4, 4) on which landmarks agree, if there is one.
Search = Callable[[], "Array | None"]


def agreement(update: Update, noises: Iterable[Array], search: Search, models: EstimatorModels) -> Posterior | None:
    """Solve with the prior that most observations agree with; None where there is none.

    Where less than a third of the observations agrees, and as many wrong ones might agree by chance, that agreement is
    ignored: it could move the pose anywhere.

    Args:
        update: the update.
        noises: motion noises (12, 12) that may have been there in addition, smallest first.
        search: finds the pose on which the landmarks agree; only called where nothing else helps.
        models: how fast a camera may be that restarts.

    Raises:
        UnsolvableError: there is none, and the reason is numerical.
    """
    found, error = None, None
    try:
        wider, gated = _gated(update, noises)
        found = _agreed(wider, gated)
        if wider is not update and not _most(update, found):
            found = _agreed(update, gate(update)) or found  # they passed, but do not agree with each other
    except UnsolvableError as reason:
        error = reason
    if not _most(update, found):
        found = _restarted(update, search, models) or found
    if found is None and error is not None:
        raise error
    return found


def _most(update: Update, found: Posterior | None) -> bool:
    return found is not None and bool(2 * found.used.sum() >= len(update.z))


def _agreed(update: Update, gated: Gated) -> Posterior | None:
    """What agrees with a prediction, if it is more than might agree by chance at the gate's own level."""
    found = solve(update, gated)
    used, count = 0 if found is None else int(found.used.sum()), len(update.z)
    if count < MIN_OBSERVATIONS or ONE_AGREES_IN * used >= count:
        return found
    rejected = gated.distances[~gated.used & np.isfinite(gated.distances)]
    if not len(rejected):
        return None
    share = share_by_chance(rejected, float(gated.limits.max()))
    return None if bdtrc(used - 1, count, share) > 1 - update.gate_probability else found


def _gated(update: Update, noises: Iterable[Array]) -> tuple[Update, Gated]:
    """The update, with more noise and seen from the guess if most pass the gate only then, and its gate.

    What still disagrees is taken out later by `solve`.
    """
    first, count = gate(update), len(update.z)
    most = max(MIN_OBSERVATIONS, (count + 1) // 2)
    if count < most or first.used.sum() >= most:
        return update, first
    for noise in (None, *noises):
        wider = update if noise is None else update.wider(noise)
        for at_guess in (False,) if update.guess is None else (False, True):
            gated = gate(wider, at_guess) if wider is not update or at_guess else first
            if gated.used.sum() >= most:
                return wider, gated
    return update, first


def _restarted(update: Update, search: Search, models: EstimatorModels) -> Posterior | None:
    """With a camera that is where the landmarks say, wherever it was before; None where most do not agree with it."""
    least = max(MIN_CONSENSUS, (len(update.z) + 1) // 2)
    finite = math.isfinite(update.covariance.camera.trace() + update.covariance.marks.trace())
    T = search() if finite and len(update.z) >= least else None
    if T is None:
        return None
    there = replace(update, guess=T).wider(restart_noise(update.camera.pose, T, models))
    try:
        found = solve(there, gate(there, at_guess=True))
    except UnsolvableError:
        return None
    return found if found is not None and found.used.sum() >= least else None


def restart_noise(before: Array, after: Array, models: EstimatorModels) -> Array:
    """The noise (12, 12) of a camera that is at a pose (4, 4) instead of another, and whose speed is unknown."""
    far, turned = np.linalg.norm(after[:3, 3] - before[:3, 3]), se3.rotation_angle(before[:3, :3].T @ after[:3, :3])
    speeds = models.initial_velocity_sigma, models.initial_angular_velocity_sigma
    return np.diag(np.repeat(np.array([far, turned, *speeds], float) ** 2, 3))
