"""What an estimator of many poses tries if most observations contradict its prediction.

Then the prediction is probably wrong, not the observations. There are two cases, tried in turn:

- It is so far off that the solution is not found from there: start from the pose on which the landmarks agree.
- The camera is where its earlier poses exclude it: these were wrong, after a stretch with hardly anything to see. The
  problem is restarted with that pose and the landmarks; earlier poses stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.chi_square import chi_square_limit
from slam.data import BoolArray
from slam.geometry.arrays import changed
from slam.geometry.rig import MINIMAL_POINTS
from slam.geometry.se3 import Array, inverse, log
from slam.window import pose_only
from slam.window.gating import MIN_CONSENSUS, MIN_OBSERVATIONS, ONE_AGREES_IN, by_chance

_LASTING = 3  # updates in succession that contradict the path: one or two may be at fault themselves
_ANY_TURN = np.pi**2 / 3  # variance of a turn by any angle [rad²]


@dataclass(frozen=True, eq=False)
class Agreement:
    """A solution."""

    T: Array  # the newest pose (4, 4)
    used: BoolArray  # which observations (M,) agree with it
    jump: Array | None = None  # variances (6,) that the prediction lacks, if the problem shall be restarted; else None
    # updates in succession, with this one, in which most observations agreed on another pose than was expected
    contradicted: int = 0


#: The pose (4, 4) on which landmarks agree, if there is one.
Search = Callable[[], "Array | None"]


def agreement(problem: pose_only.PoseProblem, guess: Array, search: Search, contradicted: int, lost: bool) -> Agreement:
    """The newest pose with which most observations agree.

    Agreement of less than a third of the observations counts only if so many cannot agree by chance. `search` is only
    called where most contradict the solution that begins at `guess` (4, 4); so they did in `contradicted` updates just
    before.
    """
    T, used = pose_only.solve(problem, guess)
    if 2 * used.sum() >= len(used):
        restart = lost and used.sum() >= MIN_CONSENSUS
        return Agreement(T, used, np.zeros(6) if restart else None)
    there = search() if len(used) >= MIN_CONSENSUS else None
    found = None if there is None else _seated(problem, there)
    contradicted = 0 if found is None else contradicted + 1
    if found is not None and (found.jump is None or contradicted >= _LASTING):
        return found
    few = len(used) >= MIN_OBSERVATIONS and ONE_AGREES_IN * used.sum() < len(used)
    if few and by_chance(problem.z, used, problem.distances(T), problem.probability, MINIMAL_POINTS):
        used = np.zeros_like(used)
    return Agreement(T, used, None, contradicted)


def unknown_turn(P: Array) -> bool:
    """Whether the orientation of a pose with covariance P (6, 6) is uncertain by more than a radian."""
    # the norm, which is no less than an eigenvalue, takes a tenth of the time
    P = P[:3, :3]
    return not (P * P).sum() <= 1.0 and bool(np.linalg.eigvalsh(P).max() > 1.0)


def _seated(problem: pose_only.PoseProblem, there: Array) -> Agreement | None:
    """The solution from the pose on which landmarks agree; None if most do not agree with it after all."""
    x = log(inverse(problem.predicted) @ there)
    limit = chi_square_limit(6, problem.probability)
    jump = None
    if x @ problem.information @ x > limit:
        jump = np.repeat([float(x[:3] @ x[:3]), float(x[3:] @ x[3:])], 3)
        wide = np.linalg.inv(problem.information) + np.diag(jump)
        problem = changed(problem, information=np.linalg.inv(wide))
    T, used = pose_only.solve(problem, there)
    return Agreement(T, used, jump) if used.sum() >= max(MIN_CONSENSUS, (len(used) + 1) // 2) else None


def world_covariance(P: Array) -> Array:
    """Covariance in the world of a pose found from the landmarks, given its predicted covariance P (6, 6).

    The landmarks are as well known in the world as the poses that saw them, which are at least that well known. The
    variance of a rotation is bounded by π²/3, that of an angle of which nothing is known.
    """
    share = np.ones(6)
    share[:3] /= max(1.0, np.sqrt(np.linalg.eigvalsh(P[:3, :3]).max() / _ANY_TURN))
    return np.asarray(share[:, None] * P * share)
