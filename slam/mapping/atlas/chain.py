"""The path of the keyframes, step by step with covariances, and how a change of its ends moves what lies between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import LEAST_VARIANCE, Array, adjoint, exp, hat, inverse, log


@dataclass(frozen=True)
class Chain:
    """The path of the keyframes as the back end estimated it, step by step.

    Attributes:
        poses: T_odom_left (K, 4, 4).
        steps: covariance (K, 6, 6) of the motion from the keyframe before, perturbing on the right; the first has no
            meaning.
    """

    poses: Array
    steps: Array

    def carried(self, ends: NDArray[np.intp]) -> Array:
        """Covariance (K, 6, 6) of each keyframe within its stretch, seen from where the stretch ends.

        Args:
            ends: the keyframes that bound stretches, ascending, the first and the last one among them.
        """
        number = np.arange(len(self.poses))
        end = ends[np.searchsorted(ends, number)]
        A = adjoints(inverse(self.poses[end]) @ self.poses)
        Q = A @ self.steps @ np.swapaxes(A, 1, 2)
        Q[ends[0]] = 0
        total = np.cumsum(Q, axis=0)
        begin = ends[np.maximum(np.searchsorted(ends, number) - 1, 0)]
        return np.asarray(total - total[begin])

    def motion(self, first: int, second: int) -> tuple[Array, Array]:
        """Motion (4, 4) from one keyframe to another, and its covariance (6, 6), perturbing on the right."""
        a, b = sorted((first, second))
        part = Chain(self.poses[a : b + 1], self.steps[a : b + 1])
        P = part.carried(np.unique([0, b - a]))[-1]
        T = inverse(self.poses[first]) @ self.poses[second]
        if first > second:
            A = adjoint(inverse(T))
            P = A @ P @ A.T
        return T, P


def spread(chain: Chain, ends: NDArray[np.intp], moved: Array) -> Array:
    """Poses (K, 4, 4) of all keyframes, from those of some (M, 4, 4): each stretch's change is shared out."""
    number = np.arange(len(chain.poses))
    at = np.maximum(np.searchsorted(ends, number), 1)
    begin, end = ends[at - 1], ends[at]
    carried = chain.carried(ends)
    a = inverse(chain.poses[begin])
    step = a @ chain.poses[end]
    change = log(inverse(step) @ inverse(moved[at - 1]) @ moved[at])
    whole = carried[end] + LEAST_VARIANCE * np.eye(6)
    part = (carried @ np.linalg.solve(whole, change[:, :, None]))[:, :, 0]
    part[ends[0]] = 0
    part[ends[1:]] = change[ends[1:]]
    out = shared_out(moved[at - 1], a @ chain.poses, inverse(chain.poses) @ chain.poses[end], part)
    out[ends] = moved
    return out


def shared_out(begin: Array, motion: Array, rest: Array, change: Array) -> Array:
    """Poses (N, 4, 4) on stretches whose ends move.

    Args:
        begin: the moved poses (N, 4, 4) at which their stretches begin.
        motion: from there to the poses (N, 4, 4), as it was estimated.
        rest: from the poses to where their stretches end (N, 4, 4).
        change: of the motions (N, 6), perturbing on the right the poses at which the stretches end.
    """
    return np.asarray(begin @ motion @ exp((adjoints(rest) @ change[:, :, None])[:, :, 0]))


def adjoints(T: Array) -> Array:
    """Adjoints (N, 6, 6) of poses (N, 4, 4)."""
    out = np.zeros((len(T), 6, 6))
    R = T[:, :3, :3]
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, 3:, :3] = hat(T[:, :3, 3]) @ R
    return out
