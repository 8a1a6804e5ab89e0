"""The measurement update, gated and iterated: what it makes of a prior. The filter's state is not changed here.

In the papers' order: the innovation ν and its covariance ``S = H P Hᵀ + R = L Lᵀ``, the gate, the gain
``K = P Hᵀ S⁻¹``, the corrected state ``x + K ν`` and covariance ``P − K S Kᵀ`` (paper A, Eq. 11). What is kept is
``y = S⁻¹ ν``: the state changes by ``P Hᵀ y``, and ``s = Hᵀ y`` has entries for the pose and measured landmarks alone.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg.blas import dgemm, dtrmm
from scipy.linalg.lapack import dpotrf, dtrtri

from backends.ekf import kernels
from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.landmarks import Coordinates, FilterLandmarks
from backends.ekf.measurement import Jacobian, Measurement
from slam.chi_square import chi_square_limits
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array
from slam.window.stereo import Field, RectifiedStereo, no_field

#: A step is the last where the measurements it predicts linearly are right to this share of their noise. Iterating
#: further than needed does harm: it moves points to where noisy pixels want them, and claims information that is not
#: there (drives at 0.1: four times the NEES of 1.0). A long step, or a fast camera's first, cannot do without.
_LINEAR = 1.0
#: Their errors together may move the pose by this share of its deviations: with a wide prior all have the same sign.
_POSE_SHARE = 0.25
_HALVINGS = 6  # numerics: of a step that does not lower the cost
_SMALL = 48  # cost: rows of a triangular matrix that is inverted as a whole


class UnsolvableError(ArithmeticError):
    """The update has no usable solution; the message says why. It never leaves the back end."""


@dataclass(frozen=True, eq=False)
class Update:
    """One update: the prior, and what was measured."""

    camera: Any  # `backends.ekf.motion.Camera`
    covariance: Covariance
    landmarks: FilterLandmarks  # those that were measured (M,)
    marks: IndexArray  # which of the state these are (M,)
    z: Array  # measurements (M, 3) [px], NaN where a component is not measured
    sigma: float  # pixel noise [px]
    stereo: RectifiedStereo
    coordinates: Coordinates
    iterations: int  # most linearisations
    gate_probability: float  # quantile of χ² beyond which a landmark's measurement is rejected
    guess: Array | None = None  # a pose (4, 4) worth trying where the prior is far off
    field: Field = no_field  # derivatives of measurements by errors of the rig

    def wider(self, noise: Array) -> Update:
        """With more noise (12, 12) of the camera."""
        return replace(self, covariance=self.covariance.camera_moved(np.eye(CAMERA), noise))

    @cached_property
    def numbers(self) -> IndexArray:
        """Where the pose and the measured landmarks stand in the state (6 + 3M,)."""
        landmarks = CAMERA + 3 * self.marks[:, None] + np.arange(3)
        return np.concatenate([np.arange(POSE), landmarks.reshape(-1)])

    @cached_property
    def measurement(self) -> Measurement:
        """What is predicted."""
        return Measurement(self.stereo, self.coordinates, self.landmarks.anchors)

    def at(self, T: Array | None, change: Array | None = None, from_prior: float = 0.0) -> Linearisation:
        """Linearised at a pose (4, 4), or the prior's own, and a change (M, 3) of the landmarks' coordinates."""
        camera, J, mean, c = self.camera, np.eye(CAMERA), np.zeros(CAMERA), self.landmarks.c
        if T is not None:
            camera = camera.at(T)
            J = self.camera.transport(camera)
            mean = np.linalg.solve(J, self.camera.seen_from(camera))
        change = np.zeros_like(c) if change is None else change
        z, own = self.measurement.at(camera.pose, self.coordinates.moved(c, change))
        lever = self.landmarks.gauge @ (camera.world() @ J[:POSE, :POSE])
        return Linearisation(camera, J, mean, change, z, own, lever, from_prior)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Where measurements are linearised."""

    camera: Any
    J: Array  # (12, 12): an error of the prior's camera is J times that, as an error of this one
    mean: Array  # the error (12,) of the prior's camera less that of this one
    change: Array  # of the landmarks' coordinates (M, 3)
    z: Array  # what is predicted here (M, 3) [px]
    own: Array  # its derivatives (M, 3, 3) by the coordinates
    lever: Array  # see `Jacobian`
    from_prior: float  # squared distance from the prior

    def cost(self, update: Update, rows: BoolArray) -> float:
        """Squared distance from prior and measurements; ∞ where one cannot be seen."""
        residual = np.where(rows, update.z - self.z, 0.0)
        cost = self.from_prior + float(np.vdot(residual, residual)) / update.sigma**2
        return cost if math.isfinite(cost) else math.inf

    def camera_after(self, change: Array) -> Any:
        """The camera after a change of the state (n,), from here."""
        return self.camera.moved(self.J @ change[:CAMERA])


@dataclass(frozen=True, eq=False)
class Innovation:
    """ν and its covariance S, linearised somewhere (paper A, Eq. 11)."""

    rows: BoolArray  # mask of its rows (M, 3)
    H: Jacobian
    HP: tuple[Array, Array]  # see `Jacobian.times`
    nu: Array  # innovation of the prior's mean (3M,)
    S: Array  # its covariance, lower triangle (3M, 3M)

    @classmethod
    def of(cls, update: Update, rows: BoolArray, at: Linearisation) -> Innovation:
        """Linearised at an iterate."""
        H = Jacobian(at.own if rows.all() else np.where(rows[:, :, None], at.own, 0.0), at.lever, update.marks)
        nu = np.where(rows, update.z - at.z, 0.0).reshape(-1)
        nu += (H.own @ at.change[:, :, None]).reshape(-1) - H.by_pose.reshape(-1, POSE) @ at.mean[:POSE]
        HP = H.times(update.covariance)
        return cls(rows, H, HP, nu, H.covariance(*HP, update.sigma**2))


@dataclass(frozen=True, eq=False)
class Whitened:
    """The innovation whitened by ``S = L Lᵀ``: ``w = L⁻¹ ν`` has covariance 1.

    To take out measurements is to project w on what is orthogonal to the columns of L⁻¹ that belong to them: that gives
    what a factorisation without them would.
    """

    innovation: Innovation
    rows: BoolArray  # mask of its rows (M, 3)
    nu: Array  # (3M,)
    inverse: Array  # L⁻¹ (3M, 3M), lower triangular
    taken: Array  # orthonormal directions (3M, K) of what has been taken out

    @classmethod
    def of(cls, innovation: Innovation, gone: BoolArray) -> Whitened:
        """Without some rows (mask (M, 3)).

        Raises:
            UnsolvableError: S is not positive definite.
        """
        nu, S, out = innovation.nu, innovation.S, np.flatnonzero(gone)
        if len(out):
            nu, S = nu.copy(), S.copy()
            nu[out], S[out], S[:, out], S[out, out] = 0.0, 0.0, 0.0, 1.0
        upper, info = dpotrf(S.T)  # of the transpose, which is in the order that LAPACK wants
        if info != 0:
            raise UnsolvableError("the innovation covariance is not positive definite")
        inverse = _inverse(upper).T
        inverse[out, out] = 0.0
        return cls(innovation, innovation.rows & ~gone, nu, inverse, np.zeros((len(nu), 0)))

    def without(self, gone: BoolArray) -> Whitened:
        """Without some more landmarks (mask (M,))."""
        columns = self.inverse[:, np.flatnonzero(gone[:, None] & self.rows)]
        more = np.linalg.qr(columns - self.taken @ (self.taken.T @ columns))[0]
        taken = np.concatenate([self.taken, more], axis=1)
        return replace(self, rows=self.rows & ~gone[:, None], taken=taken)

    def whiten(self, X: Array) -> Array:
        """``L⁻¹ X``, as far as it is not taken out, for X (3M, ...)."""
        W = self.inverse @ X
        return np.asarray(W - self.taken @ (self.taken.T @ W))

    def lost(self, update: Update) -> tuple[Array, Array, Array]:
        """``P Hᵀ L⁻ᵀ``, see `Covariance.corrected`."""
        P, (with_camera, with_marks) = update.covariance, self.innovation.HP
        rest = self.innovation.H.times_rest(P)
        if P.rig:
            field = np.where(self.innovation.rows[:, :, None], update.field(update.z), 0.0)
            rest[:, -P.rig :] -= field.reshape(-1, P.rig)
        narrow = self.whitened(np.concatenate([with_camera, rest], axis=1))
        return narrow[: len(P.head)], self.whitened(with_marks), narrow[len(P.head) :]

    def whitened(self, HX: Array) -> Array:
        """`whiten` of H X, transposed (N, 3M), in Fortran's order."""
        V = dtrmm(1.0, self.inverse.T, HX.T, side=1)
        if self.taken.size:
            V = dgemm(-1.0, V @ self.taken, self.taken, beta=1.0, c=V, trans_b=1, overwrite_c=1)
        return np.asarray(V)

    @cached_property
    def w(self) -> Array:
        """The whitened innovation (3M,); its square is the NIS ``νᵀ S⁻¹ ν``."""
        return self.whiten(self.nu)

    @cached_property
    def y(self) -> Array:
        """``S⁻¹ ν`` (3M,)."""
        return np.asarray(self.w @ self.inverse)

    @cached_property
    def by_pose(self) -> Array:
        """The whitened innovation's covariance (3M, 6) with the pose."""
        return self.whiten(self.innovation.HP[0][:, :POSE])

    def distances(self) -> Array:
        """Squared distance (M,) of each landmark's measurement from what all others predict; 0 for one without any.

        For the rows j of a landmark, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``: given the others, its innovation is off
        by ``Q_j⁻¹ y_j`` with covariance ``Q_j⁻¹``, so that the distance is ``y_jᵀ Q_j⁻¹ y_j``.
        """
        found = kernels.conditional_distances(self.inverse, self.taken.T @ self.inverse, self.y)
        used = self.rows.any(axis=1)
        if not np.isfinite(found[used]).all():
            raise UnsolvableError("the innovation covariance is not positive definite")
        return np.where(used, found, 0.0)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The maximum of the posterior (or one step towards it)."""

    update: Update
    used: BoolArray  # which landmarks (M,) it is made of
    at: Linearisation  # the last linearisation
    change: Array  # of the state (n,), see `Linearisation.camera_after`
    whitened: Whitened  # the last innovation, from which the covariance follows


@dataclass(frozen=True, eq=False)
class Gated:
    """Which landmarks each lie within the gate of their own innovation covariance."""

    used: BoolArray  # (M,)
    limits: Array  # of the gate (M,)
    distances: Array  # squared, of the innovations (M,); NaN where none is predicted
    start: Linearisation  # where they were linearised
    innovation: Innovation


def gate(update: Update, at_guess: bool = False) -> Gated:
    """Test each landmark by itself, with its innovation linearised at the prior or at the guess.

    Raises:
        UnsolvableError: the prior is not finite, or S is not positive definite.
    """
    start, measured = update.at(update.guess if at_guess else None), np.isfinite(update.z)
    P = update.covariance
    if not (np.isfinite(start.camera.pose).all() and math.isfinite(P.camera.trace() + P.marks.trace())):
        raise UnsolvableError("the predicted state is not finite")
    visible = np.asarray(np.isfinite(start.z).all(axis=1))
    innovation = Innovation.of(update, measured & visible[:, None], start)
    limits = chi_square_limits(measured.sum(axis=1), update.gate_probability)
    own = kernels.own_distances(innovation.nu, innovation.S)
    if not np.isfinite(own).all():
        raise UnsolvableError("the predicted innovations are not finite or not positive definite")
    distances = np.where(visible, own, np.nan)
    return Gated(np.asarray(distances <= limits), limits, distances, start, innovation)


def solve(update: Update, gated: Gated) -> Posterior | None:
    """Solve with what passed the gate, and take out what the other measurements contradict, the worst first.

    A wrong match spoils the tests of its neighbours, so a round takes out only landmarks at least half as far off as
    the worst one, until all that is left agrees; None where nothing is left.

    Raises:
        UnsolvableError: S is not positive definite, the new state not finite, or the pose's covariance not positive.
    """
    if not gated.used.any():
        return None
    used, first = gated.used, Whitened.of(gated.innovation, gated.innovation.rows & ~gated.used[:, None])
    while used.any():
        at, change, whitened = _iterate(update, gated.start, first)
        excess = whitened.distances() / gated.limits
        worst = excess.max()
        if worst <= 1:
            left = update.covariance.pose - whitened.by_pose.T @ whitened.by_pose
            if dpotrf(left, lower=1)[1] != 0:
                raise UnsolvableError("the pose's covariance would not stay positive definite")
            return Posterior(update, used, at, change, whitened)
        used = used & (excess <= max(1.0, 0.5 * worst))
        first = first.without(~used)
    return None


def _iterate(update: Update, now: Linearisation, whitened: Whitened) -> tuple[Linearisation, Array, Whitened]:
    """The change of the state (n,), from where, by an update whose first linearisation is `whitened`, and the last.

    Gauss-Newton on the posterior (an iterated Kalman filter); a step that raises the cost is shortened. The prior is
    transported from its own coordinates, not from those of the iterate: where landmarks move by much, the result is not
    quite the posterior's maximum. Where the first is far from linear, the guess may be the better next place. One
    iteration is taken as it is: the papers' filter.
    """
    rows, reached = whitened.rows, None
    for iteration in range(1, update.iterations + 1):
        s, HP = whitened.innovation.H.transposed_times(whitened.y), whitened.innovation.HP
        change = np.concatenate([now.mean + whitened.y @ HP[0], whitened.y @ HP[1]])
        if not np.isfinite(change).all():
            raise UnsolvableError("the corrected state is not finite")
        if update.iterations == 1 or _linear(update, whitened, now, change):
            return now, change, whitened
        following, step = _descend(update, rows, now, s, change)
        if iteration == 1 and update.guess is not None:
            following = min(following, _at_guess(update), key=lambda iterate: iterate.cost(update, rows))
        if following is now:
            break
        reached = now, step, whitened
        if iteration < update.iterations:
            now = following
            whitened = Whitened.of(Innovation.of(update, rows, now), np.zeros_like(rows))
    if reached is None:
        raise UnsolvableError("no step towards the solution lowers the cost")
    return reached


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


def _linear(update: Update, whitened: Whitened, now: Linearisation, change: Array) -> bool:
    """Whether the measurements change by a step as the Jacobian says, as far as the pose depends on it."""
    moved = change[update.numbers[POSE:]].reshape(-1, 3)
    T, c = now.camera_after(change).pose, update.coordinates.moved(update.landmarks.c, moved)
    z, _ = update.measurement.seen(T, c)
    seen = moved - now.lever @ change[:POSE] - now.change
    errors = np.where(whitened.rows, z - now.z - (now.own @ seen[:, :, None])[:, :, 0], 0.0)
    if not np.abs(errors).max() < _LINEAR * update.sigma:
        return False
    shift = whitened.whiten(errors.reshape(-1)) @ whitened.by_pose
    variances = update.covariance.pose.diagonal() - (whitened.by_pose**2).sum(axis=0)
    return bool((shift**2 <= _POSE_SHARE**2 * variances).all())


def _at_guess(update: Update) -> Linearisation:
    """The guess, with the landmarks where they are believed: its distance from the prior is that of the pose alone."""
    there, distance = update.at(update.guess), math.inf
    with suppress(np.linalg.LinAlgError):  # a pose that is known exactly cannot be moved
        mean = there.mean[:POSE]
        distance = float(mean @ np.linalg.solve(update.covariance.pose, mean))
    return replace(there, from_prior=distance)


def _descend(
    update: Update, rows: BoolArray, now: Linearisation, s: Array, change: Array
) -> tuple[Linearisation, Array]:
    """The longest of the steps 1, 1/2, 1/4, ... towards ``change = mean + P s`` that does not raise the cost, else now.

    Where it ends, and the step (n,). The next linearisation is at the pose reached: the camera turns, and the landmarks
    stay. On the way the distance from the prior, with d at the start and d' at the end, is that of (1 − a) d + a d'.
    """
    numbers = update.numbers
    start = np.concatenate([np.zeros(POSE), now.change.reshape(-1)])
    mean = np.concatenate([now.mean[:POSE], np.zeros(now.change.size)])
    end, between = float(s @ (change[numbers] - mean)), float(s @ (start - mean))
    cost, step = now.cost(update, rows), change.copy()
    for halving in range(_HALVINGS):
        a = 0.5**halving
        step[numbers] = start + a * (change[numbers] - start)
        distance = (1 - a) ** 2 * now.from_prior + 2 * a * (1 - a) * between + a * a * end
        following = update.at(now.camera_after(step).pose, step[numbers[POSE:]].reshape(-1, 3), distance)
        if following.cost(update, rows) <= cost * (1 + 1e-9):
            return following, step
    return now, step
