"""The rig's uncertainty in poses and landmarks: consider parameters (Schmidt, 1966), followed by the back end.

With δ the error of the applied correction and ``Σ`` its covariance, poses and landmarks are ``T_true = T exp(J δ)``,
``y_true = y + L δ``, and their covariances grow by ``J Σ Jᵀ`` and ``L Σ Lᵀ``. The back end knows J and L
(`slam.interfaces.ConsideringBackend`); what is known of δ is the self-calibration's.

Measurements of a path have been corrected by different corrections c_k. With θ the true parameters, the error that
they leave is ``Σ_k G_k F_k (θ − c_k) = J θ − Σ_k G_k F_k c_k``, with gains G_k and fields F_k. So δ is what is followed
of θ and of the baseline's length, and 1, whose column has the field ``−F_k c_k``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from slam.calibration.estimator import SelfCalibration
from slam.calibration.model import Revision
from slam.data import CommonError, Estimate
from slam.geometry.arrays import Array
from slam.geometry.se3 import adjoint
from slam.interfaces import Backend, ConsideringBackend, RevisingBackend

#: Change of the correction, in standard deviations of the disparities' error, for a back end to revise its past.
_SIGNIFICANT = 0.5

#: Standard deviation of the baseline's length, as a share of it: the squares of a calibration board are known to some
#: tenths of a percent. It scales the whole world, so images never show it.
BASELINE = 0.002


class RemainingRigError:
    """The rig's error that is left in a back end's estimate while self-calibration continues.

    What back ends follow are the errors of the n parameters, that of the baseline's length, and 1.
    """

    def __init__(self, calibration: SelfCalibration) -> None:
        self._calibration, self._measured_with = calibration, calibration.applied  # of what the back end was given
        self._revised = np.zeros(len(calibration.model.names))  # changes of the correction that the whole path followed
        self._turned = np.zeros(6)  # how the world turned as the whole path was revised: a motion, on the left
        self._root: tuple[Array, Array] | None = None  # of the last covariance, which is asked for thrice in a frame

    def follow(self, backend: Backend, pose: Array | None = None) -> None:
        """Let a back end that can follow the errors, before its first frame; `pose` (6, m) is J of its first pose."""
        if self._calibration.config.enabled and isinstance(backend, ConsideringBackend):
            backend.consider(self.field, pose)

    def field(self, z: Array) -> Array:
        """Derivatives (N, 3, n + 2) of true rows (uL, vL, uR) by what is followed, at corrected rows (N, 3) [px]."""
        points = self._calibration.model.points(z)
        field = self._calibration.model.field(points)[:, :3]
        field[:, 2] = field[:, 0] - field[:, 2]
        out = np.zeros((len(z), 3, field.shape[2] + 2))
        out[:, :, :-2], out[:, 2, -2] = (
            field,
            points[:, 2],
        )  # with a longer baseline, the nominal one's disparity is smaller
        out[:, :, -1] = -field @ (self._calibration.applied.parameters - self._revised)
        return out

    def apply(self, backend: Backend) -> Revision | None:
        """Correct features by the present posterior from now on; returns the change, or None.

        For a back end that can revise, a change means processing all its measurements again, so it waits until the
        change is significant.
        """
        return self._calibration.apply(_SIGNIFICANT if isinstance(backend, RevisingBackend) else 0.0)

    def revise(self, backend: Backend, restarted: bool) -> Revision | None:
        """Correct a back end's earlier measurements, if it can revise them; returns the change, or None.

        Where the back end has `restarted`, part of the path is an earlier one's and cannot be revised.
        """
        applied = self._calibration.applied
        if not isinstance(backend, RevisingBackend) or applied is self._measured_with:
            return None
        revision = Revision(self._measured_with, applied)
        whole = not restarted and backend.revises_path
        if whole:
            step = applied.parameters - self._measured_with.parameters
            self._revised = self._revised + step
            if isinstance(backend, ConsideringBackend):
                self._turned = self._turned + _adjoint_of(backend) @ _of_pose(backend)[:, :-2] @ step
        backend.revise(revision.rows)
        self._measured_with = applied
        return revision

    def added_to(self, backend: Backend, estimate: Estimate) -> Estimate:
        """The back end's estimate with the rig's uncertainty added."""
        if not (self._calibration.config.enabled and isinstance(backend, ConsideringBackend)):
            return estimate
        root, (J, L) = self._common_root(self._revised), backend.sensitivities(estimate.ids)
        J, L = J @ root, L @ root
        return replace(
            estimate, covariance=estimate.covariance + J @ J.T,
            covariances=estimate.covariances + L @ np.swapaxes(L, 1, 2),
        )  # fmt: skip

    def common(self, backend: Backend, as_reported: bool) -> CommonError:
        """The part of the pose's error that it shares with those of other frames.

        The covariance that `added_to` adds to the pose is ``J S Sᵀ Jᵀ``. Poses of several frames have the common errors
        ``J₁ S c``, ``J₂ S c``, …, with the same c of unit variance, where S is of the last frame.

        Where a whole path is revised, the newest pose stays and all before it move. Poses as reported keep in this way
        what the earlier correction did to them: as if the world had turned under the path. `as_reported` asks for poses
        as reported in each frame, with the correction of that time; else for the present path, in which a back end may
        have revised earlier poses.
        """
        if not (self._calibration.config.enabled and isinstance(backend, ConsideringBackend)):
            return CommonError()
        J, revised = _of_pose(backend), self._revised
        if as_reported:
            J, revised = J.copy(), 0.0 * revised
            J[:, -1] -= J[:, :-2] @ self._revised
            J[:, -1] += np.linalg.solve(_adjoint_of(backend), self._turned)
        return CommonError(J, self._common_root(revised))

    def _common_root(self, revised: Array) -> Array:
        """Square root (n + 2, n + 2) of the mean square of what is followed, less that of `revised` (n,).

        It is the symmetric root, so that its columns mean the same in all frames.
        """
        covariance = self._calibration.posterior.covariance
        if self._root is None or not np.array_equal(self._root[0], covariance):
            values, vectors = np.linalg.eigh(covariance)
            self._root = covariance, vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
        n = len(covariance)
        root = np.diag(np.append(np.zeros(n), [BASELINE, 1.0]))
        root[:n, :n], root[:n, -1] = self._root[1], self._calibration.applied.parameters - revised
        return root


def _of_pose(backend: ConsideringBackend) -> Array:
    """J (6, n + 2) of the newest pose."""
    return backend.sensitivities(np.zeros(0, np.int64))[0]


def _adjoint_of(backend: Any) -> Array:
    """From motions on the right of the newest pose to those on the left of the world (6, 6)."""
    return adjoint(backend.estimate(landmarks=False).T_world_left)
