"""The measurement update of the camera and the measured landmarks: gated and iterated; the filter is not changed.

Every quantity of an update follows from the camera's [r, φ] and the measured landmarks. Their part of the covariance,
``P_gg``, is small (6 + 3M), so that iterating and gating cost little; the whole state changes once, at the end, by
``x + P[:, g] s`` and ``P − W Wᵀ`` with ``W = P[:, g] Hᵀ L⁻ᵀ``, where ``S = L Lᵀ``.

A component that is not measured (or gated) keeps its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri, dtrtrs

from backends.ekf.jacobian import Displacement, Jacobian
from backends.ekf.measurement import Linearisation, Measurement
from slam.chi_square import chi_square_limits
from slam.data import BoolArray
from slam.geometry.se3 import Array

#: A step is the last where the measurements it predicts linearly are right to this share of their noise. Iterating
#: further than needed does harm: a landmark's Gaussian in world coordinates comes from pixels by a linearisation at its
#: prediction and fits pixels linearised there; moving that point to where each noisy measurement wants it biases the
#: estimate and claims information that is not there (simulated drives at 0.1: twice the rotation error, four times
#: the NEES of 1.0). But a long step, or the first frames of a fast camera, cannot do without.
_LINEAR = 1.0
#: Their errors together may move the pose by this share of its standard deviations: with a wide prior they all have the
#: same sign, and each within its noise they moved it by 0.7 of them.
_POSE_SHARE = 0.25
_HALVINGS = 6  # numerics: of a step that does not lower the cost

_SMALL = 48  # cost: rows of a triangular matrix that is inverted as a whole

_LATER = np.maximum(np.arange(3)[:, None], np.arange(3))  # row of an entry in the lower triangle of a symmetric block
_EARLIER = np.minimum(np.arange(3)[:, None], np.arange(3))


class UnsolvableError(ArithmeticError):
    """The update has no usable solution; the message says why. It never leaves the back end."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One update, in the coordinates g = [r, φ, measured landmarks].

    Attributes:
        prior: mean (6 + 3M,).
        covariance: P_gg (6 + 3M, 6 + 3M), symmetric.
        z: measurements (M, 3) [px], NaN where a component is not measured.
        sigma: pixel noise [px].
        model: what is predicted at a mean (6 + 3M,), and its derivatives.
        iterations: most linearisations.
        gate_probability: quantile of χ² beyond which a landmark's measurement is rejected.
        guess: a change of [r, φ] (6,) worth trying where the prior is far off, or None.
        gauge_jacobian: gives the Jacobian (6 + 3M, 6) of g by a displacement of the world, if that is unobservable.
    """

    prior: Array
    covariance: Array
    z: Array
    sigma: float
    model: Measurement
    iterations: int
    gate_probability: float
    guess: Array | None = None
    gauge_jacobian: Callable[[], Array] | None = None

    @cached_property
    def displacement(self) -> Displacement | None:
        """The unobservable part of a change: a displacement of the whole world. None where landmarks are known exactly.

        Of all displacements it is the one that explains the landmarks' change best, given their covariance.
        """
        if self.gauge_jacobian is None:
            return None
        U = self.gauge_jacobian()
        lower, info = dpotrf(self.covariance[6:, 6:].T, lower=1, clean=0)
        if info != 0:
            return None
        weighted = np.asarray(dpotrs(lower, U[6:], lower=1)[0])
        L = np.zeros(U.T.shape)
        L[:, 6:] = np.linalg.pinv(U[6:].T @ weighted, rcond=1e-12, hermitian=True) @ weighted.T
        return Displacement(U, L)

    def mean(self, change: Array) -> Array:
        """The mean (6 + 3M,) at which the model is asked after a change: without the world's displacement in it."""
        if not change.any() or self.displacement is None:
            return self.prior + change
        return self.prior + (change - self.displacement.change @ (self.displacement.share @ change))

    def jacobian(self, line: Linearisation, rows: BoolArray, change: Array) -> Jacobian:
        """Derivatives by the change, from those by the mean; zero where a row is not measured (mask (M, 3))."""
        return Jacobian.of(line, rows, self.displacement if change.any() else None)


@dataclass(frozen=True, eq=False)
class Solution:
    """The maximum of the posterior (or one step towards it).

    Attributes:
        used: which landmarks (M,) it is made of.
        s: the correction is ``P[:, g] s``.
        H: the Jacobian of the last linearisation.
        inverse: ``L⁻¹`` (3M, 3M), lower triangular.
        measured: which rows (3M,) are measured.
        nis: ``νᵀ S⁻¹ ν`` with the innovation taken back to the prior through the last linearisation.
        distances: of each landmark (M,): squared distance of its measurement from what all others predict.
        variances: of [r, φ] (6,) after the update.
    """

    used: BoolArray
    s: Array
    H: Jacobian
    inverse: Array
    measured: BoolArray
    nis: float
    distances: Array
    variances: Array

    @cached_property
    def B(self) -> Array:
        """``Hᵀ L⁻ᵀ`` (6 + 3M, K): the same as `whitened` of the identity, transposed."""
        B = self.H.transposed_times(self.inverse.T)
        return B if self.measured.all() else B[:, self.measured]

    def whitened(self, X: Array) -> Array:
        """``L⁻¹ H X`` (K, N) for X (6 + 3M, N): the covariance shrinks by WᵀW, where W is this of ``P[g, :]``."""
        W = dtrmm(1.0, self.inverse, self.H.times(X).T, side=1, lower=1, trans_a=1, overwrite_b=1).T
        return np.asarray(W if self.measured.all() else W[self.measured])

    def uncertainty(self, sigma: float) -> float:
        """Largest standard deviation of an innovation, given those before it, in that of a pixel, `sigma` [px]."""
        return 1 / (sigma * float(self.inverse.diagonal().min()))


@dataclass(frozen=True, eq=False)
class _Iterate:
    """A correction, the change of the mean that it makes, what is predicted there, and the cost.

    The cost is the squared distance from prior and measurements, ∞ where one cannot be seen.
    """

    s: Array
    change: Array
    z: Array
    cost: float


@dataclass(frozen=True, eq=False)
class _System:
    """The linear update at an iterate: Jacobian H, innovation ν taken back to the prior, its covariance S.

    `cross` is the innovation's covariance (3M, 6) with [r, φ], whose prior variances (6,) are `prior`.
    """

    rows: BoolArray
    H: Jacobian
    nu: Array
    S: Array
    cross: Array
    prior: Array

    @cached_property
    def L(self) -> Array:
        """The lower triangular L with ``L Lᵀ = S``."""
        L, info = dpotrf(self.S.T, lower=1)  # S is symmetric: its transpose is in the order that LAPACK wants
        if info != 0:
            raise UnsolvableError("the innovation covariance is not positive definite")
        return np.asarray(L)

    @cached_property
    def variances(self) -> Array:
        """Of [r, φ] (6,) after the update; rounding may leave one that is not positive."""
        W = dtrtrs(self.L, self.cross, lower=1)[0]
        return np.asarray(self.prior - (W * W).sum(axis=0))

    def only(self, rows: BoolArray, sigma: float) -> _System:
        """With fewer rows (mask (M, 3))."""
        if (rows == self.rows).all():
            return self
        kept = rows.reshape(-1)
        S = np.where(kept[:, None] & kept, self.S, 0.0)
        S.reshape(-1)[:: len(S) + 1][~kept] = sigma**2
        nu, cross = np.where(kept, self.nu, 0.0), np.where(kept[:, None], self.cross, 0.0)
        return _System(rows, self.H.only(rows), nu, S, cross, self.prior)


@dataclass(frozen=True, eq=False)
class Gated:
    """Which landmarks (M,) each lie within the gate of their own innovation covariance, linearised at `start`.

    The limits (M,) are the gate's, of the squared distances (M,) of the innovations; NaN where none is predicted.
    """

    used: BoolArray
    limits: Array
    distances: Array
    start: _Iterate
    system: _System


def gate(problem: Problem, at_guess: bool = False) -> Gated:
    """Test each landmark by itself, with its innovation linearised at the prior or at the guess.

    Raises:
        UnsolvableError: the prior is not finite, or S is not positive definite.
    """
    if not (np.isfinite(problem.prior).all() and np.isfinite(problem.covariance).all()):
        raise UnsolvableError("the predicted state is not finite")
    s: Array = np.zeros(len(problem.prior))
    change = s
    if at_guess:
        s = _towards_guess(problem)
        change = problem.covariance @ s
    line = problem.model.linearise(problem.mean(change))
    start = _Iterate(s, change, line.z, np.inf)
    measured = np.isfinite(problem.z)
    visible = np.asarray(np.isfinite(line.z).all(axis=1))
    system = _system(problem, measured & visible[:, None], start, line)
    limits = chi_square_limits(measured.sum(axis=1), problem.gate_probability)
    distances = np.where(visible, _squared_distances(system.nu, _diagonal_blocks(system.S)), np.nan)
    return Gated(distances <= limits, limits, distances, start, system)


def solve(problem: Problem, gated: Gated) -> Solution | None:
    """Solve with what passed the gate, and take out what the other measurements contradict, the worst first.

    A wrong match spoils the tests of its neighbours, so a round takes out only landmarks at least half as far off as
    the worst one, until all that is left agrees.

    Returns:
        the solution, or None where no observation is left.

    Raises:
        UnsolvableError: S is not positive definite, the new state not finite, or a variance not positive.
    """
    used = gated.used
    while used.any():
        solution = _iterate(problem, used, gated.start, gated.system)
        excess = solution.distances / gated.limits
        worst = excess.max()
        if worst <= 1:
            if not (solution.variances > 0).all():
                raise UnsolvableError("the pose's variances would not stay positive")
            return solution
        used = used & (excess <= max(1.0, 0.5 * worst))
    return None


def _iterate(problem: Problem, used: BoolArray, start: _Iterate, first: _System) -> Solution:
    """Update by the measurements of the landmarks `used` (M,); `first` is the system of all at the start.

    Gauss-Newton on the posterior (the iterated Kalman filter); a step that raises the cost, or takes a landmark
    behind the camera, is shortened. Where the first step is far from linear, the guess may be the better next place.
    With one iteration the step is taken as it is: the papers' filter.
    """
    rows = first.rows & used[:, None]
    now = _Iterate(start.s, start.change, start.z, _cost(problem, rows, start.z, float(start.s @ start.change)))
    system = first.only(rows, problem.sigma)
    for iteration in range(1, problem.iterations + 1):
        y = _solved(system)
        s: Array = system.H.transposed_times(y[:, None])[:, 0]
        if not np.isfinite(s).all():
            raise UnsolvableError("the corrected state is not finite")
        if problem.iterations == 1:
            break
        following = _visit(problem, rows, s, plain=True)
        if following.cost <= now.cost and _linear(problem, system, now, following):
            break
        following, whole = _descend(problem, rows, now, s)
        if whole and _linear(problem, system, now, following):
            break
        if iteration == 1 and problem.guess is not None:
            at_guess = _visit(problem, rows, _towards_guess(problem))
            following = min(following, at_guess, key=lambda iterate: iterate.cost)
        if following is now and iteration == 1:
            raise UnsolvableError("no step towards the solution lowers the cost")
        s = following.s
        if iteration == problem.iterations or following is now:
            break
        now, system = following, _system(problem, rows, following)
    inverse = _inverse(system.L)
    distances = _conditional_distances(inverse, y)
    nis = float(system.nu @ y)
    return Solution(used, s, system.H, inverse, rows.reshape(-1), nis, distances, system.variances)


def _inverse(L: Array) -> Array:
    """``L⁻¹`` of a lower triangular L (N, N), by halves: LAPACK's own takes twice as long for many rows."""
    half = len(L) // 2
    if half < _SMALL:
        return np.asarray(dtrtri(L, lower=1)[0])
    first, last = _inverse(L[:half, :half]), _inverse(L[half:, half:])
    out = np.zeros(L.shape, order="F")
    out[:half, :half], out[half:, half:] = first, last
    out[half:, :half] = dtrmm(1.0, last, dtrmm(-1.0, first, L[half:, :half], side=1, lower=1), lower=1)
    return out


def _solved(system: _System) -> Array:
    """``S⁻¹ ν``."""
    return np.asarray(dpotrs(system.L, system.nu, lower=1)[0])


def _linear(problem: Problem, system: _System, now: _Iterate, following: _Iterate) -> bool:
    """Whether the measurements changed between two iterates as the Jacobian said, as far as the pose depends on it."""
    expected = system.H.times((following.change - now.change)[:, None]).reshape(-1, 3)
    errors = np.where(system.rows, following.z - now.z - expected, 0.0)
    if np.abs(errors).max() >= _LINEAR * problem.sigma:
        return False
    moved = system.cross.T @ dpotrs(system.L, errors.reshape(-1), lower=1)[0]
    return bool((moved**2 <= _POSE_SHARE**2 * system.variances).all())


def _cost(problem: Problem, rows: BoolArray, z: Array, prior_cost: float) -> float:
    residual = np.where(rows, problem.z - z, 0.0)
    cost = prior_cost + float(np.vdot(residual, residual)) / problem.sigma**2
    return cost if math.isfinite(cost) else math.inf


def _towards_guess(problem: Problem) -> Array:
    """The correction s (6 + 3M,) that changes the pose by the guess, and moves the landmarks along as P has it."""
    assert problem.guess is not None
    s = np.zeros(len(problem.prior))
    with suppress(np.linalg.LinAlgError):  # a pose that is known exactly cannot be moved
        s[:6] = np.linalg.solve(problem.covariance[:6, :6], problem.guess)
    return s


def _visit(problem: Problem, rows: BoolArray, s: Array, plain: bool = False) -> _Iterate:
    """The iterate with a correction; `plain`: with the world's displacement in it, which is less work."""
    change = problem.covariance @ s
    z = problem.model.predict(problem.prior + change if plain else problem.mean(change))
    return _Iterate(s, change, z, _cost(problem, rows, z, float(s @ change)))


def _descend(problem: Problem, rows: BoolArray, now: _Iterate, target: Array) -> tuple[_Iterate, bool]:
    """The longest of the steps 1, 1/2, 1/4, ... towards `target` that does not raise the cost, else `now`.

    Also whether it is the whole step.
    """
    for halving in range(_HALVINGS):
        trial = _visit(problem, rows, now.s + 0.5**halving * (target - now.s))
        if trial.cost <= now.cost * (1 + 1e-9):
            return trial, halving == 0
    return now, False


def _system(problem: Problem, rows: BoolArray, now: _Iterate, line: Linearisation | None = None) -> _System:
    line = line or problem.model.linearise(problem.mean(now.change))
    H = problem.jacobian(line, rows, now.change)
    nu = np.where(rows, problem.z - line.z, 0.0).reshape(-1)
    if now.change.any():
        nu += H.times(now.change[:, None])[:, 0]
    HP = H.times(problem.covariance)
    S = H.times(HP.T)
    S.reshape(-1)[:: len(S) + 1] += problem.sigma**2
    return _System(rows, H, nu, S, HP[:, :6], problem.covariance.diagonal()[:6])


def _conditional_distances(inverse: Array, y: Array) -> Array:
    """Squared distance (M,) of each landmark's innovation from what all other measurements predict for it.

    For the rows j of a landmark, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``: given the others, its innovation is off by
    ``Q_j⁻¹ y_j`` with covariance ``Q_j⁻¹``, so the distance is ``y_jᵀ Q_j⁻¹ y_j``. Unused landmarks have 0. `inverse`
    is the lower triangular ``L⁻¹``.
    """
    Q = np.empty((len(y) // 3, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            Q[:, i, j] = Q[:, j, i] = np.einsum("nm,nm->m", inverse[:, i::3], inverse[:, j::3])
    return _squared_distances(y, Q)


def _squared_distances(nu: Array, covariances: Array) -> Array:
    """``ν_jᵀ S_j⁻¹ ν_j`` (M,) for the parts ν_j of ν (3M,) and positive definite S_j (M, 3, 3)."""
    from slam.geometry.gauss_kernels import squared_distances

    distances = np.asarray(squared_distances(nu.reshape(-1, 3), covariances))
    if np.isnan(distances).any():
        raise UnsolvableError("the innovation covariance is not positive definite")
    return distances


def _diagonal_blocks(lower: Array) -> Array:
    """The (M, 3, 3) blocks on the diagonal of a symmetric (3M, 3M) matrix, by its lower triangle."""
    first = np.arange(0, len(lower), 3)[:, None, None]
    return lower[first + _LATER, first + _EARLIER]
