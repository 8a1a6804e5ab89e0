"""Moving bodies in the EKF back end: filtered states beside the filter's own (paper B, section 3, with covariance)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backends.ekf.covariance import CAMERA, POSE
from backends.ekf.objects_body import (
    RIGID,
    Body,
    CameraBelief,
    Gathered,
    advanced,
    corrected,
    corrected_by_map,
    drifted,
    found,
    gathered,
    joined,
    widened,
    without,
)
from backends.ekf.objects_measurement import BodyMeasurement, change_between
from backends.ekf.solve import Gated, Problem, Solution, UnsolvableError, gate, solve
from slam.data import BoolArray, IdArray
from slam.errors import MeasurementError
from slam.geometry.arrays import isin
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse
from slam.models import EstimatorModels
from slam.object_data import ObjectEstimate, ObjectObservations, Sight
from slam.objects.points import MAX_REJECTIONS, MIN_POINTS, Shape, first_frame, points_to_replace, shape_of, with_shape
from slam.window.agreement import INFLATION


class ObjectFilter:
    """All bodies of one filter.

    A body's frame is fixed at its first sight: its axes are the world's, its origin is the mean of the points. So its
    pose has no error then, and what is uncertain about the first sight (stereo noise, the camera's pose) is the
    uncertainty of its points; from then on the pose is that of the motion since.

    Args:
        rig: the cameras.
        models: noise, gate, and motion of bodies.
        iterations: most linearisations in an update.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels, iterations: int) -> None:
        self._rig = rig
        self._models = models
        self._iterations = iterations
        self._bodies: dict[int, Body] = {}
        self._stamp = 0.0
        self._now = 0

    def saved(self) -> Callable[[], None]:
        """A function that puts everything back as it is now."""
        before = {**vars(self), "_bodies": self._bodies.copy()}
        return lambda: vars(self).update(before)

    # --- the protocol (documented in slam.interfaces.ObjectBackend) ---

    def update(
        self, observations: Sequence[ObjectObservations], stamp: float, belief: Callable[[], CameraBelief]
    ) -> list[ObjectEstimate]:
        """See `slam.interfaces.ObjectBackend.update_objects`; the camera's belief is asked for if need be."""
        seen = {o.id: o for o in observations}
        self._require_usable(observations)
        dt = stamp - self._stamp
        self._stamp, self._now = stamp, self._now + (dt != 0)
        if not (self._bodies or seen):
            return []
        camera, out = belief(), []
        for number in sorted({*self._bodies, *seen}):
            body, sight = self._bodies.get(number), Sight()
            if body is None:
                body, sight = self._start(seen[number], camera)
            elif dt > 0:
                body = advanced(body, dt, self._models.objects)
                if number in seen:
                    body, sight = self._measure(body, seen[number], camera, dt)
            self._bodies[number] = body
            out.append(_estimate(body, stamp, sight))
        return out

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.ObjectBackend.remove_objects`."""
        numbers = {int(i) for i in ids}
        for number in sorted(numbers - set(self._bodies)):
            raise MeasurementError(f"ekf: object {number} is unknown")
        for number in numbers:
            del self._bodies[number]

    @property
    def count(self) -> int:
        """Number of bodies."""
        return len(self._bodies)

    # --- what happens to the filter's state happens to the bodies' covariance with it ---

    def camera_moved(self, dt: float) -> None:
        """The camera's [r, φ] went on by dt times [v, ω]."""
        F = np.eye(CAMERA)
        F[:POSE, POSE:] = dt * np.eye(POSE)
        self.camera_transformed(F)

    def camera_transformed(self, J: Array) -> None:
        """The camera's state changed its coordinates by the Jacobian J (12, 12)."""
        for number, body in self._bodies.items():
            cross = body.cross.copy(order="K")
            cross[:, :CAMERA] = cross[:, :CAMERA] @ J.T
            self._bodies[number] = replace(body, cross=cross)

    def landmarks_appended(self, J: Array) -> None:
        """Landmarks joined whose derivatives by [r, φ] are J (M, 3, 6)."""
        for number, body in self._bodies.items():
            new = body.cross[:, :POSE] @ J.reshape(-1, POSE).T
            self._bodies[number] = replace(body, cross=np.concatenate([body.cross, new], axis=1))

    def landmarks_transformed(self, slots: NDArray[np.intp], K: Array) -> None:
        """The coordinates Y of landmarks `slots` became ``Y + K [r, φ]``; K (M, 3, 6)."""
        columns = (CAMERA + 3 * slots[:, None] + np.arange(3)).reshape(-1)
        for number, body in self._bodies.items():
            cross = body.cross.copy(order="K")
            cross[:, columns] += cross[:, :POSE] @ K.reshape(-1, POSE).T
            self._bodies[number] = replace(body, cross=cross)

    def landmarks_dropped(self, holes: NDArray[np.intp], movers: NDArray[np.intp], left: int) -> None:
        """Landmarks went: those of the slots `movers` have moved into `holes`, and the first `left` slots remain."""
        for number, body in self._bodies.items():
            marks = body.cross[:, CAMERA:].reshape(len(body.cross), -1, 3).copy()
            marks[:, holes] = marks[:, movers]
            cross = np.concatenate([body.cross[:, :CAMERA], marks[:, :left].reshape(len(marks), -1)], axis=1)
            self._bodies[number] = replace(body, cross=cross)

    def camera_corrected(self, slots: NDArray[np.intp], solution: Solution, W: Array, camera: CameraBelief) -> None:
        """The filter's state changed by ``P[:, g] s``, its covariance became ``P − W Wᵀ`` with ``W = P[:, g] B``.

        g = [r, φ, landmarks `slots`]; s and B are the solution's; the camera has its covariance after the update, at
        the pose before it. What has been learnt of the camera and the map is
        learnt of the bodies too, as far as they hang on it.
        """
        columns = np.concatenate([np.arange(POSE), (CAMERA + 3 * slots[:, None] + np.arange(3)).reshape(-1)])
        for number, body in self._bodies.items():
            self._bodies[number] = corrected_by_map(body, columns, solution.s, solution.B, W, camera)

    # --- parts ---

    def _require_usable(self, observations: Sequence[ObjectObservations]) -> None:
        if len({o.id for o in observations}) != len(observations):
            raise MeasurementError("ekf: an object stands twice among the observations")
        for o in observations:
            if o.id in self._bodies:
                continue
            if np.isfinite(self._rig.triangulate(o.uv_left, o.uv_right)).all(axis=1).sum() < 3:
                raise MeasurementError(f"ekf: object {o.id} is new and has fewer than three points with a depth")

    def _start(self, o: ObjectObservations, camera: CameraBelief) -> tuple[Body, Sight]:
        h = self._rig.triangulate(o.uv_left, o.uv_right)
        T, near = first_frame(camera.T_world_left, h)
        T = T if o.T_world_object is None else o.T_world_object
        body = found(o.id, T, *self._models.objects.first_velocity(o), len(camera.columns))
        body, _ = self._join(body, o, near, camera)
        return body, Sight(True, np.sort(body.ids))

    def _measure(self, body: Body, o: ObjectObservations, camera: CameraBelief, dt: float) -> tuple[Body, Sight]:
        """Correct a body by its known points, then let the new ones join.

        Where nothing agrees with the body (or too little), it is not known where it is, and nothing joins.
        """
        body = drifted(body, camera.T_world_left, self._models.objects.drift / self._rig.left.fu)
        place = {i: row for row, i in enumerate(body.ids.tolist())}
        rows = np.array([place.get(i, -1) for i in o.points.tolist()], np.intp)
        known = rows >= 0
        rows = rows[known]
        body, used = self._correct(body, o, known, rows, camera, dt)
        if len(rows) and not used.any():
            return body, Sight(rejected=np.sort(o.points[known]))
        failures, seen, sights = body.failures.copy(), body.seen.copy(), body.sights.copy()
        failures[rows] = np.where(used, 0, failures[rows] + 1)
        seen[rows] = self._now
        sights[rows] += used
        wanted = ~known
        wanted[known] = failures[rows] >= MAX_REJECTIONS
        body = without(replace(body, failures=failures, seen=seen, sights=sights), failures >= MAX_REJECTIONS)
        body, new = self._join(body, o, wanted, camera)
        bad = np.flatnonzero(known)[~used]
        good = np.concatenate([o.points[known][used], o.points[new]])
        return body, Sight(bool(used.any()), np.sort(good), np.sort(o.points[bad[~isin(bad, new)]]))

    def _correct(
        self, body: Body, o: ObjectObservations, known: BoolArray, rows: NDArray[np.intp], camera: CameraBelief,
        dt: float,
    ) -> tuple[Body, BoolArray]:  # fmt: skip
        """The body after its update, and which of the observations `known` were used.

        Unchanged where none can be, or where no body moves as they say.
        """
        nothing = np.zeros(len(rows), bool)
        if not len(rows):
            return body, nothing
        z = np.concatenate([o.uv_left, o.uv_right[:, :1]], axis=1)[known]
        try:
            wider, covariances, problem, gated = self._gated(body, rows, z, o.T_world_object, camera)
            solution = solve(problem, gated)
        except UnsolvableError:
            return body, nothing
        if solution is None or not _enough(solution, body):
            return body, nothing
        after = corrected(wider, camera, covariances, solution.s, solution.B)
        if not (np.isfinite(after.T).all() and (after.covariance.diagonal() > 0).all()):
            return body, nothing
        if not self._models.objects.possible(*_motion(after), *_motion(body), dt):
            return body, nothing
        return after, solution.used

    def _gated(
        self, body: Body, rows: NDArray[np.intp], z: Array, guess: Array | None, camera: CameraBelief
    ) -> tuple[Body, Gathered, Problem, Gated]:
        """Gate the observations; where most fail together, the impulse was larger than expected, and not they wrong.

        As for the camera: the guess and wider motion noise are tried until most pass; if nothing helps, the gate at
        the prediction stands.
        """
        most = max(MIN_POINTS, (len(z) + 1) // 2)
        first: tuple[Body, Gathered, Problem, Gated] | None = None
        for factor in (0.0, *INFLATION):
            wider = widened(body, factor)
            covariances, problem = self._problem(wider, rows, z, guess, camera)
            for at_guess in (False,) if guess is None else (False, True):
                gated = gate(problem, at_guess)
                tried = (wider, covariances, problem, gated)
                first = first or tried
                if len(z) < most or gated.used.sum() >= most:
                    return tried
        assert first is not None
        return first

    def _problem(
        self, body: Body, rows: NDArray[np.intp], z: Array, guess: Array | None, camera: CameraBelief
    ) -> tuple[Gathered, Problem]:
        covariances = gathered(body, camera, rows)
        model = BodyMeasurement(self._rig, inverse(body.T) @ camera.T_world_left, body.points.select(rows))
        change = None if guess is None else -change_between(body.T, guess)[[3, 4, 5, 0, 1, 2]]
        return covariances, Problem(
            np.zeros(len(covariances.own)), covariances.own, z, self._models.pixel_sigma, model, self._iterations,
            self._models.gate_probability, change,
        )  # fmt: skip

    def _join(
        self, body: Body, o: ObjectObservations, wanted: BoolArray, camera: CameraBelief
    ) -> tuple[Body, NDArray[np.intp]]:
        """With those of the wanted points that have a depth, as far as there is room; and which they are."""
        rows = np.flatnonzero(wanted)
        if not len(rows):
            return body, rows
        h = self._rig.triangulate(o.uv_left[rows], o.uv_right[rows])
        deep = np.isfinite(h).all(axis=1)
        rows, h = rows[deep], h[deep]
        most = self._models.objects.points
        body = without(body, points_to_replace(self._now - body.seen, body.sights, len(rows), most))
        room = most - len(body.ids)
        rows, h = rows[:room], h[:room]
        if not len(rows):
            return body, rows
        shape = self._shape(body, h, inverse(camera.T_world_left) @ body.T)
        z = np.concatenate([o.uv_left[rows], o.uv_right[rows, :1]], axis=1)
        h, noise = with_shape(self._rig.project_stereo, z, h, self._models.pixel_sigma, shape)
        return joined(body, camera, o.points[rows], h, noise, self._now), rows

    def _shape(self, body: Body, h: Array, T_left_body: Array) -> Shape:
        """The body's shape in camera coordinates, by the points it has, or else by the new ones at h (M, 3)."""
        if len(body.ids) < MIN_POINTS:
            return shape_of(h, self._rig.triangulation_covariance(h, self._models.pixel_sigma))
        D, rows = body.points.derivatives(), RIGID + np.arange(3 * len(body.ids)).reshape(-1, 3)
        own = body.covariance[rows[:, :, None], rows[:, None, :]]
        return shape_of(body.points.cartesian(), D @ own @ np.swapaxes(D, 1, 2)).seen_from(T_left_body)


def _enough(solution: Solution, body: Body) -> bool:
    """Whether what is used says something: at least two points, or most of the few that there are."""
    return bool(solution.used.sum() >= min(2, (len(body.ids) + 1) // 2))


def _motion(body: Body) -> tuple[Array, Array]:
    """Velocity [ω, v] (6,) of a body and its covariance (6, 6)."""
    return body.velocity.copy(), body.covariance[6:RIGID, 6:RIGID].copy()


def _estimate(body: Body, stamp: float, sight: Sight) -> ObjectEstimate:
    return ObjectEstimate(
        body.id, stamp, body.T.copy(), body.covariance[:6, :6].copy(), *_motion(body),
        sight.measured, sight.used, sight.rejected,
    )  # fmt: skip
