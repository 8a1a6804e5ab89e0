"""What the filter tries where most observations contradict its prediction.

Then the prediction is wrong, not the observations. There are three cases, tried in turn:

- It is so far off that its linearisation does not hold: the update is linearised where the matches agree on a pose.
- An impulse was larger than the motion model expects, or the camera turned as the Euler model cannot follow: the
  process noise is inflated.
- The filter is lost, after a long gap or a stretch with hardly anything to see: the landmarks agree on a pose that no
  impulse explains. The camera restarts there, in the same map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtrc

from backends.ekf.covariance import CAMERA
from backends.ekf.solve import Gated, Problem, Solution, UnsolvableError, gate, solve
from slam.geometry.se3 import Array
from slam.models import EstimatorModels
from slam.window.agreement import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, share_by_chance

#: The change of [r, φ] (6,) to a pose on which landmarks agree, if there is one.
Search = Callable[[], "Array | None"]


@dataclass(frozen=True, eq=False)
class Agreement:
    """A solution, and the noise (12, 12) that joined the camera's covariance for it."""

    solution: Solution
    noise: Array | None = None


def agreement(problem: Problem, noises: Sequence[Array], search: Search, models: EstimatorModels) -> Agreement | None:
    """Solve with the prior that most observations agree with.

    Where less than a third of the observations agrees, and as many wrong ones might agree by chance, that agreement is
    ignored: it could move the pose anywhere.

    Args:
        problem: the update.
        noises: motion noises (12, 12) that may have been there in addition, smallest first.
        search: finds the pose on which the landmarks agree; only called where nothing else helps.
        models: how fast a camera may be that restarts.

    Returns:
        the solution with its prior, or None where there is none.

    Raises:
        UnsolvableError: there is none, and the reason is numerical.
    """
    found, error = None, None
    try:
        found = _as_predicted(problem, noises)
    except UnsolvableError as reason:
        error = reason
    if found is None or 2 * found.solution.used.sum() < len(problem.z):
        found = _restarted(problem, search, models) or found
    if found is None and error is not None:
        raise error
    return found


def _as_predicted(problem: Problem, noises: Sequence[Array]) -> Agreement | None:
    """With the prediction, or a wider one that most observations pass the gate of."""
    wider, gated, noise = _gated(problem, noises)
    found = _agreed(wider, gated, noise)
    if noise is not None and (found is None or 2 * found.solution.used.sum() < len(problem.z)):
        found = _agreed(problem, gate(problem), None) or found  # they passed, but do not agree with each other
    return found


def _agreed(problem: Problem, gated: Gated, noise: Array | None) -> Agreement | None:
    """What agrees with a prediction, if it is more than might agree by chance."""
    solution = solve(problem, gated)
    if solution is None:
        return None
    used, few = int(solution.used.sum()), len(problem.z) < MIN_OBSERVATIONS
    if not few and ONE_AGREES_IN * used < len(problem.z) and _by_chance(gated, used, problem):
        return None
    return Agreement(solution, noise)


def _by_chance(gated: Gated, used: int, problem: Problem) -> bool:
    """Whether so many wrong observations may pass the gate as agree, at the gate's own level."""
    rejected = gated.distances[~gated.used & np.isfinite(gated.distances)]
    if not len(rejected):
        return True
    share = share_by_chance(rejected, float(gated.limits.max()))
    return bool(bdtrc(used - 1, len(problem.z), share) > 1 - problem.gate_probability)


def _gated(problem: Problem, noises: Sequence[Array]) -> tuple[Problem, Gated, Array | None]:
    """The problem, its gate, and the noise to add to the camera's covariance, or None.

    What still disagrees is taken out later by `solve`.
    """
    first = gate(problem)
    most = max(MIN_OBSERVATIONS, _half(problem))
    if len(problem.z) < most or first.used.sum() >= most:
        return problem, first, None
    for noise in (None, *noises):
        wider = problem if noise is None else _wider(problem, noise)
        for at_guess in (False,) if problem.guess is None else (False, True):
            gated = gate(wider, at_guess) if noise is not None or at_guess else first
            if gated.used.sum() >= most:
                return wider, gated, noise
    return problem, first, None


def _restarted(problem: Problem, search: Search, models: EstimatorModels) -> Agreement | None:
    """With a camera that is where the landmarks say, wherever it was before; None where most do not agree with it."""
    least = max(MIN_CONSENSUS, _half(problem))
    change = search() if len(problem.z) >= least else None
    if change is None:
        return None
    noise = restart_noise(change, models)
    there = replace(_wider(problem, noise), guess=change)
    try:
        solution = solve(there, gate(there, at_guess=True))
    except UnsolvableError:
        return None
    if solution is None or solution.used.sum() < least:
        return None
    return Agreement(solution, noise)


def _half(problem: Problem) -> int:
    return (len(problem.z) + 1) // 2


def _wider(problem: Problem, noise: Array) -> Problem:
    P = problem.P.copy()
    P[:CAMERA, :CAMERA] += noise
    return replace(problem, P=P)


def restart_noise(change: Array, models: EstimatorModels) -> Array:
    """The noise (12, 12) of a camera that is elsewhere, by a change of [r, φ] (6,), and whose speed is unknown."""
    sigmas = np.repeat(
        [
            float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:])),
            models.initial_velocity_sigma, models.initial_angular_velocity_sigma,
        ], 3,
    )  # fmt: skip
    return np.diag(sigmas**2)
