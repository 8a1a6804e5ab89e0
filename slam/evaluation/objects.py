"""How well moving objects are found and measured, against known truth. Definitions: docs/objects.md."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.data import FrameResult, StereoFeatures
from slam.evaluation.metrics import PathErrors, error_sizes
from slam.geometry.rig import MINIMAL_POINTS
from slam.geometry.se3 import Array, inverse, log
from slam.object_data import MovingObject

_SINGULAR = 1e-9  # numerics: smallest eigenvalue of a matrix of correlations that counts
_OUTLINE = 0.25  # a feature sees as far as this, as a share of its size


def motion_errors(estimated: Array, true: Array) -> PathErrors:
    """Errors of the motions from row to row, in the true body's frame before the motion.

    ``E = T⁻¹ (H_est⁻¹ H_true) T`` with ``H = T_k T_{k−1}⁻¹`` in world coordinates and T the true pose at k − 1. It
    does not depend on where in the body its frame was put, and the translation is that of the body's own place. The
    poses T_world_object (N, 4, 4) are in one world; the body frames may differ.
    """
    H, G, before = estimated[1:] @ inverse(estimated[:-1]), true[1:] @ inverse(true[:-1]), true[:-1]
    return error_sizes(inverse(before) @ inverse(H) @ G @ before)


def object_nees(estimated: Array, covariances: Array, true: Array) -> Array:
    """NEES of a body's poses since the first row, which must be that of its first sight.

    A body's frame is put somewhere before the camera at its first sight, by definition. With the true motion
    ``H = T_k T_0⁻¹`` and where the frame truly was then, from the true camera, the error is ``log(T_est,k⁻¹ H T_0)``.
    So the first estimated pose (N, 4, 4) is that of the frame as seen from the true camera; covariances (N, 6, 6) are
    right perturbations.

    A value for each row but the first; rows whose covariance is numerically singular are left out.
    """
    e = log(inverse(estimated[1:]) @ true[1:] @ inverse(true[0]) @ estimated[0])
    P = covariances[1:]
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    known = (sigma > 0).all(axis=1)
    e, P, sigma = e[known], P[known], sigma[known]
    correlations = P / (sigma[:, :, None] * sigma[:, None, :])
    regular = np.linalg.eigvalsh(correlations)[:, 0] > _SINGULAR
    w = (e / sigma)[regular]
    return np.asarray((w * np.linalg.solve(correlations[regular], w[:, :, None])[:, :, 0]).sum(axis=1), np.float64)


@dataclass(eq=False)
class _Life:
    """What was reported of one object: the frames, and the object in each of them."""

    frames: list[int] = field(default_factory=list)
    things: list[MovingObject] = field(default_factory=list)
    votes: Counter[int] = field(default_factory=Counter)  # its features on each body, 0 for the still world

    @property
    def truth(self) -> int:
        """The body on which most of its features lie, over its life; 0 for the still world."""
        return max(self.votes, key=lambda body: (self.votes[body], -body)) if self.votes else 0

    @property
    def poses(self) -> Array:
        """Its poses T_world_object (N, 4, 4)."""
        return np.array([thing.estimate.T_world_object for thing in self.things]).reshape(-1, 4, 4)

    @property
    def measured(self) -> NDArray[np.intp]:
        """Rows in which it was measured."""
        return np.flatnonzero([thing.estimate.measured for thing in self.things])


class ObjectScore:
    """Gathers a run's results frame by frame and sums them up.

    `bodies` are true poses ``T_world_object`` (B, N, 4, 4) by frame, in the truth's world, ids from 1; `cameras` those
    of the left camera (N, 4, 4).
    """

    def __init__(self, bodies: Array, stamps: Array, cameras: Array, focal: float) -> None:
        self.bodies, self.cameras, self.stamps = bodies, cameras, stamps
        self.moves_from = [_first_motion(poses, cameras, focal) for poses in bodies]
        self.lives: defaultdict[int, _Life] = defaultdict(_Life)
        self._count: Counter[str] = Counter()  # of features and frames
        self._covered: defaultdict[int, list[bool]] = defaultdict(list)
        self._world: Any = None  # (4, 4): the truth's world in the run's; None before the first frame
        self._seen_from: dict[int, Array] = {}  # the camera's pose by frame, as it was estimated

    def add(self, frame: int, result: FrameResult, labels: NDArray) -> None:
        """Take in a frame, with the body of each feature (N,): 0 for the still world, −1 for what is nothing."""
        if self._world is None:
            self._world = result.estimate.T_world_left @ inverse(self.cameras[frame])
        self._seen_from[frame] = result.estimate.T_world_left
        flagged = np.zeros(len(labels), bool)
        flagged[result.moving_features] = True
        started = np.array([False] + [frame >= k for k in self.moves_from])
        moving = (labels > 0) & started[np.maximum(labels, 0)] & result.features.has_stereo
        rows = {"right": flagged & moving, "missed": ~flagged & moving, "wrong": flagged & (labels == 0)}
        self._count.update({name: int(found.sum()) for name, found in rows.items()})
        named = set()
        for thing in result.objects:
            life = self.lives[thing.id]
            life.votes.update(label for label in labels[thing.features].tolist() if label >= 0)
            life.frames.append(frame)
            life.things.append(thing)
            if thing.estimate.measured:
                named.add((thing.id, life.truth))
        in_view = [b for b in range(1, len(self.bodies) + 1) if (moving & (labels == b)).sum() > MINIMAL_POINTS]
        truths = [truth for _, truth in named]
        for body in in_view:
            self._covered[body].append(body in truths)
        counted = sorted(truth for truth in truths if truth == 0 or truth in in_view)
        self._count.update({"frames": 1, "counted right": counted == in_view})

    def summary(self) -> dict[str, Any]:
        """All figures; see docs/objects.md."""
        count = self._count
        precision = count["right"] / max(count["right"] + count["wrong"], 1)
        recall = count["right"] / max(count["right"] + count["missed"], 1)
        F1 = 2 * precision * recall / max(precision + recall, 1e-12)
        return {
            "features": {"precision": precision, "recall": recall, "F1": F1},
            "counted right": count["counted right"] / max(count["frames"], 1),
            "bodies": {str(b): self.body(b) for b in range(1, len(self.bodies) + 1)},
            "false objects": [len(life.frames) for life in self.lives.values() if life.truth == 0],
        }

    def body(self, body: int) -> dict[str, Any]:
        """Figures of one true body; its longest-lived object is measured."""
        lives = {id: life for id, life in self.lives.items() if life.truth == body}
        covered = self._covered[body]
        coverage = float(np.mean(covered)) if covered else None
        figures: dict[str, Any] = {"frames in view": len(covered), "coverage": coverage, "ids": sorted(lives)}
        if not lives:
            return figures
        figures["delay [frames]"] = min(min(one.frames) for one in lives.values()) - self.moves_from[body - 1]
        frames, own, true = self.poses_of(body)
        if len(frames) < 3:
            return figures
        errors, values = motion_errors(own, true), self._nees(body)
        figures["ME"] = {}
        for name, unit, sizes in (("rotation", "deg", errors.rotation), ("translation", "m", errors.translation)):
            sizes = sizes[np.diff(frames) == 1]
            if len(sizes):
                figures["ME"][f"{name} median [{unit}]"] = float(np.median(sizes))
                figures["ME"][f"{name} RMSE [{unit}]"] = float(np.sqrt(np.mean(sizes**2)))
        figures["mean NEES"], figures["dof"] = float(np.mean(values)) if len(values) else None, 6.0
        return figures

    def poses_of(self, body: int) -> tuple[NDArray[np.intp], Array, Array]:
        """Frames (M,) in which a body's longest-lived object was measured, its poses and the true ones (M, 4, 4)."""
        life = self._longest(body)
        frames = np.array(life.frames, np.intp)[life.measured]
        return frames, life.poses[life.measured], self._world @ self.bodies[body - 1][frames]

    def _longest(self, body: int) -> _Life:
        """The longest-lived object of a body; an empty one where there is none."""
        lives = [life for life in self.lives.values() if life.truth == body]
        return max(lives, key=lambda one: len(one.frames), default=_Life())

    def _nees(self, body: int) -> Array:
        """NEES of an object's motion since its estimate began, which may have been before it was first reported.

        Where an estimate restarted, it is that of the motion since.
        """
        life = self._longest(body)
        rows, poses = life.measured, life.poses
        begun = np.array([thing.found_at for thing in life.things])
        P = np.array([thing.estimate.covariance for thing in life.things])
        values: list[Array] = [np.zeros(0)]
        for at in np.unique(begun[rows]):
            mine, first, found = rows, poses[0], life.frames[0]
            if np.isfinite(at):
                mine = rows[begun[rows] == at]
                first = inverse(life.things[mine[0]].motion_since_found) @ poses[mine[0]]
                found = int(np.searchsorted(self.stamps, at - 1e-6))
            frames = np.array([found, *np.array(life.frames)[mine]])
            if found in self._seen_from:
                first = self._world @ self.cameras[found] @ inverse(self._seen_from[found]) @ first
            own, covariances = np.stack([first, *poses[mine]]), np.concatenate([np.zeros((1, 6, 6)), P[mine]])
            later = np.concatenate([[True], frames[1:] > found])
            true = self._world @ self.bodies[body - 1][frames]
            if later[1:].any():
                values.append(object_nees(own[later], covariances[later], true[later]))
        return np.concatenate(values)


def _first_motion(poses: Array, cameras: Array, focal: float) -> int:
    """First frame in which a body's place differs by more than a pixel from where it was in the first, as seen then.

    Its origin and points 0.1 m off it along its axes are looked at. The number of frames where it never does.
    """
    marks = np.concatenate([np.zeros((1, 3)), 0.1 * np.eye(3)])
    world = np.einsum("nij,mj->nmi", poses[:, :3, :3], marks) + poses[:, None, :3, 3]
    shift = np.linalg.norm(world - world[0], axis=2).max(axis=1)
    distance = np.maximum(np.linalg.norm(poses[:, :3, 3] - cameras[:, :3, 3], axis=1), 0.1)
    moved = np.flatnonzero(focal * shift / distance > 1.0)
    return int(moved[0]) if len(moved) else len(poses)


def score_for(sequence: Any) -> ObjectScore | None:
    """A score for a sequence that knows its moving objects; None for all others."""
    world = getattr(sequence, "world", None)
    if world is None or not len(world.T_world_object):
        return None
    frames = [sequence.objects(k) for k in range(len(sequence))]
    poses = np.swapaxes(np.array(frames), 0, 1)
    return ObjectScore(poses, sequence.stamps, sequence.ground_truth.poses, sequence.rig.left.fu)


def labels_in_images(sequence: Any, frame: int, features: StereoFeatures) -> NDArray[np.int64]:
    """The body that each feature (N,) of a rendered frame is seen on, 0 for the still world.

    −1 for features on an outline, which are of neither: those that within a quarter of their size see both.
    """
    image = sequence.object_ids(frame)
    angles = np.arange(8) * np.pi / 4
    ring = np.concatenate([np.zeros((1, 2)), np.column_stack([np.cos(angles), np.sin(angles)])])
    uv = features.uv_left[:, None] + _OUTLINE * features.scale[:, None, None] * ring
    limits = (image.shape[1] - 1, image.shape[0] - 1)
    column, row = np.moveaxis(np.clip(np.round(uv).astype(int), 0, limits), 2, 0)
    labels = image[row, column].astype(np.int64)
    return np.where((labels == labels[:, :1]).all(axis=1), labels[:, 0], -1)
