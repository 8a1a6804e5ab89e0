"""Which tracks belong to a body: who enters with its founding, who joins, who leaves, who is held back from the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.data import IdArray, StereoFeatures
from slam.gating import chi_square_limits
from slam.objects.bodies import Body, in_body_axes
from slam.objects.config import ObjectsConfig
from slam.objects.measurement import View, predict
from slam.objects.tracks import Tracks
from slam.rig import StereoRig
from slam.se3 import Array, exp, hat, inverse, transform

_MISFITS = 3  # times that a track may disagree with its body before it leaves
_ROUNDS = 3  # of fitting poses and points in turn
_TURN, _SHIFT = 0.2, 0.2  # how far a pose may be from an even motion, before anything is known [rad], [m]
_MERGED = 0.5  # how far outside a body's extent a group may lie that belongs to it, as a share of the diagonal
_PROBATION = 12  # frames after which a body must have gone somewhere
_LEAST_SHIFT = 2.0  # how far at least [px]
_NEAR = 9.0  # χ² of the distance from a body's extent
_EXPLAINED = 0.2  # share of the χ² of "still" that the body's motion, itself uncertain, may leave
_LOOSE = 4.0  # by how much it may exceed the 99 % limit then
_BETTER = 6.0  # by how much χ² a track must fit a body better than the still world, to join while the body moves


def measured(features: StereoFeatures, rows: NDArray[np.intp]) -> Array:
    """Measurements (N, 3) = (uL, vL, uR) of features; uR is NaN where there is none."""
    return np.concatenate([features.uv_left[rows], features.uv_right[rows, :1]], axis=1)


def found(body: Body, tracks: Tracks, rows: NDArray[np.intp], times: Array, slot: int) -> Body:
    """Make tracks the first members of a body; its poses over the window and their points are fitted together first.

    An even motion is but the first guess of a body that starts to move: poses and points are improved in turn.
    """
    members = tracks.select(rows)
    for _ in range(_ROUNDS):
        points, A, _ = in_body_axes(body, members)
        y = _means(points, A)
        J = np.concatenate([-hat(y), np.broadcast_to(np.eye(3), (len(rows), 3, 3))], axis=2)
        JA = np.einsum("nji,nwjk->nwik", J, A)
        normal = np.einsum("nwij,njk->wik", JA, J) + np.diag([_TURN**-2] * 3 + [_SHIFT**-2] * 3)
        step = np.linalg.solve(normal, np.einsum("nwij,nwj->wi", JA, points - y[:, None])[..., None])[..., 0]
        body = replace(body, history=body.history @ exp(step))
    now, first = body.history[slot], body.history[int(np.argmin(times))]
    body = replace(body, T=now, T_first=first)
    enter(body, tracks, rows)
    return body


def enter(body: Body, tracks: Tracks, rows: NDArray[np.intp]) -> None:
    """Make tracks members of a body: what they measured goes over to the body's coordinates, in place."""
    points, A, known = in_body_axes(body, tracks.select(rows))
    y = _means(points, A)
    p = points - y[:, None]
    tracks.body[rows], tracks.moving[rows], tracks.misfit[rows], tracks.streak[rows] = body.id, False, 0, 0
    tracks.anchor[rows], tracks.local[rows], tracks.position[rows] = y, y, y
    tracks.local_information[rows] = A.sum(axis=1)
    tracks.A[rows] = A
    tracks.b[rows] = np.einsum("nwij,nwj->nwi", A, p)
    tracks.c[rows] = np.einsum("nwi,nwi->nw", p, tracks.b[rows])
    tracks.dof[rows] = np.where(known, tracks.dof[rows], 0)
    tracks.older_A[rows] = tracks.older_b[rows] = tracks.older_age[rows] = 0


def leave(tracks: Tracks, rows: NDArray[np.intp], body: Body) -> None:
    """Make members free tracks again, without a past, in place."""
    tracks.position[rows] = tracks.anchor[rows] = transform(body.T, tracks.local[rows])
    tracks.body[rows], tracks.misfit[rows] = -1, 0
    for name in ("A", "b", "c", "dof", "velocity", "test", "older_A", "older_b", "older_age"):
        getattr(tracks, name)[rows] = 0
    tracks.missed[rows] = 1


def dismiss(body: Body, tracks: Tracks, seen: NDArray[np.intp], config: ObjectsConfig) -> None:
    """Members that disagree with their body leave it; so do those beyond the number that is kept."""
    mine = np.flatnonzero(tracks.body == body.id)
    wrong = mine[tracks.misfit[mine] >= _MISFITS]
    leave(tracks, wrong, body)
    mine = np.setdiff1d(mine, wrong)
    if len(mine) > config.max_points:
        worth = np.trace(tracks.local_information[mine], axis1=1, axis2=2)
        order = np.lexsort((worth, -tracks.missed[mine]))
        leave(tracks, mine[order[: len(mine) - config.max_points]], body)


def admit(body: Body, tracks: Tracks, slot: int, config: ObjectsConfig) -> None:
    """Free tracks near a body that fit its motion join it; every member's point is improved by this frame's pixels."""
    _improve(body, tracks, slot)
    rows = np.flatnonzero((tracks.body < 0) & tracks.seen & (tracks.count >= 2))
    y = transform(inverse(body.T), tracks.position[rows])
    R = body.T[:3, :3]
    rows = rows[_outside(body, y, np.linalg.inv(R.T @ tracks.covariance[rows] @ R), config.margin) < _NEAR]
    if not len(rows):
        return
    points, A, known = in_body_axes(body, tracks.select(rows))
    fixed, dof = _fixed_point(points, A, tracks.dof[rows] * known)
    still, _ = _fixed_point(*_in_world(tracks, rows, known), tracks.dof[rows] * known)
    limit = chi_square_limits(dof, 0.99)
    fits = (fixed < limit) | ((fixed < _EXPLAINED * still) & (fixed < _LOOSE * limit))
    better = still - fixed > (_BETTER if body.moving else -_BETTER)
    count = (known & (tracks.dof[rows] > 0)).sum(axis=1)
    members = rows[fits & better & (count >= 2)]
    if len(members):
        enter(body, tracks, members)


def reject(tracks: Tracks | None, ids: IdArray) -> None:
    """Count members whose observations the back end rejected as misfits."""
    if tracks is not None and len(ids):
        tracks.misfit[np.isin(tracks.ids, ids)] += 1


def held(
    bodies: Mapping[int, Body], tracks: Tracks, features: StereoFeatures, view: View, rig: StereoRig, sigma: float,
    config: ObjectsConfig,
) -> NDArray[np.intp]:  # fmt: skip
    """Rows of features inside a body's extent that were seen too shortly to be judged: no landmarks as yet."""
    seen_bodies = [body for body in bodies.values() if body.measured]
    if not seen_bodies:
        return np.zeros(0, np.intp)
    long = tracks.seen & ((tracks.count >= config.min_frames) | (tracks.body >= 0))
    young = np.ones(len(features), bool)
    young[tracks.row[long]] = False
    rows = np.flatnonzero(young & features.has_stereo)
    local = rig.triangulate(features.uv_left[rows], features.uv_right[rows])
    rows, local = rows[np.isfinite(local[:, 0])], local[np.isfinite(local[:, 0])]
    points = transform(view.T_frame_left, local)
    expected = predict(rig, view, points, sigma)
    A = np.swapaxes(expected.J, 1, 2) @ np.linalg.solve(expected.S, expected.J)
    inside = np.zeros(len(rows), bool)
    for body in seen_bodies:
        R = body.T[:3, :3]
        y = transform(inverse(body.T), points)
        inside |= _outside(body, y, R.T @ A @ R, config.margin) < _NEAR
    return rows[inside]


def overlapped(bodies: Mapping[int, Body], tracks: Tracks, rows: NDArray[np.intp]) -> Body | None:
    """The body in whose extent most of these tracks lie, if their past fits its motion, too; else None."""
    for body in bodies.values():
        if not body.measured:
            continue
        y = transform(inverse(body.T), tracks.position[rows])
        R = body.T[:3, :3]
        near = _outside(body, y, np.linalg.inv(R.T @ tracks.covariance[rows] @ R), _MERGED) < _NEAR
        points, A, known = in_body_axes(body, tracks.select(rows))
        fixed, _ = _fixed_point(points, A, tracks.dof[rows] * known)
        still, _ = _fixed_point(*_in_world(tracks, rows, known), tracks.dof[rows] * known)
        if 2 * near.sum() > len(rows) and fixed.sum() < 2 * _EXPLAINED * still.sum():
            return body
    return None


def never_moved(body: Body, view: View, focal: float) -> bool:
    """Whether a body, after some frames, is still where it was before it was found: then it is none."""
    if body.seen != _PROBATION:
        return False
    distance = float(np.linalg.norm(body.T[:3, 3] - view.T_frame_left[:3, 3]))
    shift = float(np.linalg.norm(body.T[:3, 3] - body.T_first[:3, 3]))
    return focal * shift / max(distance, 1e-3) < _LEAST_SHIFT


def _outside(body: Body, y: Array, information: Array, margin: float) -> Array:
    """Squared distance (N,) of points y from the body's extent, in units of their own noise.

    The extent is widened by `margin`, a share of its diagonal.
    """
    wider = margin * float(np.linalg.norm(body.upper - body.lower))
    away = y - np.clip(y, body.lower - wider, body.upper + wider)
    beyond = np.linalg.norm(y, axis=1) > body.reach
    return np.where(beyond, np.inf, np.einsum("ni,nij,nj->n", away, information, away))


def _improve(body: Body, tracks: Tracks, slot: int) -> None:
    """Take this frame's measurements into the members' points."""
    mine = np.flatnonzero((tracks.body == body.id) & tracks.seen)
    A = tracks.A[mine, slot]
    total = tracks.local_information[mine] + A
    told = tracks.b[mine, slot] + np.einsum("nij,nj->ni", A, tracks.anchor[mine] - tracks.local[mine])
    ridge = 1e-9 * np.trace(total, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    tracks.local[mine] += np.linalg.solve(total + ridge, told[..., None])[..., 0]
    tracks.local_information[mine] = total


def _in_world(tracks: Tracks, rows: NDArray[np.intp], known: NDArray) -> tuple[Array, Array]:
    """Measurements of free tracks by slot: points (N, W, 3) relative to their anchors, information (N, W, 3, 3)."""
    A = np.where(known[..., None, None], tracks.A[rows], 0.0)
    ridge = 1e-6 * np.trace(A, axis1=2, axis2=3)[..., None, None] * np.eye(3) + 1e-9 * np.eye(3)
    p = np.linalg.solve(A + ridge, np.where(known[..., None], tracks.b[rows], 0.0)[..., None])[..., 0]
    return p, A


def _fixed_point(points: Array, A: Array, dof: NDArray) -> tuple[Array, NDArray]:
    """χ² (N,) of "one fixed point" for measurements by slot, and its degrees of freedom (N,)."""
    away = points - _means(points, A)[:, None]
    chi = np.einsum("nwi,nwij,nwj->n", away, A, away)
    return chi, np.maximum(dof.sum(axis=1).astype(int) - 3, 1)


def _means(points: Array, A: Array) -> Array:
    """Means (N, 3) of points by slot (N, W, 3), weighted by their information (N, W, 3, 3)."""
    total = A.sum(axis=1)
    ridge = (1e-6 * np.trace(total, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    return np.linalg.solve(total + ridge, np.einsum("nwij,nwj->ni", A, points)[..., None])[..., 0]
