"""A body's points at their first sight: the body's frame, and what its shape says of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.se3 import Array, transform

Projection = Callable[[Array], tuple[Array, Array]]

_FAR = 4.0  # so many times the median distance from the median point is no part of the body
MIN_POINTS = MINIMAL_POINTS + 1  #: points whose agreement can be tested: three agree with a pose in any case
MAX_REJECTIONS = 3  #: so many running, and a point restarts
_STEPS = 3  # numerics: of Gauss-Newton; the prior is weak where depth is known well


def compact(points: Array, far: float) -> BoolArray:
    """Which of the points (N, 3) lie less than `far` times the median distance from their median point."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1) if len(points) else np.zeros(0)
    return np.asarray(distance <= far * np.median(distance) if len(points) else np.zeros(0, bool))


def first_frame(T_world_left: Array, h: Array) -> tuple[Array, BoolArray]:
    """The frame of a body seen for the first time: origin at the mean of its points, axes of the world.

    Points far off the others (false stereo matches) are left out, so that they do not move the origin away.

    Args:
        T_world_left: pose (4, 4) of the camera.
        h: its points (M, 3) in camera coordinates, NaN where there is no depth.

    Returns:
        T_world_object (4, 4), and which points were taken (M,).
    """
    world = transform(T_world_left, h)
    seen = np.isfinite(world).all(axis=1)
    near = np.zeros(len(h), bool)
    near[seen] = compact(world[seen], _FAR)
    T = np.eye(4)
    T[:3, 3] = world[near].mean(axis=0)
    return T, near


@dataclass(frozen=True, eq=False)
class Shape:
    """Where the points of a body lie: a Gaussian with mean (3,) and covariance (3, 3) in some frame."""

    mean: Array
    covariance: Array

    def seen_from(self, T: Array) -> Shape:
        """The same in another frame, to which T (4, 4) takes coordinates."""
        R = T[:3, :3]
        return Shape(R @ self.mean + T[:3, 3], R @ self.covariance @ R.T)


def shape_of(points: Array, covariances: Array) -> Shape:
    """The spread of a body's points (M, 3), less what their uncertainties (M, 3, 3) make it seem larger.

    No extent is taken to be less than half the middle one: a body is seldom flatter than that, and would be taken for
    flat wrongly where depth is all noise. Fewer than four points show no shape: then next to nothing is said.
    """
    if len(points) < MIN_POINTS:
        return Shape(points.mean(axis=0), 100 * covariances.mean(axis=0))
    mean, noise = points.mean(axis=0), covariances.mean(axis=0)
    offset = points - mean
    total = offset.T @ offset / max(1, len(points) - 1)
    values, axes = np.linalg.eigh(total - noise)
    least = max(values[1] / 4, 1e-4 * float(np.trace(total)), 1e-3 * float(np.trace(noise)))
    return Shape(mean, (axes * np.maximum(values, least)) @ axes.T)


def with_shape(project: Projection, z: Array, h: Array, sigma: float, shape: Shape) -> tuple[Array, Array]:
    """Points as stereo measures them, given besides that they belong to a body of known shape.

    Far off, stereo scatters the points of a body further in depth than the body is deep. As they stand they make a
    turn of the body seem much better visible than it is: an estimate that is linearised there is overconfident. With
    the shape as prior each point is drawn to the others as far as its depth is noise.

    Args:
        project: gives measurements (M, 3) and derivatives (M, 3, 3) of points (M, 3) in left-camera coordinates.
        z: measurements (M, 3) = (uL, vL, uR) [px].
        h: where they triangulate to (M, 3), in left-camera coordinates.
        sigma: pixel noise [px].
        shape: of the body in left-camera coordinates.

    Returns:
        points (M, 3) in left-camera coordinates, and their covariances (M, 3, 3).
    """
    prior = np.linalg.inv(shape.covariance)
    for _ in range(_STEPS):
        predicted, J = project(h)
        weight = np.swapaxes(J, 1, 2) / sigma**2
        covariance = np.linalg.inv(weight @ J + prior)
        gradient = (weight @ (z - predicted)[:, :, None])[:, :, 0] + (shape.mean - h) @ prior
        h = h + (covariance @ gradient[:, :, None])[:, :, 0]
    return h, covariance


def points_to_replace(unseen: NDArray[np.int64], sights: NDArray[np.int64], wanted: int, most: int) -> BoolArray:
    """Which points of a full body leave to make room for new ones.

    Those that have not been seen for more frames than they ever were; a point that is only missed now and then is worth
    more than a new one. Where hardly any are in view, as when a body has turned round, others leave, too.

    Args:
        unseen: number of frames since each was seen (p,), 0 for those in view.
        sights: in how many frames each was seen (p,), at least 1.
        wanted: so many new points would like to join.
        most: so many points a body may have.

    Returns:
        mask (p,).
    """
    age = unseen / sights
    order = np.argsort(-age, kind="stable")
    in_view = int((unseen == 0).sum())
    lacking = min(wanted, most // 2 - in_view) - (most - len(age))
    surplus = len(age) + wanted - most
    leaving = order[: max(0, min(surplus, max(int((age > 1).sum()), lacking), len(age) - in_view))]
    gone = np.zeros(len(age), bool)
    gone[leaving] = True
    return gone
