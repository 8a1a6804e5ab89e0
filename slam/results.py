"""Assembles the result of a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slam.data import FrameResult, FrameStatus, UpdateStatus
from slam.geometry.se3 import Array, inverse
from slam.input.warnings import REPEATED
from slam.mapping.step import Step
from slam.object_data import MovingObject
from slam.rig_error import CommonError, Revision
from slam.tracks.state import HIDDEN


def frame_result(
    step: Step, mapped_before: bool, revision: Revision | None, milliseconds: Mapping[str, float], common: CommonError
) -> FrameResult:  # fmt: skip
    """The result of a step.

    Args:
        step: the frame, after all stages.
        mapped_before: whether there ever was a landmark before this frame.
        revision: change of the correction of earlier frames' pixels before the step; None without one.
        milliseconds: wall time per stage.
        common: the part of the pose's error that it shares with the poses reported in other frames.
    """
    atlas = step.atlas
    status, reason = frame_status(step, mapped_before)
    return FrameResult(
        index=step.index,
        status=status,
        reason=reason,
        estimate=atlas.estimate(step.estimate, step.common),
        report=step.report,
        features=step.features,
        predicted=len(step.prediction.ids),
        matched=step.matches.ids,
        matched_features=step.matches.rows,
        added=step.added.ids,
        added_features=step.added.rows,
        erased=step.erased,
        map_size=len(step.landmarks),
        milliseconds=dict(milliseconds),
        moving_features=step.labels.moving,
        objects=tuple(_in_map(thing, atlas.T_map_odom) for thing in step.objects) if atlas.loops else step.objects,
        revision=revision,
        T_map_odom=atlas.T_map_odom,
        loop=atlas.closed_in(step.index),
        refused_loop=atlas.refused_in(step.index),
        keyframe=bool(atlas.keyframes) and atlas.keyframes[-1].frame == step.index,
        returned=step.returned.ids,
        common=common if atlas.anchor is None else CommonError(),
    )


def _in_map(thing: MovingObject, T_map_odom: Array) -> MovingObject:
    """A body in the map's coordinates; of its covariances only the velocity's changes, the pose's is in body axes."""
    e, R = thing.estimate, np.kron(np.eye(2), T_map_odom[:3, :3])
    motions = (T_map_odom @ T @ inverse(T_map_odom) for T in (thing.motion, thing.motion_since_found))
    estimate = replace(
        e,
        T_world_object=T_map_odom @ e.T_world_object,
        velocity=R @ e.velocity,
        velocity_covariance=R @ e.velocity_covariance @ R.T,
    )
    motion, since = motions
    return replace(thing, estimate=estimate, motion=motion, motion_since_found=since)


def frame_status(step: Step, mapped_before: bool) -> tuple[FrameStatus, str]:
    """How a frame ended, and why where it was not tracked."""
    if step.report.status is UpdateStatus.FAILED:
        return FrameStatus.FAILED, step.report.reason
    if not step.tracking.unmatched:
        return FrameStatus.TRACKED, ""
    if not mapped_before:
        return (FrameStatus.STARTED, "") if len(step.added) else (FrameStatus.PREDICTED, "nothing to see yet")
    reason = REPEATED if step.repeated else step.report.reason
    if step.matches.doubted:
        reason = f"{step.matches.doubted} landmarks agree on a pose too far from the prediction to be believed at once"
        reason = reason if step.tracking.hidden_at is None else HIDDEN
    reason = reason or f"only {len(step.report.used)} of {len(step.matches)} matched landmarks were used"
    return (FrameStatus.LOST if step.tracking.lost else FrameStatus.PREDICTED), reason
