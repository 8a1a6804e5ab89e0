"""The filter's covariance matrix: exact, but the part far from the camera is updated only when needed.

An update of a few landmarks changes every entry of the matrix, but until one of the others is measured nobody looks at
most of these. So the camera and the landmarks measured of late, the local part L, are kept as a small dense matrix;
what the updates have done to the rest b follows from small matrices that are carried along (the compressed filter of
Guivant and Nebot, IEEE Transactions on Robotics and Automation 17 (2001)):

    P_bL = X_b Φᵀ,        P_bb = P⁰_bb − X_b Ψ X_bᵀ.

P⁰ is the matrix as it was stored last, X its columns of the variables that were local then or became so since. Once the
local part has grown too large all is stored again (`_store`), by one ``dsyrk``. Nothing is neglected: it is the same
matrix, to rounding.

Of P⁰ only the lower triangle is kept, in Fortran order, so that BLAS updates it in place; above the diagonal stand
zeros, always. Its buffer has a few rows more than the state, all zero, so that landmarks come and go without copying
the rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg.blas import dgemm, dsyrk
from scipy.linalg.lapack import dpstrf

from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array

CAMERA = 12  #: fixed: size of the camera's state [r, φ, v, ω]
POSE = 6  #: fixed: its part [r, φ] that measurements depend on

_LOCAL = 150  # cost: rows of the local part that are never too many
_WHOLE = 2.5  # cost: all are local where the state has at most so many times the rows of what is measured,
_WHOLE_STILL = 4  # cost: and stay so up to here
_PIECES = 8  # cost: of a matrix, that are copied one by one
_THREE = np.arange(3)
_LATER = np.maximum(_THREE[:, None], _THREE)  # row of an entry in the lower triangle of a symmetric block
_EARLIER = np.minimum(_THREE[:, None], _THREE)


class Covariance:
    """Covariance of ``[camera (12), landmark 0 (3), landmark 1 (3), ...]``; landmarks are named by their slot.

    Attributes:
        count: number of landmarks.
    """

    def __init__(self, camera: Array) -> None:
        self.count = 0
        self._P = np.zeros((CAMERA, CAMERA), order="F")  # P⁰
        self._local: Array = np.array(camera, float)  # P_LL
        self._slots = np.zeros(0, np.intp)  # of the local landmarks
        self._place = np.zeros(0, np.intp)  # of each landmark among them, −1 for the others
        self._X: Array = np.zeros((CAMERA, 0))
        self._Phi: Array = np.zeros((CAMERA, 0))
        self._Psi: Array = np.zeros((0, 0))
        self._undo: list[tuple[Array, slice, Array]] = []  # parts of arrays as they were before they were changed
        self._mine = False  # whether P_LL and Φ may be changed in place

    def saved(self) -> Callable[[], None]:
        """A function that puts everything back as it is now."""
        undo = self._undo = []
        self._mine = False
        before = vars(self).copy()

        def restore() -> None:
            for array, part, values in reversed(undo):
                array[part] = values
            vars(self).update(before)

        return restore

    @property
    def size(self) -> int:
        """Number of rows in use."""
        return CAMERA + 3 * self.count

    @property
    def capacity(self) -> int:
        """Number of rows of the buffer."""
        return len(self._P)

    @property
    def _rest(self) -> bool:
        """Whether there are landmarks that are not local."""
        return len(self._slots) < self.count

    @property
    def camera(self) -> Array:
        """The camera's block (12, 12)."""
        return self._local[:CAMERA, :CAMERA].copy()

    @property
    def pose(self) -> Array:
        """The block of [r, φ] (6, 6)."""
        return self._local[:POSE, :POSE].copy()

    def full(self) -> Array:
        """The whole symmetric matrix (size, size): a copy."""
        self._store()
        lower = self._P[: self.size, : self.size]
        full = lower + lower.T
        np.fill_diagonal(full, lower.diagonal())
        return full

    def of_landmarks(self, slots: IndexArray) -> tuple[Array, Array]:
        """Marginal covariances (M, 3, 3) of landmarks, and their covariances (M, 3, 6) with the camera's [r, φ]."""
        place = self._place[slots]
        near, far = place >= 0, place < 0
        blocks, cross = np.empty((len(slots), 3, 3)), np.empty((len(slots), 3, POSE))
        rows = CAMERA + 3 * place[near][:, None] + _THREE
        blocks[near] = self._local[rows[:, :, None], rows[:, None, :]]
        cross[near] = self._local[rows, :POSE]
        first = CAMERA + 3 * slots[far][:, None, None]
        X = self._X[first[:, 0] + _THREE]
        by_base = X.reshape(3 * len(X), len(self._Psi)) @ np.concatenate([self._Psi, self._Phi[:POSE].T], axis=1)
        by_base = by_base.reshape(len(X), 3, len(self._Psi) + POSE)
        blocks[far] = self._P[first + _LATER, first + _EARLIER] - by_base[..., :-POSE] @ X.transpose(0, 2, 1)
        cross[far] = by_base[..., -POSE:]
        return blocks, cross

    @property
    def local(self) -> IndexArray:
        """Slots of the local landmarks, in the order in which they became so."""
        return self._slots

    def make_local(self, slots: IndexArray) -> IndexArray:
        """Let landmarks join the local part, which is stored first where it gets too large; returns who has joined.

        Where a good part of all is measured, all become local: that costs less than to carry the rest along.
        """
        far, needed = slots[self._place[slots] < 0], CAMERA + 3 * len(slots)
        whole = self.size <= _WHOLE * needed
        most = _WHOLE_STILL * needed if not self._rest else max(_LOCAL, self.size // 8, 3 * needed // 2)
        if whole and self._rest:
            far = np.concatenate([far, np.setdiff1d(np.flatnonzero(self._place < 0), far)])
        elif len(self._local) + 3 * len(far) > most:
            self._store()
            far = slots
        if len(far):
            self._fetch(far)
        if not self._rest:
            self._P, self._X = np.zeros((0, 0), order="F"), np.zeros((self.size, 0))
            self._Phi, self._Psi = self._Phi[:, :0], self._Psi[:0, :0]
        return far

    def marginal(self, slots: IndexArray) -> Array:
        """The covariance (6 + 3M, 6 + 3M) of ``g = [r, φ, landmarks]``; these are local."""
        g = self._rows(slots)
        return self._local.take(g, axis=0).take(g, axis=1)  # cost: a quarter of the time of one index for both axes

    def columns(self, slots: IndexArray) -> Array:
        """Covariance (size, 6 + 3M) of the whole state with ``g = [r, φ, landmarks]``; these are local."""
        g = self._rows(slots)
        out = self._X[: self.size] @ self._Phi[g].T
        out[self._own_rows()] = self._local[:, g]
        return np.asarray(out)

    def times(self, slots: IndexArray, s: Array) -> Array:
        """``P[:, g] s`` (size,), g as above."""
        g = self._rows(slots)
        out = self._X[: self.size] @ (s @ self._Phi[g])
        out[self._own_rows()] = s @ self._local[g]
        return np.asarray(out)

    def subtract(self, slots: IndexArray, whitened: Callable[[Array], Array]) -> None:
        """``P ← P − Wᵀ W`` with ``W = B P[g, :]``, g as above; `whitened` gives ``B X`` (K, N) for X (6 + 3M, N)."""
        g = self._rows(slots)
        W = whitened(self._local[g])
        reduction = W.T @ W
        if self._Phi.size:
            V = whitened(self._Phi[g])
            self._Phi = dgemm(-1.0, V.T, W.T, beta=1.0, c=self._Phi.T, trans_b=1, overwrite_c=self._mine).T
            self._Psi = self._Psi + V.T @ V
        self._local, self._mine = np.subtract(self._local, reduction, out=reduction), True

    def move_camera(self, dt: float, noise: Array) -> None:
        """``P ← A P Aᵀ + noise`` with the printed A of paper B: [r, φ] move by dt times [v, ω]; noise (12, 12)."""
        P, Phi = self._camera_rows()
        P[:POSE] += dt * P[POSE:CAMERA]
        P[:, :POSE] += dt * P[:, POSE:CAMERA]
        P[:CAMERA, :CAMERA] = _symmetric(P[:CAMERA, :CAMERA] + noise)
        Phi[:POSE] += dt * Phi[POSE:CAMERA]

    def transform_camera(self, J: Array) -> None:
        """``P ← J P Jᵀ`` for a change of the camera's state (12, 12)."""
        P, Phi = self._camera_rows()
        rows = J @ P[:CAMERA]
        rows[:, :CAMERA] = _symmetric(rows[:, :CAMERA] @ J.T)
        P[:CAMERA], P[:, :CAMERA] = rows, rows.T
        Phi[:CAMERA] = J @ Phi[:CAMERA]

    def transform_landmarks(self, K: Array) -> None:
        """``Y ← Y + K [r, φ]`` for a change of coordinates of those landmarks that became local last; K (M, 3, 6)."""
        by_pose, (P, Phi) = K.reshape(-1, POSE), self._own()
        rows = slice(len(P) - len(by_pose), len(P))
        own = np.zeros((POSE, len(P)))
        own[:, rows] = by_pose.T
        half = P[:POSE] + 0.5 * P[:POSE, :POSE] @ own  # P + ownᵀ half + halfᵀ own, in one product and in place
        both, other = np.concatenate([own, half]), np.concatenate([half, own])
        dgemm(1.0, both.T, other.T, beta=1.0, c=P.T, trans_b=1, overwrite_c=1)
        Phi[rows] += by_pose @ Phi[:POSE]

    def append(self, J: Array, noise: Array) -> None:
        """Add landmarks that depend on the camera's [r, φ] (paper A, Eq. 10): ``Y = g(r, φ) + noise``. They are local.

        Args:
            J: derivatives (M, 3, 6) of the landmarks by [r, φ].
            noise: covariances (M, 3, 3) of what is independent of it.
        """
        by_pose, new = J.reshape(-1, POSE), np.arange(self.count, self.count + len(J))
        cross = by_pose @ self._local[:POSE]
        own = cross[:, :POSE] @ by_pose.T
        each = np.arange(len(J))
        own.reshape(len(J), 3, len(J), 3)[each, :, each] += noise
        rest = self._rest
        self._place = np.concatenate([self._place, np.zeros(len(J), np.intp)])
        self.count += len(J)
        if not rest:
            self._X = np.zeros((self.size, self._X.shape[1]))
        elif self.size > len(self._P):
            self._resize()
        self._join(new, cross, own, by_pose @ self._Phi[:POSE])

    def drop(self, slots: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Take landmarks out; the last ones move into their slots.

        Args:
            slots: of the landmarks (M,), each once.

        Returns:
            the slots that were filled again and the slots that they were filled from; all others keep their place.
        """
        left = self.count - len(slots)
        gone = np.zeros(self.count, bool)
        gone[slots] = True
        holes, movers = np.flatnonzero(gone[:left]), left + np.flatnonzero(~gone[left:])
        stay = ~gone[self._slots]
        if not stay.all():
            rows = np.concatenate([np.ones(CAMERA, bool), np.repeat(stay, 3)])
            self._local, self._Phi, self._mine = _kept(self._local, rows), self._Phi[rows], True
            self._slots = self._slots[stay]
        for hole, mover in zip(holes.tolist(), movers.tolist()):
            if self._place[mover] < 0:  # what is stored of local ones does not count
                self._move(CAMERA + 3 * hole, CAMERA + 3 * mover)
        mine, tail = self._slots.copy(), slice(CAMERA + 3 * left, self.size)
        mine[mine >= left] = holes[np.searchsorted(movers, mine[mine >= left])]
        self._slots = mine
        self._note(self._P, tail)
        self._note(self._X, tail)
        self._P[tail] = self._X[tail] = 0.0
        self.count = left
        place = np.full(left, -1)
        place[mine] = np.arange(len(mine))
        self._place = place
        if len(self._P) > self.size + 4 * _spare(self.size):
            self._resize()
        return holes, movers

    # --- the local part ---

    def _rows(self, slots: IndexArray) -> IndexArray:
        """Rows (6 + 3M,) of [r, φ, landmarks] in the local part."""
        g = np.empty(POSE + 3 * len(slots), np.intp)
        g[:POSE] = np.arange(POSE)
        g[POSE:].reshape(-1, 3)[:] = CAMERA + 3 * self._place[slots][:, None] + _THREE
        return g

    def _own_rows(self) -> IndexArray:
        """Rows of the whole state that the local part holds."""
        return np.concatenate([np.arange(CAMERA), (CAMERA + 3 * self._slots[:, None] + _THREE).reshape(-1)])

    def _fetch(self, slots: IndexArray) -> None:
        """Landmarks of the rest join the local part."""
        rows = (CAMERA + 3 * slots[:, None] + _THREE).reshape(-1)
        X = self._X[rows]
        stored = self._gather(slots)
        by_base = -X @ self._Psi
        self._X = np.concatenate([self._X, stored], axis=1)
        Phi, Psi = self._Phi, self._Psi
        n, k = len(Psi), len(rows)
        self._Phi, self._Psi = np.zeros((len(Phi), n + k)), np.zeros((n + k, n + k))
        self._Phi[:, :n], self._Psi[:n, :n] = Phi, Psi
        self._join(slots, X @ Phi.T, stored[rows] + by_base @ X.T, np.concatenate([by_base, np.eye(k)], axis=1))

    def _join(self, slots: IndexArray, cross: Array, own: Array, Phi: Array) -> None:
        """Enlarge the local part by landmarks with covariances `cross` with it and `own`."""
        old = len(self._local)
        larger = np.empty((old + len(own), old + len(own)))
        larger[:old, :old], larger[:old, old:] = self._local, cross.T
        larger[old:, :old], larger[old:, old:] = cross, _symmetric(own)
        self._local, self._Phi, self._mine = larger, np.concatenate([self._Phi, Phi]), True
        self._place = self._place.copy()
        self._place[slots] = len(self._slots) + np.arange(len(slots))
        self._slots = np.concatenate([self._slots, slots])

    def _store(self) -> None:
        """Bring P⁰ up to date. Only the camera stays local."""
        if not len(self._P) == len(self._X) >= self.size:
            self._resize()
        mine, P = self._own_rows(), self._P
        C = _square_root(self._Psi)
        X = self._X.copy()
        X[mine] = 0.0
        P = dsyrk(-1.0, dgemm(1.0, X.T, C, trans_a=1), beta=1.0, c=P, lower=1) if C.shape[1] else P.copy(order="F")
        columns = np.zeros((len(self._local), len(P)))  # transposed: each row is read in one go
        columns[:, : self.size] = self._Phi @ X[: self.size].T
        columns[:, mine] = self._local
        for row, start in zip(range(0, len(mine), 3), mine[::3].tolist()):
            P[start : start + 3, :start] = columns[row : row + 3, :start]
            P[start:, start : start + 3] = columns[row : row + 3, start:].T
            P[start, start + 1] = P[start, start + 2] = P[start + 1, start + 2] = 0.0
        self._P, self._local = P, self.camera
        self._slots, self._place = np.zeros(0, np.intp), np.full(self.count, -1)
        self._X, self._Phi, self._Psi = columns[:CAMERA].T.copy(), np.eye(CAMERA), np.zeros((CAMERA, CAMERA))

    # --- the stored matrix ---

    def _gather(self, slots: IndexArray) -> Array:
        """Columns (capacity, 3M) of P⁰."""
        P, starts = self._P, CAMERA + 3 * slots
        rows = np.empty((3 * len(slots), len(P)))  # the transposed result: each row is written in one go
        for row, start in zip(range(0, len(rows), 3), starts.tolist()):
            rows[row : row + 3, :start] = P[start : start + 3, :start]
            rows[row : row + 3, start:] = P[start:, start : start + 3].T
        own = 3 * np.arange(len(slots))
        for i, j in ((1, 0), (2, 0), (2, 1)):
            rows[own + i, starts + j] = P[starts + i, starts + j]
        return rows.T

    def _move(self, to: int, row: int) -> None:
        """Copy a landmark's rows and columns, which start at `row`, to `to` < `row`."""
        P = self._P
        self._note(P, slice(to, to + 3))
        self._note(P.T, slice(to, to + 3))
        self._note(self._X, slice(to, to + 3))
        P[to : to + 3, :to] = P[row : row + 3, :to]
        P[to + 3 : row, to : to + 3] = P[row : row + 3, to + 3 : row].T
        P[row + 3 : self.size, to : to + 3] = P[row + 3 : self.size, row : row + 3]
        P[to : to + 3, to : to + 3] = P[row : row + 3, row : row + 3]
        self._X[to : to + 3] = self._X[row : row + 3]

    def _camera_rows(self) -> tuple[Array, Array]:
        """P_LL and Φ, of which the camera's rows and columns are to be changed in place."""
        if not self._mine:
            for array in (self._local, self._local.T, self._Phi):
                self._note(array, slice(CAMERA))
        return self._local, self._Phi

    def _own(self) -> tuple[Array, Array]:
        """P_LL and Φ, to be changed in place: copies, once after each `saved`."""
        if not self._mine:
            self._local, self._Phi, self._mine = self._local.copy(), self._Phi.copy(), True
        return self._local, self._Phi

    def _note(self, array: Array, part: slice) -> None:
        """Note rows of an array that is about to be changed in place."""
        self._undo.append((array, part, array[part].copy()))

    def _resize(self) -> None:
        """Make the buffers hold the state, with a little room to grow."""
        capacity, old = self.size + _spare(self.size), min(self.size, len(self._P))
        P, X = np.zeros((capacity, capacity), order="F"), np.zeros((capacity, self._X.shape[1]))
        P[:old, :old], X[:old] = self._P[:old, :old], self._X[:old]
        self._P, self._X = P, X


def _spare(rows: int) -> int:
    """Spare rows: few, as BLAS works through them, but a share of all, so that growing seldom copies the matrix."""
    return max(24, rows // 40)


def _kept(M: Array, rows: BoolArray) -> Array:
    """M (N, N) with some rows, and columns, alone; few pieces of it are left out."""
    edges = np.flatnonzero(np.diff(rows, prepend=False, append=False)).tolist()
    if len(edges) > 2 * _PIECES:
        some = np.flatnonzero(rows)
        return M.take(some, axis=0).take(some, axis=1)
    count = np.count_nonzero(rows)
    out = np.empty((count, count))
    pieces, start = [], 0
    for first, last in zip(edges[::2], edges[1::2]):
        pieces.append((slice(start, start + last - first), slice(first, last)))
        start += last - first
    for to, of in pieces:
        for across, of_across in pieces:
            out[to, across] = M[of, of_across]
    return out


def _symmetric(M: Array) -> Array:
    """Without what rounding has made unequal."""
    return np.asarray(0.5 * (M + M.T))


def _square_root(M: Array) -> Array:
    """C (N, R) with ``C Cᵀ = M`` for a positive semidefinite M (N, N) of rank R, by pivoted Cholesky."""
    scale = np.sqrt(np.maximum(M.diagonal(), 0.0))
    nonzero = np.flatnonzero(scale)
    scale = scale[nonzero]
    if not len(nonzero):
        return np.zeros((len(M), 0))
    L, pivots, rank, _ = dpstrf(M[np.ix_(nonzero, nonzero)] / np.outer(scale, scale), lower=1)
    C = np.zeros((len(M), rank))
    C[nonzero[pivots - 1]] = np.tril(L)[:, :rank] * scale[pivots - 1][:, None]
    return C
