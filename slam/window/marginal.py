"""What leaves a window, as a prior on what stays and as a conditional that finds it again later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.geometry.arrays import Array, BoolArray, among
from slam.geometry.se3 import adjoint, inverse
from slam.window import chart_kernels, covariance_kernels
from slam.window.problem import RelativePrior, Window
from slam.window.solver import linearised

_LEAST = 0.1  # numerics: share of its inverse distance that a point keeps at least in a step, as in `displace`


@dataclass(frozen=True, eq=False)
class Conditional:
    """Where what left stands, given what stayed: ``x = mean − gain y``, to first order.

    x and y are the changes since it left: first of points, in their charts' coordinates, then of poses as tangent
    vectors. Points change by inverse distance, not by distance: far ones may move by a multiple of what they were off.
    """

    mean: Array  # (g,)
    gain: Array  # (g, s)
    left: Array  # derivatives (G, 3, 3) of the points that left, in the world, by those coordinates
    stayed: Array  # likewise (S, 3, 3) of those that stayed

    def of(self, stayed: Array, poses: Array) -> tuple[Array, Array]:
        """Changes of points (G, 3) [m] and poses (Q, 6) that left, by those (S, 3) and (P, 6) of what stayed."""
        s = np.linalg.solve(self.stayed, stayed[:, :, None])[:, :, 0]
        y = s / np.maximum(1.0 - _distance(self.stayed) * s[:, 2:], _LEAST)  # the inverse of `chart_kernels.displace`
        x = self.mean - self.gain @ np.concatenate([y.ravel(), poses.ravel()])
        d, poses = x[: 3 * len(self.left)].reshape(-1, 3), x[3 * len(self.left) :].reshape(-1, 6)
        r = _distance(self.left)
        scale = np.maximum(1.0 + r * d[:, 2:], _LEAST)
        d = np.concatenate([d[:, :2], (scale - 1.0) / r], axis=1)
        return (self.left @ d[:, :, None])[:, :, 0] / scale, poses


def _distance(E: Array) -> Array:
    """Distances (N, 1) of points from their charts' centres, by their derivatives (N, 3, 3)."""
    return np.asarray(np.linalg.norm(E[:, :, 0], axis=1)[:, None])


def marginalised(
    w: Window, poses: Sequence[int], leaving: BoolArray, field: Array | None = None
) -> tuple[RelativePrior, Conditional, float]:
    """Marginalise `poses` and points of the prior `leaving` (D,) out of a window, with all that is measured of them.

    The window, all its poses free, holds just that: the prior, the rows of the poses that leave and of the points that
    leave, and what else is known of them. Its `joining` points join the prior; all others that are not in it leave as
    well. If the first pose leaves, the first of those that stay becomes the reference. `field` (M, 3, m) derives the
    rows' true measurements by errors of the rig.

    Returns the prior on the other poses and the points that stay, in their order, then those that joined (points as
    indices of this window); where the points that left, then the poses, are given the others; and what all that cost at
    the present values. Raises LinAlgError where the information of what leaves is not positive definite.
    """
    gone_poses = among(len(w.poses), np.asarray(poses))
    reference = int(np.argmin(gone_poses))
    e = linearised(w, reference)
    points = np.concatenate([leaving, np.zeros(len(w.joining), bool)])
    gone = np.concatenate([np.repeat(points, 3), np.repeat(gone_poses, 6)])
    information, vector, mean, gain = covariance_kernels.schur_complement(
        e.H, e.b, np.flatnonzero(gone), np.flatnonzero(~gone)
    )
    B = e.by_rig(np.zeros((len(w.rows), 3, 0)) if field is None else field)[0]
    by_rig = B[~gone] - gain.T @ B[gone]
    if not (np.isfinite(mean).all() and np.isfinite(e.cost)):
        raise np.linalg.LinAlgError("what leaves a window cannot be marginalised")
    all_members = np.concatenate([w.prior.points, w.joining])
    E, members, stay = e.E[all_members], all_members[~points], w.poses[~gone_poses]
    conditional, D = Conditional(mean, gain, E[points], E[~points]), len(members)
    if reference:
        basis, _ = chart_kernels.relative_charts(stay[0], w.points[members])
    else:
        basis = w.layout.basis[~points]
    origin, change, by = chart_kernels.chart_changes(stay[0], w.points[members], basis, conditional.stayed)
    if not np.isfinite(origin).all():
        raise np.linalg.LinAlgError("a point of the prior is behind its chart")
    if reference:  # coordinates from another pose
        back = np.linalg.inv(change)
        information = _of_charts(back, _of_charts(back, information).T)
        vector, by_rig = _of_charts(back, vector), _of_charts(back, by_rig)
    # x = δ − A δ₀ of all but the reference
    relative = inverse(stay[0]) @ stay
    A = np.concatenate([-by.reshape(3 * D, 6), np.eye(6), adjoint(inverse(relative[1:])).reshape(-1, 6)])
    at = slice(3 * D, 3 * D + 6)
    V = information @ A
    information[:, at], information[at], information[at, at] = V, V.T, A.T @ V
    # apart, so that errors of the rig do not change η's digits
    vector[at] = A.T @ vector
    by_rig[at] = A.T @ by_rig
    prior = RelativePrior(
        members, np.ascontiguousarray(basis), origin, stay[0].copy(), relative, information, vector, by_rig
    )
    return prior, conditional, e.cost


def _of_charts(back: Array, v: Array) -> Array:
    """Gradients v (n, …) by coordinates of other charts, with which the first ones change by `back` (D, 3, 3)."""
    D = len(back)
    points = np.swapaxes(back, 1, 2) @ v[: 3 * D].reshape(D, 3, v[:1].size)
    return np.concatenate([points.reshape(3 * D, *v.shape[1:]), v[3 * D :]])
