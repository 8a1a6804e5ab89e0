"""The joint covariance (18, 18) of the anchor and the last two poses, and how it changes.

It is that of three errors, perturbations on the right: of the anchor in the world, and of the last but one and the last
pose relative to the anchor. However little is known of the place in the world, what is relative keeps its digits.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array, adjoint, inverse


def moved(joint: Array, J: Array, noise: Array) -> Array:
    """With the next pose, of a Jacobian J (6, 12) by the last two, and noise (6, 6) that is added."""
    F = np.zeros((18, 18))
    F[:6, :6] = F[6:12, 12:] = np.eye(6)
    F[12:, 6:] = J
    out, A = F @ joint @ F.T, J @ root(joint[6:, 6:])
    out[12:, 12:] = A @ A.T + noise
    return np.asarray(0.5 * (out + out.T))


def in_world(joint: Array, anchor: Array, T: Array) -> Array:
    """Covariance (6, 6) in the world of the last pose T (4, 4)."""
    A = np.concatenate([adjoint(inverse(T) @ anchor), np.zeros((6, 6)), np.eye(6)], axis=1) @ root(joint)
    return np.asarray(A @ A.T)


def anchored(joint: Array, by_anchor: Array, poses: Array) -> Array:
    """With the last pose as the anchor, whose error in the world changes by `by_anchor` (6, 6) with the anchor's.

    The last two `poses` are (2, 4, 4).
    """
    G = np.zeros((18, 18))
    G[:6, :6] = by_anchor
    G[:6, 12:] = G[6:12, 6:12] = np.eye(6)
    G[6:12, 12:] = -adjoint(inverse(poses[0]) @ poses[1])
    return np.asarray(G @ joint @ G.T)


def root(P: Array) -> Array:
    """A square root (n, n) of the positive semidefinite matrix next to P: after long gaps large numbers cancel."""
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(values.clip(min=0)))
