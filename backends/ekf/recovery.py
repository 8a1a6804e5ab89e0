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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtrc

from backends.ekf.solve import Gated, Problem, Solution, UnsolvableError, gate, solve
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.models import EstimatorModels
from slam.window.agreement import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, share_by_chance

#: The pose (4, 4) on which landmarks agree, if there is one.
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
        wider = replace(problem, noise=noise)
        for at_guess in (False,) if problem.guess is None else (False, True):
            gated = gate(wider, at_guess) if noise is not None or at_guess else first
            if gated.used.sum() >= most:
                return wider, gated, noise
    return problem, first, None


def _restarted(problem: Problem, search: Search, models: EstimatorModels) -> Agreement | None:
    """With a camera that is where the landmarks say, wherever it was before; None where most do not agree with it."""
    least = max(MIN_CONSENSUS, _half(problem))
    finite = math.isfinite(problem.prior.P.trace())
    T = search() if finite and len(problem.z) >= least else None
    if T is None:
        return None
    there = replace(problem, guess=T, noise=restart_noise(problem.prior.T, T, models))
    try:
        solution = solve(there, gate(there, at_guess=True))
    except UnsolvableError:
        return None
    if solution is None or solution.used.sum() < least:
        return None
    return Agreement(solution, there.noise)


def _half(problem: Problem) -> int:
    return (len(problem.z) + 1) // 2


def restart_noise(before: Array, after: Array, models: EstimatorModels) -> Array:
    """The noise (12, 12) of a camera that is at a pose (4, 4) instead of another, and whose speed is unknown."""
    far, turned = np.linalg.norm(after[:3, 3] - before[:3, 3]), se3.rotation_angle(before[:3, :3].T @ after[:3, :3])
    speeds = models.initial_velocity_sigma, models.initial_angular_velocity_sigma
    return np.diag(np.repeat(np.array([far, turned, *speeds], float) ** 2, 3))
