"""Data between the detector of moving objects, the back ends and the caller. Units and frames as in `slam.data`.

A body's pose ``T_world_object`` transforms body coordinates to world coordinates. The body frame is fixed when the body
is found: its origin is the mean of the points seen then, its axes are those of the world. A motion ``H`` in world
coordinates does not depend on that choice: it takes a point of the body from its earlier to its later position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.arrays import Array, IdArray
from slam.naming import count, of_shapes, point


@dataclass(frozen=True, eq=False)
class ObjectObservations:
    """Points of one rigid body seen in the current frame, a row each."""

    id: int  # of the body
    points: IdArray  # ids of its points (M,), unique over all bodies; a point keeps its id as long as it is tracked
    uv_left: Array  # left pixels (M, 2), finite
    uv_right: Array  # right pixels (M, 2), NaN where there is no stereo match
    T_world_object: Array  # pose (4, 4) at which a new body's frame is put
    velocity: Array | None = None  # prior [ω, v] (6,) of a new body in world axes [rad/s], [m/s]
    velocity_sigma: Array | None = None  # its standard deviations (6,); None where there is no prior

    __repr__ = of_shapes


@dataclass(frozen=True, eq=False)
class ObjectEstimate:
    """A back end's belief about one body at one time.

    Attributes:
        id: of the body.
        stamp: time [s].
        T_world_object: pose (4, 4).
        covariance: its covariance (6, 6), [rotation, translation], of a perturbation on the right (body axes),
            including the camera's uncertainty. At first sight the pose defines the body frame and is exact, so this is
            the covariance of the motion since.
        velocity: angular [rad/s] and linear [m/s] velocity (6,) of the body's origin, in world axes.
        velocity_covariance: its covariance (6, 6).
        measured: whether the body was measured in this frame; else it was predicted.
        used: ids of the points whose observations were used (K,).
        rejected: ids of those that failed the gate (R,).
    """

    id: int
    stamp: float
    T_world_object: Array
    covariance: Array
    velocity: Array
    velocity_covariance: Array
    measured: bool
    used: IdArray
    rejected: IdArray

    __repr__ = of_shapes


@dataclass(frozen=True, eq=False)
class MovingObject:
    """A moving rigid body as the system reports it with every frame.

    Attributes:
        id: stays the same through stops and occlusions.
        features: rows of the frame's features that belong to it (K,).
        estimate: pose, velocity and their covariances.
        motion: motion (4, 4) since the previous frame, in world coordinates.
        motion_since_found: motion (4, 4) since the body was found, in world coordinates.
        extent: least and largest corner (2, 3) [m] of the box around its points, in body coordinates; 5th and 95th
            percentiles, of the points that have moved with it for certain.
        moving: whether it moves now; a body that stops stays an object.
        found_at: when it was found [s]; NaN if before the run.
        measured_at: when it was last measured [s]; NaN if unknown.
        existence: probability that it exists.
    """

    id: int
    features: NDArray[np.intp]
    estimate: ObjectEstimate
    motion: Array
    motion_since_found: Array
    extent: Array
    moving: bool
    found_at: float = float("nan")
    measured_at: float = float("nan")
    existence: float = 1.0

    def __repr__(self) -> str:
        speed = float(np.linalg.norm(self.estimate.velocity[3:]))
        where = f"at {point(self.estimate.T_world_object[:3, 3])} m"
        return f"MovingObject({self.id}, {where}, {speed:.2f} m/s, {count(len(self.features), 'feature')})"


@dataclass(frozen=True, eq=False)
class MotionLabels:
    """Motion labels of a frame's features."""

    moving: NDArray[np.intp]  # rows of features that move, or lie on a moving body (V,)
    undecided: NDArray[np.intp]  # rows of features not seen for long enough to be classified, or in doubt (U,)
    landmarks: IdArray  # ids of landmarks that turned out to move (L,)
