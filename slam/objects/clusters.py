"""Which tracks moved together, against the rest of the scene: the test that a wrong camera pose cannot fool.

Each track brings a displacement ``d_i`` (3,): where its last few frames see it, less where the frames before did. A
camera pose that is off moves all still points by one small rigid motion ``d_i = ρ + θ × (p_i − c)``; so does a body's
own motion, but for its points alone. Therefore no displacement is judged by itself: every spatial cluster of tracks,
at every scale, is tested against the rest of them. The common motion that the cluster says and the one that the rest
says are compared with the covariance of both,

    (ξ_c − ξ_r)ᵀ (Λ_c⁻¹ + Λ_r⁻¹)⁻¹ (ξ_c − ξ_r)  ~  χ²(6),

Λ being sums of ``Jᵀ W J`` over the tracks. It matters where a body is nearer than all else: then it rules the camera's
pose, the estimate follows it, and it is the still world that seems to move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray
from slam.objects.tracks import Tracks
from slam.se3 import Array, hat

_HUBER = 4.0  # displacements of more deviations than these pull with the force of one of these
_ROUNDS = 3
_LARGEST = 0.4  # share of all tracks that a body may have: the still world has most
_PRIOR = np.diag([1e-4] * 3 + [1e-6] * 3)  # keeps Λ of nearly collinear clusters invertible [1/rad², 1/m²]
_FITS = 14.2  # χ²(3) at 99.7 %
_BETTER = 1.0  # by how much χ² a member must fit its cluster better than the rest
_EXPLAINED = 0.25  # share of χ² that the cluster's motion may leave: an uneven motion is seen by tracks unevenly
_TAIL = 3.0  # tracks; see `limit`
_MEDIAN = 2.37  # of χ²(3)


@dataclass(frozen=True)
class Displacements:
    """How tracks moved from the older to the recent frames, a row each.

    Attributes:
        points: where they are (N, 3), relative to the camera, in world axes [m].
        d: displacements (N, 3) [m].
        W: their information (N, 3, 3).
        lag: frames between the older and the recent measurements, in the mean (N,); a pose error that grows evenly
            shows in proportion.
    """

    points: Array
    d: Array
    W: Array
    lag: Array

    def select(self, rows: NDArray) -> Displacements:
        """Some of the rows."""
        return Displacements(self.points[rows], self.d[rows], self.W[rows], self.lag[rows])


@dataclass(frozen=True)
class Scene:
    """What the displacements say.

    Attributes:
        clusters: rows of the tracks of each cluster that moved on its own, the clearest first.
        tests: χ²(6) of each.
        away: how far each went against the rest, at the mean of its points [m].
        alone: χ²(3) of every track's displacement against the rest's common motion (N,).
        scale: by how much the variances were too small, at least 1.
    """

    clusters: list[NDArray[np.intp]]
    tests: list[float]
    away: list[float]
    alone: Array
    scale: float


def displacements(tracks: Tracks, rows: NDArray[np.intp], ages: NDArray[np.intp], camera: Array) -> Displacements:
    """Displacements of tracks from older to recent frames.

    The recent frames are the last five, of short tracks the later half.

    Args:
        tracks: all tracks.
        rows: which of them.
        ages: of the window's slots in frames (W,).
        camera: position (3,) of the left camera.
    """
    A, b = tracks.A[rows], tracks.b[rows]
    count = (tracks.dof[rows] > 0).sum(axis=1)
    recent = ages[None] < np.clip(count // 2, 2, 5)[:, None]
    total_A, total_b = A.sum(axis=1) + tracks.older_A[rows], b.sum(axis=1) + tracks.older_b[rows]
    A_recent = np.einsum("nw,nwij->nij", recent, A)
    b_recent = np.einsum("nw,nwi->ni", recent, b)
    P_recent, P_older = _inverses(A_recent), _inverses(total_A - A_recent)
    weight = np.trace(A, axis1=2, axis2=3)
    late = (weight * recent * ages).sum(axis=1) / np.maximum((weight * recent).sum(axis=1), 1e-12)
    early = (weight * ~recent * ages).sum(axis=1) + tracks.older_age[rows]
    early /= np.maximum((weight * ~recent).sum(axis=1) + np.trace(tracks.older_A[rows], axis1=1, axis2=2), 1e-12)
    now = np.einsum("nij,nj->ni", P_recent, b_recent)
    before = np.einsum("nij,nj->ni", P_older, total_b - b_recent)
    W = np.linalg.inv(P_recent + P_older)
    return Displacements(tracks.position[rows] - camera, now - before, W, np.maximum(early - late, 1.0))


def limit(test: float, size: Array | float) -> Array | float:
    """χ²(6) from which a cluster of so many tracks moved: small clusters have the heavier tails of single tracks."""
    return test * (1.0 + _TAIL / size)


def judge_scene(moved: Displacements, view: Array, test: float, support: int) -> Scene:
    """Clusters that moved on their own, and every track's displacement against the rest.

    Args:
        moved: displacements of the tracks.
        view: where tracks are for the clustering (N, 3): x/z, y/z, and a multiple of log z.
        test: χ²(6) from which a large cluster moved; see `limit`.
        support: least number of tracks in a cluster.
    """
    n = len(moved.d)
    J = _jacobians(moved)
    rest = np.ones(n, bool)
    clusters: list[NDArray[np.intp]] = []
    tests: list[float] = []
    away: list[float] = []
    if n < 3 * support:
        return Scene([], [], [], np.zeros(n), 1.0)
    tree = _spatial_tree(view)
    while True:
        common, weight = _common_motion(moved, J, rest)
        alone = _squares(moved.d - J @ common, moved.W)
        scale = max(1.0, float(np.median(alone[rest])) / _MEDIAN)
        found = _clearest(tree, moved, J, weight / scale, rest, test, support)
        if found is None:
            return Scene(clusters, tests, away, alone / scale, scale)
        members, value = _refined(found[0], moved, J, common, rest, scale), found[1]
        if len(members) < support:
            rest[found[0]] = False  # nothing holds together there: judged no more
            continue
        rest[members] = False
        common, _ = _common_motion(moved, J, rest)
        clusters.append(members)
        tests.append(value)
        away.append(float(np.linalg.norm(_mean_displacement(moved.select(members), (moved.d - J @ common)[members]))))
        if rest.sum() < n / 3 or len(clusters) > 8:
            return Scene(clusters, tests, away, alone / scale, scale)


def _mean_displacement(moved: Displacements, gaps: Array) -> Array:
    """Weighted mean (3,) of what is left of displacements."""
    return np.asarray(np.linalg.solve(moved.W.sum(axis=0), np.einsum("nij,nj->i", moved.W, gaps)))


def _common_motion(moved: Displacements, J: Array, rest: BoolArray) -> tuple[Array, Array]:
    """The small rigid motion (6,) on which tracks agree, by robust least squares, and the weights of all (N,)."""
    common = np.zeros(6)
    weight = np.ones(len(moved.d))
    JW = np.swapaxes(J, 1, 2) @ moved.W
    L, eta = JW @ J, np.einsum("nij,nj->ni", JW, moved.d)
    for _ in range(_ROUNDS):
        w = weight * rest
        common = np.linalg.solve(np.tensordot(w, L, 1) + _PRIOR, w @ eta)
        deviations = np.sqrt(_squares(moved.d - J @ common, moved.W))
        weight = np.minimum(1.0, _HUBER / np.maximum(deviations, 1e-9))
    return common, weight


def _clearest(
    tree: NDArray[np.intp], moved: Displacements, J: Array, weight: Array, rest: BoolArray, test: float, support: int
) -> tuple[NDArray[np.intp], float] | None:
    """The cluster of the tree that differs most from the rest, if that is enough."""
    n = len(moved.d)
    w = weight * rest
    JW = w[:, None, None] * (np.swapaxes(J, 1, 2) @ moved.W)
    L, eta, size = np.zeros((2 * n - 1, 6, 6)), np.zeros((2 * n - 1, 6)), np.zeros(2 * n - 1)
    L[:n], eta[:n], size[:n] = JW @ J, np.einsum("nij,nj->ni", JW, moved.d), rest
    for i, (a, b) in enumerate(tree, start=n):
        L[i], eta[i], size[i] = L[a] + L[b], eta[a] + eta[b], size[a] + size[b]
    nodes = np.flatnonzero((size >= support) & (size <= _LARGEST * rest.sum()))
    if not len(nodes):
        return None
    Lc, Lr = L[nodes] + _PRIOR, L[-1] - L[nodes] + _PRIOR
    gap = np.linalg.solve(Lc, eta[nodes][..., None]) - np.linalg.solve(Lr, (eta[-1] - eta[nodes])[..., None])
    both = Lc @ np.linalg.solve(L[-1] + 2 * _PRIOR, Lr)
    values = (np.swapaxes(gap, 1, 2) @ both @ gap)[:, 0, 0]
    values -= limit(test, size[nodes])
    best = int(np.argmax(values))
    if not values[best] > 0:
        return None
    leaves = _leaves(tree, n, int(nodes[best]))
    return leaves[rest[leaves]], float(values[best] + limit(test, size[nodes[best]]))


def _refined(
    members: NDArray[np.intp], moved: Displacements, J: Array, common: Array, rest: BoolArray, scale: float
) -> NDArray[np.intp]:
    """Members that fit their cluster's own motion, and better than the rest's."""
    inside = np.zeros(len(rest), bool)
    inside[members] = True
    own, _ = _common_motion(moved, J, inside)
    fits = _squares(moved.d - J @ own, moved.W) / scale
    before = _squares(moved.d - J @ common, moved.W) / scale
    return np.flatnonzero(inside & (fits < np.maximum(_FITS, _EXPLAINED * before)) & (before - fits > _BETTER))


def _spatial_tree(view: Array) -> NDArray[np.intp]:
    """Pairs of nodes (N − 1, 2) joined one after the other by single linkage; node N + i is the i-th pair."""
    from scipy.cluster.hierarchy import linkage

    return linkage(view, "single")[:, :2].astype(np.intp)


def _leaves(tree: NDArray[np.intp], n: int, node: int) -> NDArray[np.intp]:
    """The rows below a node."""
    out, stack = [], [node]
    while stack:
        top = stack.pop()
        if top < n:
            out.append(top)
        else:
            stack.extend(int(child) for child in tree[top - n])
    return np.array(sorted(out), np.intp)


def _jacobians(moved: Displacements) -> Array:
    """``∂d/∂[θ, ρ]`` (N, 3, 6), θ and ρ by frame."""
    J = np.concatenate([-hat(moved.points), np.broadcast_to(np.eye(3), (len(moved.d), 3, 3))], axis=2)
    return moved.lag[:, None, None] * J


def _squares(e: Array, W: Array) -> Array:
    """``eᵀ W e`` (N,)."""
    return np.einsum("ni,nij,nj->n", e, W, e)


def _inverses(M: Array) -> Array:
    """Inverses (N, 3, 3) of information matrices, also of those that know nothing along the ray."""
    return np.linalg.inv(M + (1e-6 * np.trace(M, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(3))
