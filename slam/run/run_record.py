"""What a run gathers frame by frame, and what its ``summary.json`` says of it: accuracy, consistency and times."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from slam.data import CommonError, FrameResult
from slam.evaluation.consistency import EXACT, PIXELS_ALONE, are_covariances
from slam.evaluation.joint_errors import JointErrors, with_newest
from slam.evaluation.objects import ObjectScore
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.input.warnings import REPEATED
from slam.interfaces import ConsideringBackend
from slam.run.recording import Recording
from slam.run.replay import Replay
from slam.run.schema import STAGES
from slam.run.truth_check import truth_doubt
from slam.runtime.compilation import compile_clock
from slam.sequences import Sequence
from slam.sequences.live import LiveFrames
from slam.system import StereoSlam
from slam.tracks.step import HIDDEN

logger = logging.getLogger("slam.run")

_DISAGREE = 0.1  # of a path's length, by which two estimates of its last pose cannot differ


@dataclass(eq=False)
class RunRecord:
    """What a run has gathered so far: the online path, frame by frame, but for frames that have no pose at all."""

    numbers: list[int] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    common: list[CommonError] = field(default_factory=list)
    with_newest: list[Array] = field(default_factory=list)  # covariances of the last poses' errors with each one's own
    measured: list[bool] = field(default_factory=list)
    closed: list[int] = field(default_factory=list)  # rows of the poses that a loop has moved
    milliseconds: list[dict[str, float]] = field(default_factory=list)
    compiled_before: float = field(default_factory=compile_clock.seconds)  # [s]
    ages: list[float] = field(default_factory=list)  # of frames of a live run when they are done [s]
    features: list[tuple[int, int]] = field(default_factory=list)  # number of them, and of those with a right pixel
    without_right: list[int] = field(default_factory=list)  # rows of frames without a right image
    depths: list[float] = field(default_factory=list)  # median of what each frame sees [m]
    bodies: set[int] = field(default_factory=set)
    seen: Counter[int] = field(default_factory=Counter)  # number of frames in which each landmark was measured
    last_seen: dict[int, int] = field(default_factory=dict)  # number of the last of them
    map_size: int = 0
    repeated: int = 0  # frames with the images of the one before
    hidden: int = 0  # frames in which something moved past a standing vehicle
    rejected: int = 0
    used: int = 0
    nis: float = 0.0
    nis_dof: int = 0

    def add(self, number: int, result: FrameResult) -> None:
        """Take in one frame, `number` in its sequence."""
        self.numbers.append(number)
        self.statuses.append(result.status.value)
        self.milliseconds.append(dict(result.milliseconds))
        self.repeated += result.reason == REPEATED
        self.hidden += result.reason == HIDDEN
        self.features.append((len(result.features), int(result.features.has_stereo.sum())))
        self.bodies.update(thing.id for thing in result.objects)
        measured = [*(result.report.used.tolist() if result.status.measured else []), *result.added.tolist()]
        self.seen.update(measured)
        self.last_seen.update(dict.fromkeys(measured, number))
        self.map_size = result.map_size
        if not result.located:
            return
        self.closed += [len(self.poses)] if result.loop is not None else []
        self.stamps.append(result.estimate.stamp)
        self.poses.append(result.estimate.T_world_left)
        self.covariances.append(result.estimate.covariance)
        self.common.append(result.common)
        self.with_newest.append(with_newest(result.recent, self.stamps))
        self.measured.append(result.status.measured)
        self.rejected += len(result.report.rejected)
        self.used += len(result.report.used)
        if result.report.dof:
            self.nis += result.report.nis
            self.nis_dof += result.report.dof

    @property
    def trajectory(self) -> Trajectory:
        """The online path."""
        return Trajectory(np.array(self.stamps), np.array(self.poses).reshape(-1, 4, 4))


def results_of(
    sequence: Sequence | Recording,
    system: StereoSlam | Replay,
    record: RunRecord,
    final: Trajectory,
    score: ObjectScore | None,
) -> dict[str, Any]:
    """The part of a summary that says how good the run was; frames whose pose was not measured are in no error."""
    measured, path = np.array(record.measured), record.trajectory
    singular = _singular(record, final)
    online, steps = path.select(measured), np.diff(path.positions, axis=0)
    noise, doubt = getattr(sequence, "truth_noise", TruthNoise()), ""
    of_camera = sequence.format != "synthetic" and not noise.mounting  # in a file of the camera's own poses
    if sequence.ground_truth is not None and of_camera and not getattr(system, "doubt", ""):  # else nothing tells it
        doubt = truth_doubt(online, sequence.ground_truth, noise)
    if doubt:
        logger.warning("%s", doubt)
    speeds = np.linalg.norm(steps, axis=1) / np.diff(path.stamps)
    rows = np.flatnonzero(measured)
    common, joint = [record.common[row] for row in rows], JointErrors.of(record.with_newest, rows)
    found: dict[str, Any] = {
        "path_length_m": path.length,
        "speed_m_per_s": float(np.median(speeds)) if len(speeds) else None,
        "final_sigma_m": float(np.sqrt(np.trace(record.covariances[-1][3:, 3:]))),
        "landmarks": record.map_size,
        "observations": {"used": record.used, "rejected": record.rejected},
        "accuracy": {
            "online": evaluate(online, sequence),
            "final": evaluate(final.select(np.isin(final.stamps, online.stamps)), sequence),
            "poses left out": int((~measured).sum()),
        },
        "consistency": {
            "NIS per degree of freedom": record.nis / record.nis_dof if record.nis_dof else None,
            **({} if doubt else consistency(online, np.array(record.covariances)[measured], sequence, common, joint)),
        },
    }
    if singular:
        found["consistency"]["singular covariances"] = singular
    if found["accuracy"]["online"]:  # for the picture's band, which is that of the verdict
        found["truth"] = asdict(noise)
    if doubt:
        found["truth_doubt"] = doubt
    if isinstance(system, StereoSlam):
        values = getattr(sequence, "values", None)  # of a world: with recordings nobody knows
        if "mean NEES" in found["consistency"] and system.config.self_calibration.enabled and values is not None:
            found["consistency"][EXACT] = not (values["focal_error"] or values["turn_error"])
        if found["consistency"].get("dof") and system.config.self_calibration.enabled:
            found["consistency"][PIXELS_ALONE] = not isinstance(system.backend, ConsideringBackend)
        found["self_calibration"] = system.calibration.summary()
        found["loops"] = system.atlas.summary()
        found["bodies"] = len(record.bodies)
    if score is not None:
        found["objects"] = score.summary()
    return found | _times(record)


def _singular(record: RunRecord, final: Trajectory) -> int:
    """In how many frames the back end claims no covariance; warns of them, and of paths that do not fit together."""
    path = record.trajectory
    if missing := int((~np.isin(path.stamps, final.stamps)).sum()) if len(final) else 0:
        logger.warning(
            "the back end's trajectory() lacks %d of %d frames: it needs a pose for each", missing, len(path)
        )
    if len(final) and final.stamps[-1] == path.stamps[-1]:
        apart = float(np.linalg.norm(final.positions[-1] - path.positions[-1]))
        if apart > _DISAGREE * path.length:
            logger.warning("the back end's estimate() and trajectory() are %.3g m apart in the last frame", apart)
    singular = int((~are_covariances(np.array(record.covariances[1:]).reshape(-1, 6, 6))).sum())
    if singular:
        logger.warning(
            "the back end claims a singular covariance for %d of %d poses: it is no uncertainty", singular, len(path)
        )
    return singular


def _times(record: RunRecord) -> dict[str, Any]:
    """Medians per stage over all frames but the first, which may wait for compilers."""
    totals = [sum(each.values()) for each in record.milliseconds]
    later = record.milliseconds[1:] or record.milliseconds
    median = {stage: float(np.median([each.get(stage, 0.0) for each in later])) for stage in STAGES}
    times = {"median": median, "median_total": float(np.median(totals[1:] or totals)), "first_frame": totals[0]}
    return {"milliseconds": times, "compile_seconds": compile_clock.seconds() - record.compiled_before}


def live_frames(live: LiveFrames, record: RunRecord) -> dict[str, Any]:
    """Frames that came too late, and how old frames were when they were done."""
    later = 1e3 * np.array(record.ages[1:] or record.ages or [np.nan])  # the first may wait for compilers
    return {
        "frames dropped": live.dropped,
        "milliseconds behind": {"median": float(np.median(later)), "max": float(later.max())},
    }
