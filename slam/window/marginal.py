"""What leaves a window, as a prior on what stays and as a conditional that finds it again later."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.geometry.arrays import Array, BoolArray, IndexArray
from slam.geometry.se3 import adjoint, inverse
from slam.window import kernels
from slam.window.problem import RelativePrior, Window
from slam.window.solver import linearised


@dataclass(frozen=True, eq=False)
class Conditional:
    """Where what left stands, given what stayed: ``x = mean − gain y``, to first order.

    x and y are the changes since it left: of poses as tangent vectors, of points in the world.

    Attributes:
        mean: (g,), points first.
        gain: (g, s), points first.
    """

    mean: Array
    gain: Array


def marginalised(
    w: Window, pose: int, leaving: BoolArray, joining: IndexArray
) -> tuple[RelativePrior, Conditional, float]:
    """Marginalise a pose and some of the prior's points out of a window, with all that is measured of them.

    The window holds just that: the prior, the rows of the pose that leaves and of the points that leave, and what else
    is known of them. All of its points that are neither in the prior nor join it leave as well.

    Args:
        w: the window, all poses free.
        pose: which pose leaves. If it is the first, the next one takes its place as the reference.
        leaving: which of the prior's points leave (D,).
        joining: other points of the window that join the prior (J,).

    Returns:
        the prior on the other poses and the points that stay, in their order, then those that joined (points as
        indices of this window); where the points that left, then the pose, are given the others; and what all that
        cost at the present values.

    Raises:
        numpy.linalg.LinAlgError: the information of what leaves is not positive definite.
    """
    w = _with_joined(w, joining)
    reference = 1 if pose == 0 else 0
    e = linearised(w, reference)
    points = np.concatenate([leaving, np.zeros(len(joining), bool)])
    gone = np.concatenate([np.repeat(points, 3), np.repeat(np.arange(len(w.poses)) == pose, 6)])
    information, vector, mean, gain = kernels.schur_complement(e.H, e.b, np.flatnonzero(gone), np.flatnonzero(~gone))
    if not np.isfinite(mean).all():
        raise np.linalg.LinAlgError("the information of what leaves a window is not positive definite")
    conditional = _in_world(mean, gain, e.E[w.prior.points], points)

    members, poses = w.prior.points[~points], np.delete(w.poses, pose, axis=0)
    D, n = len(members), len(information)
    if reference:
        basis, _ = kernels.relative_charts(poses[0], w.points[members])
    else:
        basis = w.prior.basis[~points]
    origin, change, by = kernels.chart_changes(poses[0], w.points[members], basis, e.E[members])
    if reference:  # coordinates from another pose
        back = np.linalg.inv(change)
        rows = (np.swapaxes(back, 1, 2) @ information[: 3 * D].reshape(D, 3, n)).reshape(3 * D, n)
        information = np.concatenate([rows, information[3 * D :]])
        columns = (
            (information[:, : 3 * D].reshape(n, D, 3).transpose(1, 0, 2) @ back).transpose(1, 0, 2).reshape(n, 3 * D)
        )
        information = np.concatenate([columns, information[:, 3 * D :]], axis=1)
        vector = np.concatenate([(np.swapaxes(back, 1, 2) @ vector[: 3 * D].reshape(D, 3, 1)).ravel(), vector[3 * D :]])
    # x = δ − A δ₀ of all but the reference
    relative = inverse(poses[0]) @ poses
    A = np.concatenate([-by.reshape(3 * D, 6), np.eye(6), adjoint(inverse(relative[1:])).reshape(-1, 6)])
    at = slice(3 * D, 3 * D + 6)
    V = information @ A
    information[:, at], information[at], information[at, at] = V, V.T, A.T @ V
    vector[at] = A.T @ vector
    prior = RelativePrior(members, np.ascontiguousarray(basis), origin, poses[0].copy(), relative, information, vector)
    return prior, conditional, e.cost


def _in_world(mean: Array, gain: Array, E: Array, leaving: BoolArray) -> Conditional:
    """The conditional of changes in the world, by that of chart coordinates."""
    gone, stay = int(leaving.sum()), int((~leaving).sum())
    g, s = 3 * gone, 3 * stay
    mean, gain = mean.copy(), gain.copy()
    back = np.linalg.inv(E[~leaving])
    gain[:, :s] = np.einsum("gni,nij->gnj", gain[:, :s].reshape(len(gain), stay, 3), back).reshape(len(gain), s)
    mean[:g] = (E[leaving] @ mean[:g].reshape(gone, 3, 1)).ravel()
    gain[:g] = (E[leaving] @ gain[:g].reshape(gone, 3, gain.shape[1])).reshape(g, gain.shape[1])
    return Conditional(mean, gain)


def _with_joined(w: Window, joining: IndexArray) -> Window:
    """The window with more points in its prior, of which it says nothing yet."""
    if not len(joining):
        return w
    p, D, J = w.prior, len(w.prior.points), len(joining)
    basis, origin = kernels.relative_charts(w.poses[0], w.points[joining])
    old = np.concatenate([np.ones(3 * D, bool), np.zeros(3 * J, bool), np.ones(6 * len(p.relative), bool)])
    information, vector = np.zeros((len(old), len(old))), np.zeros(len(old))
    information[np.ix_(old, old)], vector[old] = p.information, p.vector
    prior = replace(
        p, points=np.concatenate([p.points, joining]), basis=np.concatenate([p.basis, basis]),
        origin=np.concatenate([p.origin, origin]), information=information, vector=vector,
    )  # fmt: skip
    return replace(w, prior=prior)
