"""Trials of the consistency experiment: one seed of a world, run through every back end, and the bound of its path.

The world's own observations are given to all back ends, with true association, and each starts at a pose drawn from the
prior about the true one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np

import backends
from experiments.cramer_rao import pose_bounds
from experiments.simulated_recording import true_recording, with_mismatches
from slam.data import Observations
from slam.evaluation.metrics import nees, pose_residuals
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.models import EstimatorModels, MotionModel, SlideModel, models_for
from slam.registry import ONLINE
from slam.run.recording import Recording
from slam.worlds import open_world
from slam.worlds.sequence import WorldSequence

CASES = ("desk", "aisle", "drawn")
DRAWN = MotionModel(acceleration=0.15, angular_acceleration=0.15)
WRONG = 0.1  # share of wrong matches
_BOUNDS = 4  # frames at which the online bound is computed


@dataclass(frozen=True)
class Run:
    """What one back end made of one recording of F frames."""

    online: Array  # errors of the newest pose (F, 6), [rotation, translation]
    final: Array  # errors of the whole path at the end (F, 6)
    nees: Array  # of the newest pose (F,)
    nis: Array  # of the updates (F,), 0 where there was none
    dof: Array  # likewise
    landmark: float  # mean NEES of the landmarks at the end, three degrees of freedom
    rejected: float  # share of the observations that were rejected


@dataclass(frozen=True)
class Trial:
    """One seed of a case: the runs by back end, without and with wrong matches, and the bounds."""

    runs: dict[str, Run]  # by the back end's name
    spoilt: dict[str, Run]  # likewise
    checked: np.ndarray  # frames (B,) of the online bound
    online_bound: Array  # least covariances (B, 6, 6) of the newest pose
    final_bound: Array  # least covariances (F, 6, 6) of the whole path


def simulated(case: str, seed: int, frames: int) -> tuple[Recording, WorldSequence]:
    """A recording of a case, in the world's own coordinates, and the world."""
    world = "desk" if case == "drawn" else case
    sequence = open_world(f"{world}?frames={frames}&seed={seed}&outliers=0")
    models = replace(models_for(sequence.kind), pixel_sigma=sequence.values["sigma"], slide=SlideModel())
    rng = np.random.default_rng([seed, 77])
    if case == "drawn":
        models = replace(models, motion=DRAWN, initial_velocity_sigma=0.1, initial_angular_velocity_sigma=0.1)
        path = drawn_path(sequence.world.T_world_left[0], sequence.world.stamps, models, rng)
        sequence = WorldSequence(sequence.name, replace(sequence.world, T_world_left=path), sequence.values)
    sigma = np.repeat([models.initial_rotation_sigma, models.initial_position_sigma], 3)
    start = sequence.ground_truth.poses[0] @ se3.exp(sigma * rng.standard_normal(6))
    return true_recording(sequence, models=replace(models, T_world_left=start)), sequence


def drawn_path(T: Array, stamps: Array, models: EstimatorModels, rng: np.random.Generator) -> Array:
    """Poses (F, 4, 4) from T on whose velocities walk randomly as the models say."""
    v = models.initial_velocity_sigma * rng.standard_normal(3)
    w = models.initial_angular_velocity_sigma * rng.standard_normal(3)
    poses = [T]
    for dt in np.diff(stamps):
        sigma_v, sigma_w = np.sqrt(models.motion.velocity_variance(dt))
        v, w = v + sigma_v * rng.standard_normal(3), w + sigma_w * rng.standard_normal(3)
        T = se3.pose(T[:3, :3] @ se3.so3_exp(w * dt), T[:3, 3] + v * dt)
        poses.append(T)
    return np.array(poses)


def run(recording: Recording, points: Array, name: str) -> Run:
    """One back end on one recording; `points` (N, 3) are the true landmarks."""
    backend = backends.create(name, recording.rig, models=recording.models)
    truth = recording.ground_truth
    assert truth is not None
    poses, covariances, nis, dof = [], [], [], []
    rejected = given = 0
    for frame in recording:
        backend.predict(frame.stamp)
        report = backend.update(frame.observed)
        backend.add(frame.added)
        estimate = backend.estimate(landmarks=False)
        poses.append(estimate.T_world_left)
        covariances.append(estimate.covariance)
        nis.append(report.nis if report.dof else 0.0)
        dof.append(report.dof)
        rejected, given = rejected + len(report.rejected), given + len(frame.observed)
    online = pose_residuals(np.array(poses), truth.poses)
    last = backend.estimate()
    landmark = nees(last.positions - points[last.ids], last.covariances).mean()
    return Run(
        online, pose_residuals(backend.trajectory().poses, truth.poses), nees(online, np.array(covariances)),
        np.array(nis), np.array(dof), float(landmark), rejected / max(1, given),
    )  # fmt: skip


def trial(case: str, seed: int, frames: int, wrong: bool) -> Trial:
    """All of one seed."""
    recording, sequence = simulated(case, seed, frames)
    points = sequence.landmarks.positions
    runs = {name: run(recording, points, name) for name in ONLINE}
    spoilt = with_mismatches(recording, WRONG, seed) if wrong else None
    runs_spoilt = {} if spoilt is None else {name: run(spoilt, points, name) for name in ONLINE}
    seen = [_all_seen(f.observed, f.added) for f in recording]
    truth = sequence.ground_truth

    def bounds(count: int) -> Array:
        return pose_bounds(recording.rig, recording.models, truth.stamps, truth.poses, points, seen[:count])

    checked = np.unique(np.linspace(min(5, frames - 1), frames - 1, _BOUNDS).astype(int))
    final = bounds(frames)
    online = np.array([bounds(k + 1)[-1] for k in checked[:-1].tolist()] + [final[-1]])
    return Trial(runs, runs_spoilt, checked, online, final)


def _all_seen(observed: Observations, added: Observations) -> Observations:
    parts = [np.concatenate([getattr(o, name) for o in (observed, added)]) for name in ("ids", "uv_left", "uv_right")]
    return Observations(*parts)


def trials(cases: Sequence[str], seeds: int, frames: int, wrong: int) -> dict[str, list[Trial]]:
    """All seeds of each case, two at a time; the first `wrong` of them with wrong matches, too."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        jobs = {case: [pool.submit(trial, case, k, frames, k < wrong) for k in range(seeds)] for case in cases}
        return {case: [job.result() for job in own] for case, own in jobs.items()}
