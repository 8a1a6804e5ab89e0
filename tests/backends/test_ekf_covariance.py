"""The filter's covariance matrix against the plain dense formula."""

from __future__ import annotations

import numpy as np

from backends.ekf.angles import (
    attitude,
)
from backends.ekf.covariance import CAMERA, Covariance, _kept
from slam.geometry.euler import rotation
from tests.slam.numeric import assert_equal_to_rounding, positive


def grown(landmarks: int, rng: np.random.Generator) -> tuple[Covariance, np.ndarray]:
    """A covariance with landmarks, and the same as a dense matrix."""
    camera = positive(CAMERA, rng)
    covariance, dense = Covariance(camera), camera
    while covariance.count < landmarks:
        count = min(7, landmarks - covariance.count)
        J = rng.standard_normal((count, 3, 6))
        noise = np.array([positive(3, rng) for _ in range(count)])
        covariance.append(J, noise)
        dense = augmented(dense, J, noise)
    return covariance, dense


def augmented(P: np.ndarray, J: np.ndarray, noise: np.ndarray) -> np.ndarray:
    F = np.zeros((3 * len(J), len(P)))
    F[:, :6] = J.reshape(-1, 6)
    own = F @ P @ F.T
    for i, block in enumerate(noise):
        own[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += block
    return np.block([[P, P @ F.T], [F @ P, own]])


def columns_of(slots) -> np.ndarray:
    return np.concatenate([np.arange(6), *[CAMERA + 3 * s + np.arange(3) for s in slots]])


def test_augmentation_has_the_full_cross_covariance():
    covariance, dense = grown(40, np.random.default_rng(4))
    assert_equal_to_rounding(covariance.full(), dense)
    assert covariance.count == 40 and covariance.size == 132 <= covariance.capacity


def test_parts_of_the_matrix():
    covariance, dense = grown(23, np.random.default_rng(5))
    slots = np.array([4, 0, 22, 11])
    assert_equal_to_rounding(covariance.camera, dense[:CAMERA, :CAMERA])
    assert_equal_to_rounding(covariance.pose, dense[:6, :6])
    for block, cross, s in zip(*covariance.of_landmarks(slots), slots):
        rows = slice(CAMERA + 3 * s, CAMERA + 3 * s + 3)
        assert_equal_to_rounding(block, dense[rows, rows])
        assert_equal_to_rounding(cross, dense[rows, :6])
    g = columns_of(slots)
    covariance.make_local(slots)
    assert_equal_to_rounding(covariance.marginal(slots), dense[np.ix_(g, g)])
    assert_equal_to_rounding(covariance.columns(slots), dense[:, g])


def test_moving_the_camera_is_the_printed_prediction():
    covariance, dense = grown(9, np.random.default_rng(6))
    dt, noise = 0.3, positive(CAMERA, np.random.default_rng(7))
    A = np.eye(len(dense))
    A[:3, 6:9] = A[3:6, 9:12] = dt * np.eye(3)
    dense = A @ dense @ A.T
    dense[:CAMERA, :CAMERA] += noise
    covariance.move_camera(dt, noise)
    assert_equal_to_rounding(covariance.full(), dense)


def test_a_change_of_the_cameras_state():
    covariance, dense = grown(9, np.random.default_rng(8))
    J = np.eye(len(dense))
    J[:CAMERA, :CAMERA] = np.random.default_rng(9).standard_normal((CAMERA, CAMERA))
    covariance.transform_camera(J[:CAMERA, :CAMERA])
    assert_equal_to_rounding(covariance.full(), J @ dense @ J.T)


def test_subtraction():
    covariance, dense = grown(20, np.random.default_rng(10))
    slots, B = np.array([3, 17]), 0.1 * np.random.default_rng(11).standard_normal((12, 5))
    g = columns_of(slots)
    covariance.make_local(slots)
    assert_equal_to_rounding(covariance.times(slots, B[:, 0]), dense[:, g] @ B[:, 0])
    covariance.subtract(slots, lambda X: B.T @ X)
    W = dense[:, g] @ B
    assert_equal_to_rounding(covariance.full(), dense - W @ W.T)


def test_a_change_of_landmarks_coordinates():
    rng = np.random.default_rng(15)
    covariance, dense = grown(20, rng)
    covariance.full()  # so that all landmarks but the next are brought up to date later
    slots, K = np.array([7, 2, 11]), rng.standard_normal((3, 3, 6))
    covariance.make_local(np.array([4, 9]))
    np.testing.assert_array_equal(covariance.make_local(slots), slots)
    covariance.transform_landmarks(K)
    M = np.eye(len(dense))
    M[columns_of(slots)[6:], :6] = K.reshape(-1, 6)
    assert_equal_to_rounding(covariance.full(), M @ dense @ M.T)


class Dense:
    """The same operations on the whole matrix, as they are written; landmarks have names."""

    def __init__(self, P: np.ndarray) -> None:
        self.P, self.names = P, list(range((len(P) - CAMERA) // 3))

    def columns(self, names: list[int]) -> np.ndarray:
        return columns_of([self.names.index(name) for name in names])

    def measure(self, names: list[int], rng: np.random.Generator) -> np.ndarray:
        """Measure landmarks; returns B of the update."""
        g = self.columns(names)
        H = rng.standard_normal((3 * len(names), len(g)))
        S = H @ self.P[np.ix_(g, g)] @ H.T + np.eye(len(H))
        B = np.linalg.solve(np.linalg.cholesky(S), H).T
        W = self.P[:, g] @ B
        self.P = self.P - W @ W.T
        return B


def test_what_is_brought_up_to_date_later_is_exact(monkeypatch):
    """Three hundred random steps: landmarks measured here and there, moves, changes of state, landmarks come and go."""
    monkeypatch.setattr("backends.ekf.covariance._LOCAL", 60)  # so that it is stored again and again
    stored = []
    store = Covariance._store
    monkeypatch.setattr(Covariance, "_store", lambda self: (stored.append(self.count), store(self))[1])
    rng = np.random.default_rng(14)
    covariance, P = grown(60, rng)
    dense, slots, fresh = Dense(P), list(range(60)), 60  # slots: the name that each slot holds
    for step in range(300):
        near = [name for name in dense.names if abs(name % 60 - step // 5) < 12] or dense.names
        names = [int(i) for i in rng.choice(near, min(4, len(near)), replace=False)]
        where = np.array([slots.index(name) for name in names])
        g = dense.columns(names)
        covariance.make_local(where)
        np.testing.assert_allclose(covariance.marginal(where), dense.P[np.ix_(g, g)], rtol=1e-7, atol=1e-9)
        before, B = dense.P, dense.measure(names, rng)
        order = np.concatenate([np.arange(CAMERA), *[dense.columns([name])[6:] for name in slots]])
        np.testing.assert_allclose(
            covariance.times(where, B[:, 0]), before[order][:, g] @ B[:, 0], rtol=1e-7, atol=1e-9
        )
        covariance.subtract(where, lambda X, B=B: B.T @ X)
        F = np.eye(len(dense.P))
        F[:6, 6:12] = 0.1 * np.eye(6)
        dense.P = F @ dense.P @ F.T
        dense.P[:CAMERA, :CAMERA] += 0.1 * np.eye(CAMERA)
        covariance.move_camera(0.1, 0.1 * np.eye(CAMERA))
        if step % 40 == 17:
            J = np.eye(CAMERA) + 0.1 * rng.standard_normal((CAMERA, CAMERA))
            F = np.eye(len(dense.P))
            F[:CAMERA, :CAMERA] = J
            dense.P = F @ dense.P @ F.T
            covariance.transform_camera(J)
        if step % 7 == 3:
            gone = [int(i) for i in rng.choice(dense.names, 3, replace=False)]
            keep = np.setdiff1d(np.arange(len(dense.P)), dense.columns(gone)[6:])
            dense.P = dense.P[np.ix_(keep, keep)]
            dense.names = [name for name in dense.names if name not in gone]
            holes, movers = covariance.drop(np.array([slots.index(name) for name in gone]))
            for hole, mover in zip(holes, movers):
                slots[hole] = slots[mover]
            del slots[len(dense.names) :]
        if step % 7 == 5:
            J, noise = rng.standard_normal((3, 3, 6)), np.tile(np.eye(3), (3, 1, 1))
            dense.P = augmented(dense.P, J, noise)
            covariance.append(J, noise)
            dense.names += range(fresh, fresh + 3)
            slots += range(fresh, fresh + 3)
            fresh += 3
        if step % 25 == 0:
            rows = np.concatenate([dense.columns([name])[6:] for name in slots])
            blocks, cross = covariance.of_landmarks(np.arange(len(slots)))
            expected = dense.P[rows.reshape(-1, 3)[:, :, None], rows.reshape(-1, 3)[:, None, :]]
            np.testing.assert_allclose(blocks, expected, rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(cross.reshape(-1, 6), dense.P[rows, :6], rtol=1e-7, atol=1e-9)
    assert len(stored) > 10
    rows = np.concatenate([np.arange(CAMERA), *[dense.columns([name])[6:] for name in slots]])
    np.testing.assert_allclose(covariance.full(), dense.P[np.ix_(rows, rows)], rtol=1e-7, atol=1e-9)
    assert np.linalg.eigvalsh(covariance.full())[0] > 0


def test_landmarks_come_and_go():
    rng = np.random.default_rng(12)
    covariance, dense = grown(300, rng)
    covariance.full()
    largest = covariance.capacity
    order = list(range(300))  # which landmark each slot holds
    for count in (1, 7, 100, 1, 150, 0, 1):
        holes, movers = covariance.drop(rng.permutation(len(order))[:count])
        for hole, mover in zip(holes, movers):
            order[hole] = order[mover]
        del order[len(order) - count :]
    rows = np.concatenate([np.arange(CAMERA), *[CAMERA + 3 * i + np.arange(3) for i in order]])
    expected = dense[np.ix_(rows, rows)]
    np.testing.assert_allclose(covariance.full(), expected, rtol=1e-9, atol=1e-11)
    assert covariance.capacity < largest / 3, "memory follows the map down"
    J, noise = rng.standard_normal((50, 3, 6)), np.tile(np.eye(3), (50, 1, 1))
    covariance.append(J, noise)
    np.testing.assert_allclose(covariance.full(), augmented(expected, J, noise), rtol=1e-9, atol=1e-11)
    covariance.drop(np.array([covariance.count - 1]))
    np.testing.assert_allclose(covariance.full(), augmented(expected, J[:-1], noise[:-1]), rtol=1e-9, atol=1e-11)


def test_the_papers_angles_are_the_ones_of_the_state():
    # R(φ) = Rz Ry Rx, with the world turned: the filter's attitude is the printed matrix times a constant
    phi = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(attitude(np.eye(3), phi), rotation(phi), atol=1e-15)


def test_a_part_of_a_matrix():
    """In few pieces and in many, of the same bytes and in the same order in memory."""
    rng = np.random.default_rng(2)
    M = rng.standard_normal((60, 60))
    for share in (0.0, 0.02, 0.1, 0.5, 0.98, 1.0):
        rows = rng.random(60) >= share
        part = _kept(M, rows)
        assert (part == M[np.ix_(rows, rows)]).all() and part.flags.c_contiguous and not np.shares_memory(part, M)
