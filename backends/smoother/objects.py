"""Moving bodies in the smoother back end: a fixed-lag smoother for each, beside the graph of the camera's poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from backends.smoother.objects_factors import VelocityPrior
from backends.smoother.objects_kernels import FRAME
from backends.smoother.objects_prediction import Agreement, PredictedBody, agreement, predicted
from backends.smoother.objects_window import (
    CameraWindow,
    Solver,
    Window,
    drifted,
    opened,
    with_frame,
    with_points,
    without_points,
)
from backends.smoother.path import Path
from backends.smoother.pose_set import PoseSet
from slam.data import BoolArray, IdArray, IndexArray, Observations
from slam.errors import MeasurementError
from slam.geometry.arrays import isin
from slam.geometry.se3 import Array, adjoint, inverse, transform
from slam.models import EstimatorModels
from slam.object_data import ObjectEstimate, ObjectObservations, Sight
from slam.object_models import ObjectModels
from slam.objects.points import MAX_REJECTIONS, MIN_POINTS, Shape, first_frame, points_to_replace, shape_of, with_shape
from slam.window.stereo import RectifiedStereo

_LAG = 4  # frames of a window at least
_BATCH = 2  # cost: so many frames leave it together: that costs hardly more than for one
_ITERATIONS = 2  # numerics: linearisations of a body's window in a frame
# numerics: Keeps poses of the camera apart that are taken to move together: of each variance, and at least [rad², m²].
_JITTER, _LEAST = 1e-8, 1e-14


class ObjectSmoother:
    """All bodies of one smoother.

    A body's frame is fixed at its first sight: its axes are the world's, its origin is the mean of the points. So its
    pose has no error then, and what is uncertain about the first sight (stereo noise, the camera's pose) is the
    uncertainty of its points; from then on the pose is that of the motion since.

    Args:
        stereo: the rig's rectified rig.
        sigma: pixel noise in it [px].
        models: gate and motion of bodies.
    """

    def __init__(self, stereo: RectifiedStereo, sigma: float, models: EstimatorModels) -> None:
        self._stereo = stereo
        self._sigma = sigma
        self._models = models
        self._solver = Solver(stereo, sigma, models.objects, _ITERATIONS)
        self._windows: dict[int, Window] = {}

    # --- the protocol (documented in slam.interfaces.ObjectBackend) ---

    def update(
        self, observations: Sequence[ObjectObservations], path: Path, last_poses: Callable[[int], PoseSet]
    ) -> list[ObjectEstimate]:
        """See `slam.interfaces.ObjectBackend.update_objects`.

        The path's last frame is the current one; `last_poses` gives the camera's poses in so many frames, and is called
        if need be.
        """
        seen = {o.id: _Measured.of(o, self._stereo, self._models.objects) for o in observations}
        self._require_usable(observations, seen)
        if not (self._windows or seen):
            return []
        camera, out = last_poses(_LAG + _BATCH), []
        for number in sorted({*self._windows, *seen}):
            body = self._windows.get(number)
            if body is None:
                body, sight = self._start(seen[number], path, camera)
            else:
                body, sight = self._step(body, seen.get(number), path, camera)
            self._windows[number] = body
            out.append(self._estimate(number, body, sight))
        return out

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.ObjectBackend.remove_objects`."""
        numbers = {int(i) for i in ids}
        for number in sorted(numbers - set(self._windows)):
            raise MeasurementError(f"smoother: object {number} is unknown")
        for number in numbers:
            del self._windows[number]

    # --- parts ---

    def _require_usable(self, observations: Sequence[ObjectObservations], seen: dict[int, _Measured]) -> None:
        if len(seen) != len(observations):
            raise MeasurementError("smoother: an object stands twice among the observations")
        for number, measured in seen.items():
            if number not in self._windows and measured.deep.sum() < 3:
                raise MeasurementError(f"smoother: object {number} is new and has fewer than three points with a depth")

    def _start(self, seen: _Measured, path: Path, camera: PoseSet) -> tuple[Window, Sight]:
        frame, X = path.count - 1, path.poses[-1].copy()
        T, near = first_frame(X, seen.local)
        T = T if seen.guess is None else seen.guess
        window = opened(frame, float(path.stamps[-1]), T, X, seen.first_velocity)
        cameras = _cameras(window.frames, path, camera)
        window, _ = self._join(window, cameras, seen, near)
        window = self._solver.solved(window, cameras)
        return window, Sight(True, np.sort(window.ids))

    def _step(self, window: Window, seen: _Measured | None, path: Path, camera: PoseSet) -> tuple[Window, Sight]:
        """The window with one more frame, and what was seen.

        Without the frame's observations where these cannot be solved, or no body moves so; restarted if that
        fails, too.
        """
        for given in (seen, None):
            with suppress(np.linalg.LinAlgError):
                after, sight = self._solved_step(window, given, path, camera)
                if self._possible(window, after):
                    return after, sight if given is seen or seen is None else Sight(rejected=np.sort(seen.ids))
        return self._restarted(window, seen, path, camera)

    def _possible(self, before: Window, after: Window) -> bool:
        """Whether a body can move as its window says after a further frame."""
        dt = float(after.stamps[-1] - before.stamps[-1])
        return self._models.objects.possible(*after.motion, *before.motion, dt)

    def _restarted(self, window: Window, seen: _Measured | None, path: Path, camera: PoseSet) -> tuple[Window, Sight]:
        """The body without its points, velocity and past, where it was last or where the guess has it."""
        T = window.T[-1] if seen is None or seen.guess is None else seen.guess
        spread = np.full(6, self._models.objects.initial_velocity_sigma**2)
        unknown = VelocityPrior(*self._models.objects.first_velocity(None))
        window = opened(path.count - 1, float(path.stamps[-1]), T, path.poses[-1].copy(), unknown, np.diag(spread))
        return self._solver.solved(window, _cameras(window.frames, path, camera)), Sight()

    def _solved_step(self, window: Window, seen: _Measured | None, path: Path, camera: PoseSet) -> tuple[Window, Sight]:
        frame, stamp = path.count - 1, float(path.stamps[-1])
        if frame == window.frames[-1]:
            return window, Sight()
        cameras = _cameras(np.append(window.frames, frame), path, camera)
        expected = predicted(window, cameras, stamp, self._models.objects)
        if seen is None:
            window, sight = with_frame(window, frame, stamp, expected.T, expected.X, 1.0), Sight()
        else:
            found, known, rows = self._agreement(window, expected, seen)
            window = with_frame(window, frame, stamp, found.T, expected.X, found.scale)
            window.z[-1, rows[found.used]] = seen.z[known][found.used]
            density = self._models.objects.drift / self._stereo.intrinsics[0]
            window = drifted(window, inverse(found.T) @ expected.X, density)
            window, sight = self._exchange(window, cameras, seen, known, rows, found.used)
        window = self._solver.solved(window, cameras)
        if len(window) >= _LAG + _BATCH:
            window = self._solver.without_oldest(window, cameras, _BATCH)
        return window, sight

    def _agreement(
        self, window: Window, expected: PredictedBody, seen: _Measured
    ) -> tuple[Agreement, BoolArray, IndexArray]:
        """Where the body is, which of the observations (M,) are of points it has, and their rows there.

        Fewer than two that agree say nothing, but for a body that has but one or two.
        """
        known, rows = seen.known(window)
        nothing = Agreement(expected.T, np.zeros(len(rows), bool), 1.0)
        if not len(rows):
            return nothing, known, rows
        found = agreement(
            expected, self._stereo, self._sigma, self._models.gate_probability, window.points, rows, seen.z[known],
            seen.guess,
        )  # fmt: skip
        enough = found.used.sum() >= min(2, (len(window.ids) + 1) // 2)
        return (found if enough else nothing), known, rows

    def _exchange(
        self, window: Window, camera: CameraWindow, seen: _Measured, known: BoolArray, rows: IndexArray, used: BoolArray
    ) -> tuple[Window, Sight]:
        """Points that failed too often leave, new ones join.

        Where nothing agrees with the body, it is not known where it is, and nothing joins.
        """
        if len(rows) and not used.any():
            return window, Sight(rejected=np.sort(seen.ids[known]))
        failures, unseen, sights = window.failures.copy(), window.unseen.copy(), window.sights.copy()
        failures[rows] = np.where(used, 0, failures[rows] + 1)
        unseen[rows] = 0
        sights[rows] += used
        wanted = ~known
        wanted[known] = failures[rows] >= MAX_REJECTIONS
        window = replace(window, failures=failures, unseen=unseen, sights=sights)
        window = without_points(window, failures >= MAX_REJECTIONS)
        window, new = self._join(window, camera, seen, wanted)
        bad = np.flatnonzero(known)[~used]
        good = np.concatenate([seen.ids[known][used], seen.ids[new]])
        return window, Sight(bool(used.any()), np.sort(good), np.sort(seen.ids[bad[~isin(bad, new)]]))

    def _join(
        self, window: Window, camera: CameraWindow, seen: _Measured, wanted: BoolArray
    ) -> tuple[Window, IndexArray]:
        """With those of the wanted points that have a depth, as far as there is room; and which they are."""
        most = self._models.objects.points
        rows = np.flatnonzero(wanted & seen.deep)
        if not len(rows):
            return window, rows
        gone = points_to_replace(window.unseen, window.sights, len(rows), most)
        if gone.any():
            window = without_points(self._solver.with_measured(window, camera, gone), gone)
        rows = rows[: most - len(window.ids)]
        if not len(rows):
            return window, rows
        Y = inverse(window.prior.X[-1]) @ window.T[-1]
        T_body_left = inverse(Y)
        shape = self._shape(window, seen.local[rows], T_body_left).seen_from(Y)
        h, _ = with_shape(self._stereo.project, seen.z[rows], seen.local[rows], self._sigma, shape)
        return with_points(window, seen.ids[rows], transform(T_body_left, h), shape, seen.z[rows]), rows

    def _shape(self, window: Window, h: Array, T_body_left: Array) -> Shape:
        """The body's shape in body coordinates, by the points it has, or else by the new ones at h (M, 3)."""
        own = window.point_covariances()
        if len(own) < MIN_POINTS:
            _, J = self._stereo.project(h)
            inverse_J = np.linalg.inv(J) * self._sigma
            return shape_of(h, inverse_J @ np.swapaxes(inverse_J, 1, 2)).seen_from(T_body_left)
        return shape_of(window.points, own)

    def _estimate(self, number: int, window: Window, sight: Sight) -> ObjectEstimate:
        last = FRAME * (len(window) - 1)
        covariance = window.covariance[last : last + 6, last : last + 6].copy()
        velocity, P = window.motion
        return ObjectEstimate(
            number, float(window.stamps[-1]), window.T[-1].copy(), covariance, velocity.copy(), P.copy(),
            sight.measured, sight.used, sight.rejected,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Measured:
    """Observations of a body in the rectified rig.

    Attributes:
        ids: of the points (M,).
        z: (M, 3).
        local: where they triangulate to (M, 3), in left-camera coordinates; NaN without a depth.
        guess: of T_world_object, or None.
        first_velocity: what is known of its velocity if it is new.
    """

    ids: IdArray
    z: Array
    local: Array
    guess: Array | None
    first_velocity: VelocityPrior

    @classmethod
    def of(cls, o: ObjectObservations, stereo: RectifiedStereo, models: ObjectModels) -> _Measured:
        z = stereo.measure(Observations(o.points, o.uv_left, o.uv_right))
        return cls(o.points, z, stereo.triangulate(z), o.T_world_object, VelocityPrior(*models.first_velocity(o)))

    @property
    def deep(self) -> BoolArray:
        """Which have a depth (M,)."""
        return np.asarray(np.isfinite(self.local).all(axis=1))

    def known(self, window: Window) -> tuple[BoolArray, IndexArray]:
        """Which of the points the window has (M,), and their rows there."""
        place = {i: row for row, i in enumerate(window.ids.tolist())}
        rows = np.array([place.get(i, -1) for i in self.ids.tolist()], np.intp)
        known = rows >= 0
        return known, rows[known]


def _cameras(frames: IndexArray, path: Path, known: PoseSet) -> CameraWindow:
    """The camera's poses in these frames; those older than the known ones are taken to move with the oldest of them."""
    poses = path.poses[frames]
    J = np.zeros((len(frames), 6, len(known), 6))
    for i, (frame, X) in enumerate(zip(frames.tolist(), poses)):
        at = max(0, int(np.searchsorted(known.frames, frame, side="right")) - 1)
        J[i, :, at] = np.eye(6) if frame == known.frames[at] else adjoint(inverse(X) @ known.poses[at])
    flat = J.reshape(6 * len(frames), -1)
    P = flat @ known.covariance @ flat.T
    return CameraWindow(poses, P + np.diag(_JITTER * P.diagonal() + _LEAST))
