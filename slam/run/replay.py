"""Give any back end what a run gave its own (`slam.run.recording`): estimators compared on identical measurements.

In closed loop each estimator's predictions steer its own data association instead.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from slam.bodies.estimator import FRAMES
from slam.data import FrameResult, FrameStatus, StereoFeatures, UpdateReport, UpdateStatus
from slam.geometry.rig import MINIMAL_POINTS, measurement_rows
from slam.input.features import Rectification
from slam.interfaces import Backend, RevisingBackend
from slam.run.recording import RecordedFrame, Recording
from slam.third_party import OnlinePose, checked, named_failures, recent_of
from slam.tracks.config import AssociationConfig
from slam.window.consensus import find_consensus

_STAGES = ("predict", "associate", "update", "manage", "estimate")


def replay(
    recording: Recording, backend: Backend, association: AssociationConfig | None = None
) -> Iterator[FrameResult]:
    """Give a back end what was recorded, frame by frame; what it made of it comes back frame by frame.

    `Backend.update` is given the pose on which the observations agree, as the system does; it is found again from this
    back end's own map. All observations are given, also those that do not agree.

    Args:
        recording: what to give.
        backend: a new back end for the recording's rectified pair, ``recording.rig.rectified.rig``.
        association: settings of that search; None for the defaults.

    Yields:
        results as the system gives them; their features are the recorded observations, without descriptors.

    Raises:
        MeasurementError: the recording is not consistent: an unknown id, or one that is in the map already.
        ConfigurationError: the back end was made for cameras that are not rectified.
        PartError: a back end from elsewhere raised an exception of its own.
    """
    config, inside = association or AssociationConfig(), Rectification(recording.rig)
    inside.require_fits(backend)
    sigma, size, path = inside.models(recording.models).pixel_sigma, 0, list[OnlinePose]()
    for k, frame in enumerate(recording):
        with named_failures(f"frame {frame.number}", backend):
            result = _step(inside, backend, k, frame, size, sigma, config, path)
        size = result.map_size
        yield result


def _status(report: UpdateReport, begins: bool) -> tuple[FrameStatus, str]:
    """How a frame ended, and why it was not tracked; where it `begins`, there was no landmark before."""
    if report.status is UpdateStatus.FAILED:
        return FrameStatus.FAILED, report.reason
    if begins:
        return FrameStatus.STARTED, ""
    if len(report.used) < MINIMAL_POINTS:
        return FrameStatus.PREDICTED, report.reason or f"only {len(report.used)} landmarks matched"
    return FrameStatus.TRACKED, ""


def _step(
    inside: Rectification, backend: Backend, k: int, frame: RecordedFrame, size: int, sigma: float,
    config: AssociationConfig, path: list[OnlinePose],
) -> FrameResult:  # fmt: skip
    """One frame, before which there are so many landmarks (`size`) in the map; the last poses are in `path`."""
    times, guess = [time.perf_counter()], None
    seen, added = inside.observations_in(frame.observed), inside.observations_in(frame.added)
    if frame.revision is not None and isinstance(backend, RevisingBackend):
        backend.revise(frame.revision.rows)
    prediction = checked(backend, "predict", backend.predict(frame.stamp))
    times.append(time.perf_counter())
    if len(seen):
        points, measured = backend.positions(seen.ids), measurement_rows(seen.uv_left, seen.uv_right)
        expected = prediction.T_world_left
        threshold = config.consistency_sigmas * sigma
        guess = find_consensus(
            inside.rig, points, measured, expected, threshold, config.hypotheses, seed=k
        ).T_world_left
    times.append(time.perf_counter())
    report = checked(backend, "update", backend.update(seen, guess))
    times.append(time.perf_counter())
    at_once = np.isin(frame.removed, frame.added.ids)  # what has just been added may leave at once
    if not at_once.all():
        backend.remove(frame.removed[~at_once])
    if len(added):
        backend.add(added)
    if at_once.any():
        backend.remove(frame.removed[at_once])
    times.append(time.perf_counter())
    estimate = checked(backend, "estimate", backend.estimate(landmarks=False))
    used = seen.select(np.isin(seen.ids, report.used))
    path[:] = *path[-FRAMES:], OnlinePose.seen(inside.rig, sigma, estimate, used)
    recent = recent_of(backend, path)
    times.append(time.perf_counter())
    status, reason = _status(report, begins=not size and len(added) > 0)
    count, every = len(seen), len(seen) + len(frame.added)
    nothing = np.full(every, np.nan)
    features = StereoFeatures(
        frame.stamp,
        np.concatenate([frame.observed.uv_left, frame.added.uv_left]),
        np.concatenate([frame.observed.uv_right, frame.added.uv_right]),
        *(nothing, nothing, nothing),
        np.zeros(every, np.int8),
        np.zeros((every, 0), np.float32),
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
        matched_features=np.arange(count),
        added=frame.added.ids,
        added_features=np.arange(count, every),
        erased=frame.removed,
        map_size=size + len(frame.added) - len(frame.removed),
        revision=frame.revision,
        milliseconds=dict(zip(_STAGES, 1e3 * np.diff(times))),
    )
