"""What the filter tries where most observations contradict its prediction.

Then the prediction is wrong, not the observations. There are three cases, tried in turn:

- It is so far off that its linearisation does not hold: the update is linearised where the matches agree on a pose.
- An impulse was larger than the motion model expects, or the camera turned as the Euler model cannot follow: the
  process noise is inflated.
- The filter is lost, after a long gap or a stretch with hardly anything to see: the landmarks agree on a pose that no
  impulse explains. The camera restarts there, in the same map.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from backends.ekf.solve import Gated, Posterior, UnsolvableError, Update, gate, solve
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.window.gating import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, by_chance

#: The pose (4, 4) on which landmarks agree, if there is one.
Search = Callable[[], "Array | None"]


def agreement(update: Update, noises: Iterable[Array], search: Search) -> Posterior | None:
    """Solve with the prior that most observations agree with; None where there is none.

    Where less than a third of the observations agrees, and as many wrong ones might agree by chance, that agreement is
    ignored: it could move the pose anywhere. `noises` are motion noises (12, 12) that may have been there in addition,
    smallest first; `search` is only called where nothing else helps. Raises UnsolvableError where the reason is
    numerical.
    """
    found, error, majority = None, None, (len(update.z) + 1) // 2
    try:
        for gated in _gated(update, noises, max(MIN_OBSERVATIONS, majority)):
            try:
                found = _agreed(gated) or found
            except UnsolvableError as reason:
                error = reason
            if found is not None and found.used.sum() >= majority:
                return found
    except UnsolvableError as reason:  # of the prior itself
        error = reason
    least = max(MIN_CONSENSUS, majority)
    finite = math.isfinite(update.covariance.camera.trace() + update.covariance.marks.trace())
    T = search() if finite and len(update.z) >= least else None
    if T is not None:
        models, before = update.measure.models, update.camera.pose
        far, turned = np.linalg.norm(T[:3, 3] - before[:3, 3]), se3.rotation_angle(before[:3, :3].T @ T[:3, :3])
        sigmas = far, turned, models.initial_velocity_sigma, models.initial_angular_velocity_sigma
        there = replace(update, guess=T).wider(np.diag(np.repeat(np.array(sigmas, float) ** 2, 3)))
        with suppress(UnsolvableError):
            restarted = solve(gate(there, at_guess=True))
            if restarted is not None and restarted.used.sum() >= least:
                return restarted
    if found is None and error is not None:
        raise error
    return found


def _gated(update: Update, noises: Iterable[Array], majority: int) -> Iterable[Gated]:
    """The first prior, with more noise or seen from the guess, with which most pass the gate; then it as it is.

    What still disagrees is taken out later by `solve`.
    """
    first = gate(update)
    if len(update.z) >= majority > first.used.sum():
        places = (False, True) if update.guess is not None else (False,)
        priors = itertools.chain([update], map(update.wider, noises))
        for prior, at_guess in itertools.product(priors, places):
            with suppress(UnsolvableError):
                gated = first if prior is update and not at_guess else gate(prior, at_guess)
                if gated.used.sum() >= majority:
                    break
        else:
            gated = first
        if gated is not first:
            yield gated
    yield first


def _agreed(gated: Gated) -> Posterior | None:
    """What agrees with a prediction, if it is more than might agree by chance at the gate's own level."""
    found = solve(gated)
    used, count = 0 if found is None else int(found.used.sum()), len(gated.used)
    if count < MIN_OBSERVATIONS or ONE_AGREES_IN * used >= count:
        return found
    rejected, models = (
        gated.distances[~gated.used & np.isfinite(gated.distances)],
        gated.innovation.at.update.measure.models,
    )
    chance = by_chance(rejected, used, count, float(gated.limits.max()), models.gate_probability)
    return None if chance else found
