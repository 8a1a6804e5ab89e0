"""What an update measures, linearised: ``z = h(x)`` and H (paper A, Eqs. 5-10; B, Eqs. 1-5), ν and ``S = H P Hᵀ + R``.

A landmark's measurement depends on where it is as seen from the camera alone. An error x of the camera's pose moves it
there by ``−lever x`` in its own coordinates, so that ``H = own [−lever, 1]`` has columns for the pose and the
landmark: a displacement of both together is no row's business, wherever H is taken. A component that is not measured
keeps its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrf, dpotrs

from backends.ekf.camera import Camera
from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.landmarks import Coordinates, FilterLandmarks
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array
from slam.window.gating import squared_distances
from slam.window.solver import upper_inverse
from slam.window.stereo import RectifiedMeasurement


class UnsolvableError(ArithmeticError):
    """The update has no usable solution; the message says why. It never leaves the back end."""


@dataclass(frozen=True, eq=False)
class Update:
    """One update: the prior, and what was measured."""

    camera: Camera
    covariance: Covariance
    landmarks: FilterLandmarks  # those that were measured (M,); all are in the state
    rows: IndexArray  # their rows (M,) in the table of all
    z: Array  # measurements (M, 3) [px], NaN where a component is not measured
    measure: RectifiedMeasurement  # what they measure, their noise, and the gate
    coordinates: Coordinates
    iterations: int  # most linearisations
    guess: Array | None = None  # a pose (4, 4) to linearise at where it is not linear from the prior on

    @property
    def sigma(self) -> float:
        """Pixel noise [px]."""
        return self.measure.models.pixel_sigma

    def facing(self, T: Array) -> Update:
        """With a guess T (4, 4), and the same prior in coordinates that are regular from there to here."""
        camera, J = self.camera.facing(T)
        P = self.covariance if camera is self.camera else self.covariance.camera_moved(J, np.zeros((CAMERA, CAMERA)))
        return replace(self, camera=camera, covariance=P, guess=T)

    @cached_property
    def numbers(self) -> IndexArray:
        """Where the coordinates (3M,) of the measured landmarks stand in the covariance."""
        return self.covariance.numbers(self.rows).ravel()

    @cached_property
    def measured(self) -> IndexArray:
        """And in a change of the state (12 + 3A,), camera and landmarks, with the pose before them (6 + 3M,)."""
        return np.append(np.arange(POSE), self.numbers - self.covariance.begin + CAMERA)

    @cached_property
    def lever(self) -> Array:
        """That (M, 3, 6) of the prior, see the module."""
        return self.landmarks.gauge @ self.camera.world()

    @cached_property
    def place(self) -> Array | None:
        """The part A (6, 6 + 3M) of an error of pose and measured landmarks that displaces both in the world.

        A displacement N is an error of the pose with the landmarks along by the lever. What is left of an error is to
        be independent of that part: ``A = (Nᵀ P⁻¹ N)⁻¹ Nᵀ P⁻¹``. None where P has lost its digits.
        """
        numbers = np.append(np.arange(POSE), self.numbers)
        root, info = dpotrf(self.covariance.P[numbers[:, None], numbers], lower=1)
        N = np.concatenate([np.eye(POSE), self.lever.reshape(-1, POSE)])
        Z = dpotrs(root, N, lower=1)[0] if info == 0 else np.full(N.shape, np.nan)
        return np.linalg.solve(N.T @ Z, Z.T) if np.isfinite(Z).all() else None

    def predicted(self, camera: Camera, change: Array) -> Array:
        """What a camera would measure (M, 3) [px] of landmarks after a change of the state (n,); NaN behind it."""
        marks, asked = self.landmarks, change[self.measured[POSE:]].reshape(-1, 3)
        points = self.coordinates.points(marks.anchors, self.coordinates.moved(marks.c, asked))
        return self.measure.stereo.project((points - camera.pose[:3, 3]) @ camera.pose[:3, :3])[0]

    def at(self, camera: Camera | None = None, moved: Array | None = None) -> Linearisation:
        """Linearised at a camera and a change (3A,) of the state's landmarks, by default those of the prior.

        A landmark is at ``h = Rᵀ (Y − r)`` (paper B, Eqs. 3-5).
        """
        there, marks = camera or self.camera, self.landmarks
        J = np.eye(CAMERA) if camera is None else self.camera.transport(camera)
        change = np.zeros(CAMERA + len(self.covariance.P) - self.covariance.begin)
        if camera is not None:
            change[:CAMERA] = np.linalg.solve(J, there.minus(self.camera))
        if moved is not None:
            change[CAMERA:] = moved
            asked = change[self.measured[POSE:]].reshape(-1, 3)
            marks = marks.moved(self.coordinates, slice(None), asked)
            change[self.measured[POSE:]] = (marks.c - self.landmarks.c).reshape(-1)  # a coordinate may be at its limit
        R, r = there.pose[:3, :3], there.pose[:3, 3]
        z, by_point = self.measure.stereo.project((marks.points - r) @ R)
        seen = np.isfinite(self.z) & np.isfinite(z).all(axis=1, keepdims=True)
        own = by_point @ (R.T @ self.coordinates.jacobian(marks.anchors, marks.c))
        own = np.where(seen[:, :, None], own, 0.0)
        lever = self.lever if camera is None is moved else marks.gauge @ (there.world() @ J[:POSE, :POSE])
        return Linearisation(self, there, J, change, z, seen, own, lever)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """An update's measurements, linearised somewhere.

    If the camera transports its error, the prior has a displacement of the world as N, its derivative at the prior.
    Elsewhere that is not quite one: ``H N = B`` is not zero, and the update would measure it. H is therefore taken of
    what else there is of an error, ``H − B A`` with A N = 1; or, where there is no A, with the prior's lever.
    """

    update: Update
    camera: Camera
    J: Array  # (12, 12): an error of the prior's camera is J times that, as an error of this one
    change: Array  # of the state (n,) from the prior to here, in the prior's coordinates
    z: Array  # what is predicted here (M, 3) [px], NaN behind a camera
    seen: BoolArray  # components (M, 3) that are measured, of landmarks before both cameras
    own: Array  # derivatives (M, 3, 3) of what is predicted by each landmark's coordinates, zero for others
    lever: Array  # (M, 3, 6), see the module

    def camera_after(self, change: Array) -> Camera:
        """The camera after a change of the state (n,) from the prior."""
        return self.camera.moved(self.J @ (change - self.change)[:CAMERA])

    @cached_property
    def _along_the_world(self) -> tuple[Array, Array, Array | None]:
        """H by the pose's error (3M, 6), and B (3M, 6) and A (6, 6 + 3M)."""
        update, lever, A = self.update, self.lever, None
        B = (self.own @ (update.lever - lever)).reshape(-1, POSE)
        if update.camera.transports and B.any():
            A, lever = update.place, lever if update.place is not None else update.lever
        return -(self.own @ lever).reshape(-1, POSE), B, A

    def times(self, X: Array) -> Array:
        """H (3M, ·) of a matrix X (6 + 3M, ·), whose rows are of the errors of pose and measured landmarks."""
        by_pose, B, A = self._along_the_world
        out = by_pose @ X[:POSE]
        out += (self.own @ X[POSE:].reshape(len(self.own), 3, -1)).reshape(out.shape)
        return np.asarray(out if A is None else out - B @ (A @ X))

    def innovation(self) -> Innovation:
        """ν and S of what is measured."""
        update, P = self.update, self.update.covariance.P
        nu = np.where(self.seen, update.z - self.z, 0.0).reshape(-1)
        nu += self.times(self.change[update.measured, None])[:, 0]
        numbers = np.append(np.arange(POSE), update.numbers)
        HP = self.times(P[numbers])
        S = self.times(HP[:, numbers].T)
        S[np.diag_indices(len(S))] += update.sigma**2
        return Innovation(self, HP, nu, S)


@dataclass(frozen=True, eq=False)
class Innovation:
    """ν and its covariance S (paper A, Eq. 11)."""

    at: Linearisation
    HP: Array  # H P (3M, n), with everything
    nu: Array  # innovation of the prior's mean (3M,)
    S: Array  # its covariance (3M, 3M)

    def whitened(self, used: BoolArray) -> Whitened:
        """That of some landmarks (mask (M,)), whitened. Raises UnsolvableError if S is not positive definite."""
        rows = np.flatnonzero(np.repeat(used, 3))
        upper, info = dpotrf(self.S[rows[:, None], rows].T)  # of the transpose, which is in the order that LAPACK wants
        if info != 0:
            raise UnsolvableError("the innovation covariance is not positive definite")
        return Whitened(self, used, rows, upper_inverse(upper).T)


@dataclass(frozen=True, eq=False)
class Whitened:
    """The innovation of K landmarks whitened: ``w = L⁻¹ ν``, with ``S = L Lᵀ`` of these alone."""

    innovation: Innovation
    used: BoolArray  # which landmarks (M,)
    rows: IndexArray  # their rows (3K,) of the innovation
    inverse: Array  # L⁻¹ (3K, 3K), lower triangular

    @cached_property
    def w(self) -> Array:
        """The whitened innovation (3K,); its square is the NIS ``νᵀ S⁻¹ ν``."""
        return np.asarray(self.inverse @ self.innovation.nu[self.rows])

    @cached_property
    def y(self) -> Array:
        """``S⁻¹ ν`` (3K,)."""
        return np.asarray(self.w @ self.inverse)

    @cached_property
    def by_pose(self) -> Array:
        """The whitened innovation's covariance (3K, 6) with the pose."""
        return np.asarray(self.inverse @ self.innovation.HP[self.rows, :POSE])

    def gain_root(self) -> tuple[Array, Array]:
        """V (n, 3K) with ``V Vᵀ = K S Kᵀ``, and L⁻¹ times derivatives (3K, m) of ν by errors of the rig."""
        at, update = self.innovation.at, self.innovation.at.update
        V = dtrmm(1.0, self.inverse.T, self.innovation.HP[self.rows].T, side=1, overwrite_b=1)
        by_rig = at.times(update.covariance.by_rig[np.append(np.arange(POSE), update.numbers)])
        by_rig -= np.where(at.seen[:, :, None], update.measure.field(update.z), 0.0).reshape(by_rig.shape)
        return V, self.inverse @ by_rig[self.rows]

    def distances(self) -> Array:
        """Squared distance (M,) of each landmark's measurement from what all others predict; 0 for one without any.

        For the rows j of a landmark, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``: given the others, its innovation is off
        by ``Q_j⁻¹ y_j`` with covariance ``Q_j⁻¹``, so that the distance is ``y_jᵀ Q_j⁻¹ y_j``.
        """
        columns = self.inverse.reshape(len(self.inverse), len(self.inverse) // 3, 3).transpose(1, 2, 0)
        Q = columns @ columns.transpose(0, 2, 1)
        found = np.zeros(len(self.used))
        found[self.used] = squared_distances(self.y.reshape(-1, 3), Q)
        if not np.isfinite(found).all():
            raise UnsolvableError("the innovation covariance is not positive definite")
        return found
