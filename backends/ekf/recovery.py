"""What the filter tries where most observations contradict its prediction.

Then the prediction is wrong, not the observations. There are two cases, tried in turn:

- It is so far off that its linearisation does not hold: the update is linearised where the matches agree on a pose.
- The filter is lost, by an impulse that the motion model does not expect, a long gap, or a stretch with hardly anything
  to see: the landmarks agree on a pose that the prediction excludes. The camera restarts there, in the same map.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.linalg import LinAlgError

from backends.ekf.covariance import CAMERA
from backends.ekf.innovation import Solution, Update
from backends.ekf.solve import Gated, gate, solve
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.window.gating import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, by_chance

#: The pose (4, 4) on which landmarks agree, if there is one.
Search = Callable[[], "Array | None"]


def agreement(update: Update, guess: Array | None, search: Search) -> Solution | None:
    """Solve with the prior, or where it fails the pose, that most observations agree with; None where there is none.

    It is linearised at the prior, then at the guess, a pose (4, 4), if there is one. Where less than a third of the
    observations agrees, and as many wrong ones might agree by chance, that agreement is ignored: it could move the pose
    anywhere. An agreement of a minority counts only if nothing else is found; of two, the larger. `search` is only
    called where nothing else helps. Raises LinAlgError where the reason is numerical.
    """
    if not (np.isfinite(update.camera.pose).all() and math.isfinite(update.covariance.P.trace())):
        raise LinAlgError("the predicted state is not finite")
    minorities, error, majority = [], None, (len(update.z) + 1) // 2
    for T in (None,) if guess is None else (None, guess):
        try:
            agreed = _agreed(gate(update, T))
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


def _restarted(update: Update, search: Search, least: int) -> Solution | None:
    """At the pose on which landmarks agree, if at least so many do."""
    T = search() if len(update.z) >= least else None
    if T is None:
        return None
    models, before = update.measure.models, update.camera.pose
    far, turned = np.linalg.norm(T[:3, 3] - before[:3, 3]), se3.rotation_angle(before[:3, :3].T @ T[:3, :3])
    sigmas = far, turned, models.initial_velocity_sigma, models.initial_angular_velocity_sigma
    there, noise = update.facing(T), np.diag(np.repeat(np.array(sigmas, float) ** 2, 3))
    noise = there.camera.of_body(noise)
    there = replace(there, covariance=there.covariance.camera_moved(np.eye(CAMERA), noise))
    with suppress(LinAlgError):
        found = solve(gate(there, T))
        return found if found is not None and found.used.sum() >= least else None
    return None


def _agreed(gated: Gated) -> Solution | None:
    """What agrees with a prediction, if it is more than might agree by chance at the gate's own level."""
    found = solve(gated)
    agreed = np.zeros_like(gated.used) if found is None else found.used
    if len(agreed) < MIN_OBSERVATIONS or ONE_AGREES_IN * agreed.sum() >= len(agreed):
        return found
    update = gated.at.update
    chance = by_chance(update.z, agreed, gated.distances, update.measure.models.gate_probability)
    return None if chance else found
