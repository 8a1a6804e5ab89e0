"""What an update measures, linearised: ``z = h(x)`` and H (paper A, Eqs. 5-10; B, Eqs. 1-5), ν and ``S = H P Hᵀ + R``.

A landmark's measurement depends on where it is as seen from the camera alone. An error x of the camera's pose moves it
there by ``−lever x`` in its own coordinates, so that ``H = own [−lever, 1]`` has columns for the pose and the
landmark: a displacement of both together is no row's business, wherever H is taken. A component that is not measured,
or gated, keeps its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri

from backends.ekf.camera import Camera
from backends.ekf.covariance import CAMERA, POSE, Covariance, numbers_of
from backends.ekf.landmarks import Coordinates, FilterLandmarks
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array
from slam.window.gating import squared_distances
from slam.window.stereo import RectifiedMeasurement

_SMALL = 48  # cost: rows of a triangular matrix that is inverted as a whole


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
    guess: Array | None = None  # a pose (4, 4) worth trying where the prior is far off

    @property
    def sigma(self) -> float:
        """Pixel noise [px]."""
        return self.measure.models.pixel_sigma

    def wider(self, noise: Array) -> Update:
        """With more noise (12, 12) of the camera."""
        return replace(self, covariance=self.covariance.camera_moved(np.eye(CAMERA), noise))

    def facing(self, T: Array) -> Update:
        """With a guess T (4, 4), and the same prior in coordinates that are regular from there to here."""
        camera, J = self.camera.facing(T)
        P = self.covariance if camera is self.camera else self.covariance.camera_moved(J, np.zeros((CAMERA, CAMERA)))
        return replace(self, camera=camera, covariance=P, guess=T)

    @cached_property
    def numbers(self) -> IndexArray:
        """Where the coordinates (3M,) of the measured landmarks stand among those of the state's."""
        return numbers_of(self.rows - self.covariance.parked)

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
        P, h, each = self.covariance, len(self.covariance.head), 3 * self.covariance.parked + self.numbers
        across = P.head[:POSE, h + each]
        joint = np.block([[P.pose, across], [across.T, P.marks[each[:, None], each]]])
        N, (root, info) = np.concatenate([np.eye(POSE), self.lever.reshape(-1, POSE)]), dpotrf(joint, lower=1)
        Z = dpotrs(root, N, lower=1)[0] if info == 0 else np.full(N.shape, np.nan)
        return np.linalg.solve(N.T @ Z, Z.T) if np.isfinite(Z).all() else None

    def among_measured(self, change: Array) -> Array:
        """The part (6 + 3M,) of a change of the state (n,) that the measurements depend on."""
        return np.concatenate([change[:POSE], change[CAMERA + self.numbers]])

    def at(self, camera: Camera | None = None, moved: Array | None = None, from_prior: float = 0.0) -> Linearisation:
        """Linearised at a camera, by default the prior's, and a change (3A,) of the state's landmarks, by default none.

        A landmark is at ``h = Rᵀ (Y − r)`` (paper B, Eqs. 3-5).
        """
        there, marks = camera or self.camera, self.landmarks
        J = np.eye(CAMERA) if camera is None else self.camera.transport(camera)
        change = np.zeros(CAMERA + len(self.covariance.marks) - 3 * self.covariance.parked)
        if camera is not None:
            change[:CAMERA] = np.linalg.solve(J, there.minus(self.camera))
        if moved is not None:
            marks = marks.moved(self.coordinates, slice(None), moved[self.numbers].reshape(-1, 3))
            change[CAMERA:] = moved
            change[CAMERA + self.numbers] = (marks.c - self.landmarks.c).reshape(-1)  # a coordinate may be at its limit
        R, r = there.pose[:3, :3], there.pose[:3, 3]
        z, by_point = self.measure.stereo.project((marks.points - r) @ R)
        own = by_point @ (R.T @ self.coordinates.jacobian(marks.anchors, marks.c))
        lever = self.lever if camera is None is moved else marks.gauge @ (there.world() @ J[:POSE, :POSE])
        return Linearisation(self, there, J, change, z, own, lever, from_prior)

    def at_guess(self) -> Linearisation:
        """The guess, with the landmarks where they are believed: its distance from the prior is that of the pose."""
        assert self.guess is not None
        there, distance = self.at(self.camera.at(self.guess)), math.inf
        with suppress(np.linalg.LinAlgError):  # a pose that is known exactly cannot be moved
            distance = float(there.change[:POSE] @ np.linalg.solve(self.covariance.pose, there.change[:POSE]))
        return replace(there, from_prior=distance)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """An update's measurements, linearised somewhere."""

    update: Update
    camera: Camera
    J: Array  # (12, 12): an error of the prior's camera is J times that, as an error of this one
    change: Array  # of the state (n,) from the prior to here, in the prior's coordinates
    z: Array  # what is predicted here (M, 3) [px], NaN behind a camera
    own: Array  # its derivatives (M, 3, 3) by the coordinates
    lever: Array  # (M, 3, 6), see the module
    from_prior: float  # squared distance from the prior

    def cost(self, components: BoolArray) -> float:
        """Squared distance from the prior and some components (M, 3) of the measurements; ∞ where one is not seen."""
        residual = np.where(components, self.update.z - self.z, 0.0)
        cost = self.from_prior + float(np.vdot(residual, residual)) / self.update.sigma**2
        return cost if math.isfinite(cost) else math.inf

    def camera_after(self, change: Array) -> Camera:
        """The camera after a change of the state (n,) from the prior."""
        return self.camera.moved(self.J @ (change - self.change)[:CAMERA])

    def seen(self) -> BoolArray:
        """Components (M, 3) that are measured, of landmarks before both cameras."""
        return np.asarray(np.isfinite(self.update.z) & np.isfinite(self.z).all(axis=1, keepdims=True))

    def innovation(self, components: BoolArray) -> Innovation:
        """ν and S of some components (M, 3).

        If the camera transports its error, the prior has a displacement of the world as N, its derivative at the prior.
        Elsewhere that is not quite one: ``H N = B`` is not zero, and the update would measure it. H is therefore taken
        of what else there is of an error, ``H − B A`` with A N = 1; or, where there is no A, with the prior's lever.
        """
        update, P = self.update, self.update.covariance
        numbers, b, h = 3 * P.parked + update.numbers, 3 * P.parked, len(P.head)
        own = self.own if components.all() else np.where(components[:, :, None], self.own, 0.0)
        B, A, lever = (own @ (update.lever - self.lever)).reshape(-1, POSE), None, self.lever
        if update.camera.transports and B.any():
            A, lever = update.place, self.lever if update.place is not None else update.lever
        H = Jacobian(own, -(own @ lever).reshape(-1, POSE), B, A)
        nu = np.where(components, update.z - self.z, 0.0).reshape(-1)
        nu += H.times(self.change[:POSE, None], self.change[CAMERA + update.numbers, None])[:, 0]
        with_camera = H.times(P.camera[:POSE], P.head[:CAMERA, h + numbers].T)
        with_marks = H.times(P.head[:POSE, h + b :], P.marks[:, b:][numbers])
        S = H.times(with_camera[:, :POSE].T, with_marks[:, update.numbers].T)
        S[np.diag_indices(len(S))] += update.sigma**2
        return Innovation(self, components, H, (with_camera, with_marks), nu, S)


@dataclass(frozen=True, eq=False)
class Jacobian:
    """H (3M, 6 + 3M), by the errors of pose and measured landmarks."""

    own: Array  # derivatives (M, 3, 3) of each landmark's measurement by its own coordinates
    by_pose: Array  # and (3M, 6) by the pose's error
    B: Array  # (3M, 6), see `Linearisation.innovation`
    A: Array | None  # (6, 6 + 3M)

    def times(self, of_pose: Array, of_marks: Array) -> Array:
        """H (3M, ·) of a matrix with the rows (6, k) of the pose and (3M, k) of the measured landmarks."""
        out = self.by_pose @ of_pose
        out += (self.own @ of_marks.reshape(len(self.own), 3, -1)).reshape(out.shape)
        if self.A is not None:
            out -= self.B @ (self.A[:, :POSE] @ of_pose + self.A[:, POSE:] @ of_marks)
        return np.asarray(out)


@dataclass(frozen=True, eq=False)
class Innovation:
    """ν and its covariance S (paper A, Eq. 11)."""

    at: Linearisation
    components: BoolArray  # which of the measurements' (M, 3)
    H: Jacobian
    HP: tuple[Array, Array]  # H P: with the camera (3M, 12), and with the landmarks of the state (3M, 3A)
    nu: Array  # innovation of the prior's mean (3M,)
    S: Array  # its covariance (3M, 3M)

    def whitened(self, used: BoolArray) -> Whitened:
        """That of some landmarks (mask (M,)), whitened; UnsolvableError where S is not positive definite."""
        nu, S, out = self.nu, self.S, np.flatnonzero(np.repeat(~used, 3))
        if len(out):
            nu, S = nu.copy(), S.copy()
            nu[out], S[out], S[:, out], S[out, out] = 0.0, 0.0, 0.0, 1.0
        upper, info = dpotrf(S.T)  # of the transpose, which is in the order that LAPACK wants
        if info != 0:
            raise UnsolvableError("the innovation covariance is not positive definite")
        inverse = _inverse(upper).T
        inverse[out, out] = 0.0
        return Whitened(self, used, nu, inverse)


@dataclass(frozen=True, eq=False)
class Whitened:
    """The innovation of some landmarks whitened by ``S = L Lᵀ``: ``w = L⁻¹ ν`` has covariance 1."""

    innovation: Innovation
    used: BoolArray  # which landmarks (M,)
    nu: Array  # (3M,), zero for the others
    inverse: Array  # L⁻¹ (3M, 3M), lower triangular, with zero rows for the others

    @cached_property
    def w(self) -> Array:
        """The whitened innovation (3M,); its square is the NIS ``νᵀ S⁻¹ ν``."""
        return np.asarray(self.inverse @ self.nu)

    @cached_property
    def y(self) -> Array:
        """``S⁻¹ ν`` (3M,)."""
        return np.asarray(self.w @ self.inverse)

    @cached_property
    def by_pose(self) -> Array:
        """The whitened innovation's covariance (3M, 6) with the pose."""
        return np.asarray(self.inverse @ self.innovation.HP[0][:, :POSE])

    def gain_root(self) -> tuple[tuple[Array, Array, Array], Array]:
        """``P Hᵀ L⁻ᵀ``, and L⁻¹ times derivatives of ν by errors of the rig; see `Covariance.corrected`."""
        nu, (with_camera, with_marks), update = self.innovation, self.innovation.HP, self.innovation.at.update
        P = update.covariance
        h, b, numbers = len(P.head), 3 * P.parked, 3 * P.parked + update.numbers
        poses_and_left = np.concatenate([P.head[CAMERA:, h + numbers].T, P.marks[:, :b][numbers]], axis=1)
        rest = nu.H.times(P.head[:POSE, CAMERA : h + b], poses_and_left)
        V = dtrmm(1.0, self.inverse.T, np.concatenate([with_camera, rest], axis=1).T, side=1)
        by_rig = nu.H.times(P.by_rig[:POSE], P.by_rig[h + numbers])
        by_rig -= np.where(nu.components[:, :, None], update.measure.field(update.z), 0.0).reshape(by_rig.shape)
        return (V[:h], V[h:], dtrmm(1.0, self.inverse.T, with_marks.T, side=1)), self.inverse @ by_rig

    def distances(self) -> Array:
        """Squared distance (M,) of each landmark's measurement from what all others predict; 0 for one without any.

        For the rows j of a landmark, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``: given the others, its innovation is off
        by ``Q_j⁻¹ y_j`` with covariance ``Q_j⁻¹``, so that the distance is ``y_jᵀ Q_j⁻¹ y_j``.
        """
        columns = np.ascontiguousarray(self.inverse.reshape(-1, len(self.used), 3).transpose(1, 2, 0)[self.used])
        found = np.zeros(len(self.used))
        found[self.used] = squared_distances(self.y.reshape(-1, 3)[self.used], columns @ columns.transpose(0, 2, 1))
        if not np.isfinite(found).all():
            raise UnsolvableError("the innovation covariance is not positive definite")
        return found


def _inverse(U: Array) -> Array:
    """``U⁻¹`` of an upper triangular U (N, N), by halves: LAPACK's own takes twice as long for many rows."""
    half = len(U) // 2
    if half < _SMALL:
        return np.asarray(dtrtri(U)[0])
    first, last = _inverse(U[:half, :half]), _inverse(U[half:, half:])
    out = np.zeros(U.shape, order="F")
    out[:half, :half], out[half:, half:] = first, last
    out[:half, half:] = dtrmm(-1.0, first, dtrmm(1.0, last, U[:half, half:], side=1))
    return out
