"""Third-party back ends and front ends: what they answer is checked, and what they raise is named, in one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from traceback import walk_tb
from typing import Any

import numpy as np

from slam.checks import LATEST_STAMP, is_rigid
from slam.data import Estimate, Patches, Prediction, RecentPoses, UpdateReport, UpdateStatus
from slam.errors import AnswerError, PartError, SlamError, cause
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse, points_by_pose
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend, RecentBackend

_LEAST = 1e-12  # numerics: variance [rad²], [m²] of a pose that is known for certain
_OURS = ("slam", "backends", "frontends", "builtins")

#: What each method answers: a type, and the types or shapes of its attributes. Equal letters stand for equal numbers,
#: and one after a 6 for six times its number.
_POSE = {"stamp": Real, "T_world_left": (4, 4), "covariance": (6, 6), "ids": ("n",)}
_PIXELS = {"uv_left": ("n", 2), "uv_right": ("n", 2), "innovation": ("n", 2, 2)}
_REPORT = {"status": UpdateStatus, "reason": str, "used": ("k",), "rejected": ("r",), "nis": Real, "dof": Real}
_ANSWERS: dict[str, tuple[type, dict[str, Any]]] = {
    "predict": (Prediction, {**_POSE, **_PIXELS}),
    "update": (UpdateReport, _REPORT),
    "estimate": (Estimate, {**_POSE, "positions": ("n", 3), "covariances": ("n", 3, 3)}),
    "recent": (RecentPoses, {"stamps": ("k",), "poses": ("k", 4, 4), "covariance": ("6k", "6k")}),
    "positions": (np.ndarray, {"real": ("n", 3)}),
    "trajectory": (Trajectory, {}),  # which checks itself
    "patches": (Patches, {"images": ("n", "s", "s"), "centres": ("n", 2), "size": ("n",)}),
    "align": (tuple, {}),
}
_IDS, _POSES = ("ids", "used", "rejected"), ("T_world_left", "poses")
_FINITE = (*_POSES, "stamps", "covariance", "positions", "covariances", "real")
_COVARIANCES = ("covariance", "covariances", "innovation")


def checked(owner: object, method: str, answer: Any, **sizes: int) -> Any:
    """What a method of a back end or front end answered, checked; a step does that with every answer, so it is cheap.

    `sizes` of the arrays, by the letters of `_ANSWERS`, are those that are known. Raises AnswerError where it is of
    another type than documented, an array of another shape, a pose or position not finite, or a variance negative.
    """
    what, (kind, attributes) = f"{type(owner).__name__}.{method}", _ANSWERS[method]
    if not isinstance(answer, kind):
        raise AnswerError(f"{what}: must be of type {kind.__name__}, got {type(answer).__name__}")
    for name, wanted in attributes.items():
        value, where = getattr(answer, name), what if name == "real" else f"{what}: {name}"
        if isinstance(wanted, tuple):
            shape = value.shape if isinstance(value, np.ndarray) and value.dtype.kind in "fiu" else None
            if shape != wanted:
                for letter, size in zip(wanted, shape if shape and len(shape) == len(wanted) else ()):
                    if isinstance(letter, str) and letter not in sizes:
                        sizes[letter], sizes[f"6{letter}"] = size, 6 * size
                expected = tuple(map(sizes.get, wanted, wanted))
                if shape != expected:
                    got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
                    raise AnswerError(f"{where} must be an array {expected} of numbers, got {got}".replace("'", ""))
            if name in _IDS and value.dtype.kind not in "iu":
                raise AnswerError(f"{where} must be an array of ids, got {value.dtype}")
            if name in _POSES and is_rigid(value, 1e-3):
                continue
            if name in _FINITE and not np.isfinite(value).all():
                raise AnswerError(f"{where} is not finite")
            if name in _POSES:
                raise AnswerError(f"{where} is no rotation and translation")
            if name in _COVARIANCES and (value.diagonal(0, -2, -1) < -1e-9).any():  # 1e-9: rounding
                raise AnswerError(f"{where} has a negative variance")
        elif not isinstance(value, wanted):
            raise AnswerError(f"{where} must be of type {wanted.__name__}, got {type(value).__name__}")
        elif name == "stamp" and not abs(value) <= LATEST_STAMP:
            raise AnswerError(f"{where} must be within {LATEST_STAMP:g} s")
    return answer


@dataclass(frozen=True, eq=False)
class OnlinePose:
    """The camera's pose in a frame as it was estimated then."""

    rig: StereoRig
    sigma: float  # pixel noise [px]
    estimate: Estimate
    landmarks: Array  # that measured it, in camera coordinates (M, 3) [m]

    @classmethod
    def seen(cls, rig: StereoRig, sigma: float, estimate: Estimate, uv_left: Array, uv_right: Array) -> OnlinePose:
        """By the pixels (M, 2) of what was measured of landmarks, the right ones NaN where there is no stereo match."""
        local = rig.triangulate(uv_left, uv_right)
        return cls(rig, sigma, estimate, local[np.isfinite(local[:, 0])])

    @cached_property
    def noise(self) -> Array:
        """Covariance (6, 6) by the frame's own noise, which a pose of covariance Σ has taken over by a gain K.

        If the landmarks were known they alone would leave N uncertain. A pose that is surer than N has it from before,
        too: ``K = Σ N⁻¹``. Otherwise the landmarks are as unsure as the pose, and K = 1. ``K N Kᵀ`` is the smaller of
        ``Σ N⁻¹ Σ`` and N in each direction, and zero where nothing is measured.
        """
        J = (self.rig.project_stereo(self.landmarks)[1] @ points_by_pose(self.landmarks)).reshape(-1, 6)
        axes, deviations = _axes(self.estimate.covariance)
        root = axes * deviations
        shares, turn = np.linalg.eigh(root.T @ (J.T @ J / self.sigma**2) @ root)
        root, shares = root @ turn, shares.clip(min=0.0)
        return np.asarray((root * (shares / np.maximum(shares, 1.0) ** 2)) @ root.T)


def _axes(P: Array) -> tuple[Array, Array]:
    """Axes (6, 6) of a covariance, and the standard deviations (6,) along them."""
    values, axes = np.linalg.eigh(P)
    return axes, np.sqrt(values.clip(min=_LEAST))


def recent_of(backend: Backend, path: Sequence[OnlinePose]) -> RecentPoses:
    """The last poses of a back end, as many as in the path at most, checked; derived where it does not tell them."""
    if isinstance(backend, RecentBackend):
        told: RecentPoses = checked(backend, "recent", backend.recent(len(path)))
        return told
    return derived_recent(path)


def derived_recent(path: Sequence[OnlinePose]) -> RecentPoses:
    """The last poses together, approximately, of a back end that does not tell how their errors hang together.

    Each pose's error is one that goes on with the camera and grows with time, and the noise of its own frame. So two
    poses have in common what the earlier one is off by without its noise; where a pose became surer, as at an old
    place, no more than the later one is off by.
    """
    stamps = np.array([one.estimate.stamp for one in path])
    poses, P = np.stack([one.estimate.T_world_left for one in path]), np.zeros((6 * len(path), 6 * len(path)))
    common: Array = np.zeros((6, 6))
    for i, one in reversed(list(enumerate(path))):
        lasting: Array = one.estimate.covariance - one.noise
        if i + 1 < len(path):
            back = adjoint(inverse(poses[i]) @ poses[i + 1])
            axes, deviations = _axes(back @ common @ back.T)
            shares, turn = np.linalg.eigh((axes / deviations).T @ lasting @ (axes / deviations))
            axes = (axes * deviations) @ turn
            lasting = (axes * shares.clip(0.0, 1.0)) @ axes.T
        common, own = lasting, slice(6 * i, 6 * i + 6)
        P[own, 6 * i :] = common @ adjoint(inverse(poses[i:]) @ poses[i]).reshape(-1, 6).T
        P[6 * i :, own] = P[own, 6 * i :].T
        P[own, own] = common + one.noise
    return RecentPoses(stamps, poses, P)


@contextmanager
def named_failures(place: str, *parts: object) -> Iterator[None]:
    """Turn exceptions that a third-party part raised, or that its return values have caused, into `PartError`.

    If all parts are our own, exceptions pass unchanged. `place` is the present operation, for the message.
    """
    theirs = [type(part) for part in parts if type(part).__module__.partition(".")[0] not in _OURS]
    try:
        yield
    except AnswerError as error:
        raise SlamError(f"{place}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever a third-party class does
        *_, (last, _) = walk_tb(error.__traceback__)
        by_part = last.f_globals.get("__name__") in [part.__module__ for part in theirs]
        if not theirs or isinstance(error, SlamError) or (isinstance(error, SystemExit) and not by_part):
            raise  # a signal's handler may end the program anywhere
        raise PartError(f"{place}: {' or '.join(t.__name__ for t in theirs)} failed: {cause(error)}") from error
