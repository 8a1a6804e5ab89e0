"""Give any back end what a run gave its own (`slam.run.recording`): estimators compared on identical measurements.

In closed loop each estimator's predictions steer its own data association instead.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam.bodies.estimator import FRAMES
from slam.data import Estimate, FrameResult, FrameStatus, StereoFeatures, UpdateReport, UpdateStatus
from slam.geometry.rig import MINIMAL_POINTS, measurement_rows
from slam.geometry.trajectory import Trajectory
from slam.input.features import Rectification
from slam.interfaces import Backend, RevisingBackend
from slam.run.recording import RecordedFrame, Recording
from slam.runtime.compilation import Stages
from slam.third_party import OnlinePose, checked, named_failures, recent_of
from slam.tracks.config import AssociationConfig
from slam.window.consensus import find_consensus


class Replay:
    """A back end that is given what was recorded; to a run it is what `slam.StereoSlam` is.

    `Backend.update` is given the pose on which the observations agree, as the system does; it is found again from this
    back end's own map. All observations are given, also those that do not agree.

    Args:
        recording: what to give.
        backend: a new back end for the recording's rectified pair, ``recording.rig.rectified.rig``.
        association: settings of that search; None for the defaults.

    Raises:
        ConfigurationError: the back end was made for cameras that are not rectified.
    """

    def __init__(self, recording: Recording, backend: Backend, association: AssociationConfig | None = None) -> None:
        self.backend = backend
        self._recording, self._config = recording, association or AssociationConfig()
        self._inside = Rectification(recording.rig)
        self._inside.require_fits(backend)
        self._sigma = self._inside.models(recording.models).pixel_sigma
        self._path: list[OnlinePose] = []  # the last poses

    def run(self) -> Iterator[tuple[int, FrameResult]]:
        """The number of each frame, and what the back end made of it, as the system gives it.

        Features are the recorded observations, without descriptors.

        Raises:
            MeasurementError: the recording is not consistent: an unknown id, or one that is in the map already.
            PartError: a back end from elsewhere raised an exception of its own.
        """
        size = 0  # landmarks in the map
        for k, frame in enumerate(self._recording):
            with named_failures(f"frame {frame.number}", self.backend):
                result = self._step(k, frame, size)
            size = result.map_size
            yield frame.number, result

    def trajectory(self) -> Trajectory:
        """The back end's final estimate of every frame's pose."""
        with named_failures("the path", self.backend):
            return self._inside.path_out(checked(self.backend, "trajectory", self.backend.trajectory()))

    def estimate(self) -> Estimate:
        """Pose and map with covariances."""
        with named_failures("the estimate", self.backend):
            return self._inside.estimate_out(checked(self.backend, "estimate", self.backend.estimate()))

    def _step(self, k: int, frame: RecordedFrame, size: int) -> FrameResult:
        inside, backend, stages, guess = self._inside, self.backend, Stages(), None
        seen, added = inside.observations_in(frame.observed), inside.observations_in(frame.added)
        with stages.stage("predict"):
            if frame.revision is not None and isinstance(backend, RevisingBackend):
                backend.revise(frame.revision.rows)
            prediction = checked(backend, "predict", backend.predict(frame.stamp))
        with stages.stage("associate"):
            if len(seen):
                points, z = backend.positions(seen.ids), measurement_rows(seen.uv_left, seen.uv_right)
                threshold, expected = self._config.consistency_sigmas * self._sigma, prediction.T_world_left
                hypotheses = self._config.hypotheses
                guess = find_consensus(inside.rig, points, z, expected, threshold, hypotheses, seed=k).T_world_left
        with stages.stage("update"):
            report = checked(backend, "update", backend.update(seen, guess))
        with stages.stage("manage"):
            at_once = np.isin(frame.removed, frame.added.ids)  # what has just been added may leave at once
            if not at_once.all():
                backend.remove(frame.removed[~at_once])
            if len(added):
                backend.add(added)
            if at_once.any():
                backend.remove(frame.removed[at_once])
        with stages.stage("estimate"):
            estimate = checked(backend, "estimate", backend.estimate(landmarks=False))
            pixels = (uv[np.isin(seen.ids, report.used)] for uv in (seen.uv_left, seen.uv_right))
            self._path = [*self._path[-FRAMES:], OnlinePose.seen(inside.rig, self._sigma, estimate, *pixels)]
            recent = recent_of(backend, self._path)
        status, reason = _status(report, begins=not size and len(added) > 0)
        rows, unknown = np.arange(len(seen) + len(added)), np.full(len(seen) + len(added), np.nan)
        features = StereoFeatures(
            frame.stamp,
            np.concatenate([frame.observed.uv_left, frame.added.uv_left]),
            np.concatenate([frame.observed.uv_right, frame.added.uv_right]),
            *(unknown, unknown, unknown),
            np.zeros(len(rows), np.int8),
            np.zeros((len(rows), 0), np.float32),
        )
        return FrameResult(
            index=k,
            status=status,
            reason=reason,
            estimate=inside.estimate_out(estimate),
            recent=inside.recent_out(recent),
            report=report,
            features=features,
            predicted=len(prediction.ids),
            matched=seen.ids,
            matched_features=rows[: len(seen)],
            added=frame.added.ids,
            added_features=rows[len(seen) :],
            erased=frame.removed,
            map_size=size + len(frame.added) - len(frame.removed),
            revision=frame.revision,
            milliseconds=stages.milliseconds,
        )


def _status(report: UpdateReport, begins: bool) -> tuple[FrameStatus, str]:
    """How a frame ended, and why it was not tracked; where it `begins`, there was no landmark before."""
    if report.status is UpdateStatus.FAILED:
        return FrameStatus.FAILED, report.reason
    if begins:
        return FrameStatus.STARTED, ""
    if len(report.used) < MINIMAL_POINTS:
        return FrameStatus.PREDICTED, report.reason or f"only {len(report.used)} landmarks matched"
    return FrameStatus.TRACKED, ""
