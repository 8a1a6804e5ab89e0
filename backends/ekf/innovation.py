"""What an update measures, linearised: ``z = h(x)`` and H (paper A, Eqs. 5-7; B, Eqs. 1-5), ν and ``S = H P Hᵀ + R``.

The unobservable errors are displacements of the world: errors x of the camera's pose by which a landmark's coordinates
change by ``N x``, so that ``U = [1; N]`` spans them (`backends.ekf.camera.gauge_by_error`). A measurement depends on
where the landmark is relative to the camera alone: an error x of the pose alone changes that as ``−N x`` would, and
``H = H_landmark [−N, 1]`` has columns for pose and landmark, with ``H U = 0``. A component that is not measured keeps
its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrf, dpotrs

from backends.ekf.camera import Camera, gauge_by_error, transport
from backends.ekf.covariance import CAMERA, HEAD, POSE, Covariance, reordered
from backends.ekf.landmarks import Coordinates, FilterLandmarks
from slam.data import BoolArray, IndexArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array
from slam.window.gating import squared_distances
from slam.window.solver import upper_inverse
from slam.window.stereo import RectifiedMeasurement


@dataclass(frozen=True, eq=False)
class Update:
    """One update: the prior, and what was measured."""

    camera: Camera
    covariance: Covariance
    landmarks: FilterLandmarks  # those that were measured (M,); all are in the state
    rows: IndexArray  # their rows (M,) in the table of all
    z: Array  # measurements (M, 3) [px], NaN where a component is not measured
    measure: RectifiedMeasurement  # what they measure, and their noise
    coordinates: Coordinates
    iterations: int  # most linearisations
    limits: Array  # of the gate (M,), on squared distances

    @property
    def sigma(self) -> float:
        """Pixel noise [px]."""
        return self.measure.models.pixel_sigma

    def regular_towards(self, T: Array) -> Update:
        """The same prior in coordinates that are regular from a pose T (4, 4) to here; itself where they are."""
        camera, J = self.camera.regular_towards(T)
        if camera is self.camera:
            return self
        return changed(self, camera=camera, covariance=self.covariance.camera_moved(J))

    @cached_property
    def indices(self) -> IndexArray:
        """Indices of the pose and of the measured landmarks (6 + 3M,) in the covariance."""
        return np.append(np.arange(POSE), self.covariance.indices(self.rows))

    @cached_property
    def N(self) -> Array:
        """That (M, 3, 6) of the prior; see the module."""
        return self.landmarks.gauge @ gauge_by_error(self.camera)

    @cached_property
    def gauge_projection(self) -> Array | None:
        """``G = (Uᵀ P⁻¹ U)⁻¹ Uᵀ P⁻¹`` (6, 6 + 3M): the displacement of the world that is part of an error x.

        What ``U G x`` leaves of x is independent of it. None where P has lost its digits.
        """
        root, info = dpotrf(self.covariance.P[self.indices[:, None], self.indices], lower=1)
        U = np.concatenate([np.eye(POSE), self.N.reshape(-1, POSE)])
        Z = dpotrs(root, U, lower=1)[0] if info == 0 else np.full(U.shape, np.nan)
        return np.linalg.solve(U.T @ Z, Z.T) if np.isfinite(Z).all() else None

    def pixels_from(self, camera: Camera, change: Array) -> Array:
        """What a camera would measure (M, 3) [px] of landmarks if the state changes (n,); NaN behind it."""
        marks, asked = self.landmarks, change[self.indices[POSE:]].reshape(-1, 3)
        points = self.coordinates.points(marks.anchors, self.coordinates.plus(marks.c, asked))
        return self.measure.stereo.project((points - camera.pose[:3, 3]) @ camera.pose[:3, :3])[0]

    def linearised(self, camera: Camera, moved: Array | None = None) -> Linearisation:
        """Linearised at a camera and a change (3N,) of the state's landmarks, by default none.

        A landmark is at ``h = Rᵀ (Y − r)`` (paper B, Eqs. 3-5).
        """
        marks, J, change = self.landmarks, transport(self.camera, camera), np.zeros(len(self.covariance.P))
        change[:CAMERA] = np.linalg.solve(J, camera.minus(self.camera))
        if moved is not None:
            change[HEAD:] = moved
            asked = change[self.indices[POSE:]].reshape(-1, 3)
            marks = marks.moved(self.coordinates, slice(None), asked)
            change[self.indices[POSE:]] = (marks.c - self.landmarks.c).reshape(-1)  # a coordinate may be at its limit
        R, r = camera.pose[:3, :3], camera.pose[:3, 3]
        h, by_point = self.measure.stereo.project((marks.points - r) @ R)
        valid = np.isfinite(self.z) & np.isfinite(h).all(axis=1, keepdims=True)
        H = by_point @ (R.T @ self.coordinates.jacobian(marks.anchors, marks.c))
        # an error that is transported displaces the world by the same, wherever the camera is
        N = marks.gauge @ gauge_by_error(self.camera if camera.transports else camera)
        return Linearisation(self, camera, J, change, h, valid, np.where(valid[:, :, None], H, 0.0), N)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """An update's measurements, linearised somewhere.

    If the camera transports its error, P and U are those of the prior. Where landmarks have moved since, their N is
    another: ``H U = B`` is not zero, and the update would measure the gauge, of which no pixel tells. As in the
    observability constraint of Huang, Mourikis and Roumeliotis (IJRR 29(5), 2010) H is replaced by ``H − B G``, with
    ``G U = 1`` (`Update.gauge_projection`): theirs is the nearest to H in numbers, this in units of the prior's
    deviations. Where rounding leaves no G, H has the prior's N.
    """

    update: Update
    camera: Camera
    J: Array  # (12, 12): an error of the prior's camera is J times that, as an error of this one
    change: Array  # of the state (n,) from the prior to here, in the prior's coordinates; none of the last poses
    h: Array  # predicted measurements h(x) (M, 3) [px] here, NaN behind a camera
    valid: BoolArray  # components (M, 3) that are measured and predicted
    H_landmark: Array  # derivatives (M, 3, 3) of h by each landmark's coordinates, zero where not valid
    N: Array  # (M, 3, 6), see the module

    @cached_property
    def _constrained(self) -> tuple[Array, Array, Array | None]:
        """H by the pose (3M, 6), and B (3M, 6) and G (6, 6 + 3M) of the constraint; no G where B is zero."""
        update, N, G = self.update, self.N, None
        B = (self.H_landmark @ (update.N - N)).reshape(-1, POSE)
        if update.camera.transports and B.any():
            G = update.gauge_projection
            if G is None:
                N = update.N
        return -(self.H_landmark @ N).reshape(-1, POSE), B, G

    def H_times(self, X: Array) -> Array:
        """``H X`` (3M, ·) of a matrix X (6 + 3M, ·) with rows for the pose and the measured landmarks."""
        by_pose, B, G = self._constrained
        out = by_pose @ X[:POSE]
        out += (self.H_landmark @ X[POSE:].reshape(len(self.H_landmark), 3, -1)).reshape(out.shape)
        return np.asarray(out if G is None else out - B @ (G @ X))

    @cached_property
    def nu(self) -> Array:
        """Innovation (3M,) of the prior's mean: ``ν = z − h(x) + H x`` with the change x from the prior to here."""
        residuals = np.where(self.valid, self.update.z - self.h, 0.0).reshape(-1)
        return np.asarray(residuals + self.H_times(self.change[self.update.indices, None])[:, 0])

    @cached_property
    def HP(self) -> Array:
        """``H P`` (3M, n), with everything."""
        return self.H_times(self.update.covariance.P[self.update.indices])

    @cached_property
    def S(self) -> Array:
        """``S = H P Hᵀ + R`` (3M, 3M)."""
        S = self.H_times(self.HP[:, self.update.indices].T)
        S[np.diag_indices(len(S))] += self.update.sigma**2
        return S

    @cached_property
    def distances(self) -> Array:
        """Squared distances (M,) of the innovations, of each landmark by itself; NaN where none is predicted.

        Raises LinAlgError where S is not positive definite.
        """
        blocks = np.einsum("iaib->iab", self.S.reshape(len(self.h), 3, -1, 3))
        found = squared_distances(self.nu.reshape(-1, 3), blocks)
        if not np.isfinite(found).all():
            raise np.linalg.LinAlgError("the predicted innovations are not finite or not positive definite")
        return np.where(np.isfinite(self.h).all(axis=1), found, np.nan)

    def solved(self, used: BoolArray) -> Correction:
        """The correction by some landmarks (mask (M,)). Raises LinAlgError if S is not positive definite."""
        taken = np.flatnonzero(np.repeat(used, 3))
        # of the transpose, which is in the order that LAPACK wants
        upper, info = dpotrf(reordered(self.S, taken).T, overwrite_a=1)
        if info != 0:
            raise np.linalg.LinAlgError("the innovation covariance is not positive definite")
        return Correction(self, used, taken, upper_inverse(upper).T)


@dataclass(frozen=True, eq=False)
class Correction:
    """What K of the landmarks correct, with ``S_aa = L Lᵀ`` of their components a of z.

    The others, b, may be off by anything: nothing but their distances depends on them.
    """

    at: Linearisation
    used: BoolArray  # which landmarks (M,)
    taken: IndexArray  # a (3K,)
    L_inverse: Array  # L⁻¹ (3K, 3K), lower triangular
    linear: bool = True  # whether the measurements are so at the solution; not looked at where one linearisation is all

    def whitened(self, X: Array) -> Array:
        """``L⁻¹ X_a`` (3K, ...) of X (3M, ...)."""
        return np.asarray(self.L_inverse @ X[self.taken])

    @cached_property
    def y(self) -> Array:
        """``S⁻¹ ν`` (3M,) of what is used alone; zero for the others."""
        y = np.zeros(len(self.at.nu))
        y[self.taken] = self.whitened(self.at.nu) @ self.L_inverse
        return y

    @property
    def nis(self) -> float:
        """``νᵀ S⁻¹ ν``."""
        return float(self.at.nu @ self.y)

    @cached_property
    def change(self) -> Array:
        """Of the state (n,) from the prior, in its coordinates: ``K ν = P Hᵀ y``; the last poses do not count."""
        return np.asarray(self.y @ self.at.HP)

    @cached_property
    def camera(self) -> Camera:
        """After the update."""
        return self.at.camera.plus(self.at.J @ (self.change - self.at.change)[:CAMERA])

    @cached_property
    def whitened_pose(self) -> Array:
        """``L⁻¹ (H P)_a`` of the pose (3K, 6)."""
        return self.whitened(self.at.HP[:, :POSE])

    @cached_property
    def pose_covariance(self) -> Array:
        """Of the error [r, φ] (6, 6) after the update, in the prior's coordinates."""
        return np.asarray(self.at.update.covariance.pose - self.whitened_pose.T @ self.whitened_pose)

    def reduction(self) -> tuple[Array, Array]:
        """By which the covariance falls: V (n, 3K) with ``V Vᵀ = K S Kᵀ``; and ``K (H x − F)`` (n, m) for the rig.

        By that fall the derivatives x of the errors by those of the rig, whose field is F.
        """
        at, update = self.at, self.at.update
        V = dtrmm(1.0, self.L_inverse.T, at.HP[self.taken].T, side=1, overwrite_b=1)
        by_rig = at.H_times(update.covariance.by_rig[update.indices])
        by_rig -= np.where(at.valid[:, :, None], update.measure.field(update.z), 0.0).reshape(by_rig.shape)
        return V, V @ self.whitened(by_rig)

    @cached_property
    def conditional_distances(self) -> Array:
        """Squared distance (M,) of each landmark's measurement from what all others that are used predict.

        With ``y_j`` and ``Q_j = (S⁻¹)_jj`` in the rows j of a landmark that is used, its innovation is off by
        ``Q_j⁻¹ y_j``, with covariance ``Q_j⁻¹``: the distance is ``y_jᵀ Q_j⁻¹ y_j``. Those that are not used are off by
        ``ν_b − S_ba S_aa⁻¹ ν_a``, with covariance ``S_bb − S_ba S_aa⁻¹ S_ab``. One that is not valid has distance 0.
        """
        used, at, columns = self.used, self.at, self.L_inverse.reshape(len(self.taken), len(self.taken) // 3, 3)
        off, blocks, others = self.y.reshape(-1, 3).copy(), np.empty((len(used), 3, 3)), np.repeat(~used, 3)
        blocks[used] = columns.transpose(1, 2, 0) @ columns.transpose(1, 0, 2)
        if others.any():
            W = self.whitened(at.S[:, others])
            off[~used] = (at.nu[others] - self.whitened(at.nu) @ W).reshape(-1, 3)
            conditional = at.S[others][:, others] - W.T @ W
            blocks[~used] = np.einsum("iaib->iab", conditional.reshape(len(W.T) // 3, 3, -1, 3))
        found = squared_distances(off, blocks)
        if not np.isfinite(found).all():
            raise np.linalg.LinAlgError("the innovation covariance is not positive definite")
        return found
