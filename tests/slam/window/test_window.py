"""The window solver against dense least squares, finite differences, and itself with something marginalised."""

from dataclasses import replace

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.kernels.linear import cholesky
from slam.runtime.compilation import kernel
from slam.window import chart_kernels, pose_only, solver
from slam.window.marginal import Conditional, marginalised
from slam.window.motion import predict
from slam.window.pose_only import PoseProblem
from slam.window.problem import Motion, Places, RelativePrior, Rows, Window
from slam.window.solver import linearised
from slam.window.stereo import RectifiedStereo
from tests.slam.numeric import jacobian

RIG = StereoRig.rectified_pair(400, 319.5, 239.5, 0.12, 640, 480)
STEREO = RectifiedStereo.of(RIG)
POSES, POINTS, SIGMA = 5, 40, 0.5
START = np.diag([1e-10] * 3 + [1e-8] * 3)  # covariance of the first pose
VELOCITY = np.array([0.01, 0.02, -0.01, 0.05, 0.01, 0.1])


@kernel
def factor(M, U):
    return cholesky(M, U)


def truth(poses=POSES, points=POINTS, seed=0):
    """Poses (K, 4, 4) and points (N, 3)."""
    rng = np.random.default_rng(seed)
    path = np.array([se3.exp(k * VELOCITY) for k in range(poses)])
    return path, np.stack([rng.uniform(-3, 3, points), rng.uniform(-2, 2, points), rng.uniform(4, 20, points)], axis=1)


def window(seed=0, noise=SIGMA, missing=7, off=0.02, **parts):
    """Every point seen from every pose; every seventh row has no right pixel; poses and points start off the truth."""
    rng, (path, points) = np.random.default_rng(seed + 100), truth(seed=seed)
    pose, point = np.repeat(np.arange(POSES), POINTS), np.tile(np.arange(POINTS), POSES)
    z = np.concatenate([STEREO.project(se3.transform(se3.inverse(T), points))[0] for T in path])
    z += noise * rng.standard_normal(z.shape)
    z[::missing, 2] = np.nan
    start = np.array([T @ se3.exp(off * rng.standard_normal(6)) for T in path])
    start[0] = path[0]
    rows = Rows.of(pose, point, z, SIGMA)
    parts = {"prior": RelativePrior.of_pose(path[0], START), **parts}
    return Window(STEREO, start, points * (1 + off * rng.standard_normal((POINTS, 1))), rows, **parts)


def solve(w):
    """To the last digits."""
    return solver.solve(w, 1e-14)


def cost(w):
    return linearised(w).cost


def after(e, x):
    """The window after a step of the unknowns, and of the points that are eliminated to what is best without it."""
    w = e.window
    members = np.concatenate([w.prior.points, w.joining])
    points = w.points + (e.E @ (e.inverse @ e.gradient[:, :, None]))[:, :, 0]
    mine = 3 * len(members)
    points[members] = w.points[members] + (e.E[members] @ x[:mine].reshape(-1, 3, 1))[:, :, 0]
    return replace(w, poses=w.poses @ se3.exp(x[mine:].reshape(-1, 6)), points=points)


def dense(w):
    """Information of all poses, then all points in world axes, summed row by row."""
    K, n = len(w.poses), 6 * len(w.poses) + 3 * len(w.points)
    H = np.zeros((n, n))
    for k, m, z, weight in zip(w.rows.pose, w.rows.point, w.rows.z, w.rows.root[:, 0, 0]):
        T = w.poses[k]
        local = se3.transform(se3.inverse(T), w.points[m : m + 1])
        J = STEREO.project(local)[1][0][np.isfinite(z)] * weight
        whole = np.zeros((len(J), n))
        whole[:, 6 * k : 6 * k + 6] = J @ se3.points_by_pose(local)[0]
        whole[:, 6 * K + 3 * m : 6 * K + 3 * m + 3] = J @ T[:3, :3].T
        H += whole.T @ whole
    H[:6, :6] += np.linalg.inv(START)
    return H


def test_covariances_are_those_of_dense_least_squares():
    w = solve(window()).window
    found = solve(w)
    P, n = np.linalg.inv(dense(found.equations.window)), 6 * POSES
    scale = np.sqrt(np.diag(P[:n, :n]))
    np.testing.assert_allclose(
        found.pose_covariance / np.outer(scale, scale), P[:n, :n] / np.outer(scale, scale), atol=1e-6
    )
    local, world = found.point_covariances(POSES - 1)
    T = w.poses[-1]
    by_pose = se3.points_by_pose(se3.transform(se3.inverse(T), w.points))
    for m in range(POINTS):
        own = slice(n + 3 * m, n + 3 * m + 3)
        np.testing.assert_allclose(world[m], P[own, own], rtol=1e-3, atol=1e-3 * np.trace(P[own, own]))
        J = np.zeros((3, len(P)))
        J[:, n - 6 : n], J[:, own] = by_pose[m], T[:3, :3].T
        np.testing.assert_allclose(local[m], J @ P @ J.T, rtol=1e-3, atol=1e-3 * np.trace(J @ P @ J.T))


def test_covariances_that_are_asked_for_are_those_of_all():
    """Unknown points that nobody asks for stand first; nothing else changes."""
    w = solve(window(prior=RelativePrior.of_pose(truth()[0][0], START, np.zeros((6, 2))))).window
    part = replace(w, rows=w.rows.select(w.rows.pose == 0), joining=np.arange(8))
    prior = marginalised(part, [0], np.zeros(0, bool), np.ones((POINTS, 3, 2)))[0]
    rest = w.rows.select(w.rows.pose > 0)
    w = Window(STEREO, w.poses[1:], w.points, replace(rest, pose=rest.pose - 1), prior=prior)
    asked = np.arange(POINTS) % 3 == 0
    one, other = solve(w), solve(replace(w, asked=asked))
    scale = np.sqrt(np.diag(one.pose_covariance))
    np.testing.assert_allclose(one.window.points, other.window.points, rtol=1e-9)
    np.testing.assert_allclose(other.pose_covariance / np.outer(scale, scale),
                               one.pose_covariance / np.outer(scale, scale), atol=1e-6)  # fmt: skip
    for mine, its in zip(one.point_covariances(-1), other.point_covariances(-1)):
        np.testing.assert_allclose(its[asked], mine[asked], rtol=1e-5, atol=1e-9)
        assert not its[~asked].any() and mine[~asked].any()
    for mine, its in zip(one.by_rig(np.ones((len(rest), 3, 2))), other.by_rig(np.ones((len(rest), 3, 2)))):
        np.testing.assert_allclose(its, mine, rtol=1e-5, atol=1e-9)


def test_distances_of_rows_are_those_of_leaving_each_out():
    w = solve(window()).window
    found, newest = solve(w), np.flatnonzero(w.rows.pose == POSES - 1)
    local, _ = found.point_covariances(-1)
    distances = found.left_out_distances(-1, w.rows.point[newest], w.rows.z[newest], local[w.rows.point[newest]], SIGMA)
    for row, distance in list(zip(newest, distances))[:6]:
        rest = solve(replace(w, rows=w.rows.select(np.arange(len(w.rows)) != row)))
        m, T = w.rows.point[row], rest.window.poses[-1]
        z, J = STEREO.project(se3.transform(se3.inverse(T), rest.window.points[m : m + 1]))
        measured = np.isfinite(w.rows.z[row])
        nu, J = (w.rows.z[row] - z[0])[measured], J[0][measured]
        S = SIGMA**2 * np.eye(len(nu)) + J @ rest.point_covariances(-1)[0][m] @ J.T
        assert distance == pytest.approx(nu @ np.linalg.solve(S, nu), rel=0.05)


def test_the_only_row_of_a_point_is_at_no_distance():
    """Whatever was measured, the point explains it: there is nothing to test, at any share of noise."""
    w = window()
    w = replace(w, rows=w.rows.select((w.rows.point != 3) | (w.rows.pose == POSES - 1)))
    found, z = solver.solve(w), w.rows.z[(w.rows.point == 3)]
    local, _ = found.point_covariances(-1)
    assert found.left_out_distances(-1, np.array([3]), z, local[3:4], SIGMA, 0.01) == 0
    known = replace(w, mean=w.points, information=np.tile(np.eye(3), (POINTS, 1, 1)))
    found = solver.solve(known)
    local, _ = found.point_covariances(-1)
    assert found.left_out_distances(-1, np.array([3]), z, local[3:4], SIGMA) > 0


def test_distances_are_finite_however_far_the_last_step_went():
    """Covariances and derivatives are of one linearisation; of two, a residual's variance may be negative."""
    rng = np.random.default_rng(0)
    path, points = truth()
    far = points * rng.uniform(1, 8, (POINTS, 1))
    z = np.concatenate([STEREO.project(se3.transform(se3.inverse(T), far))[0] for T in path])
    z += SIGMA * rng.standard_normal(z.shape)
    z[:, 2] = np.where(rng.random(len(z)) < 0.5, np.nan, z[:, 2])
    rows = Rows.of(np.repeat(np.arange(POSES), POINTS), np.tile(np.arange(POINTS), POSES), z, SIGMA)
    start = far * rng.uniform(0.7, 1.4, (POINTS, 1))
    found = solver.solve(Window(STEREO, path, start, rows, prior=RelativePrior.of_pose(path[0], START)), 10.0)
    local, _ = found.point_covariances(-1)
    newest = rows.pose == POSES - 1
    points, z = rows.point[newest], rows.z[newest]
    assert np.isfinite(found.left_out_distances(-1, points, z, local[points], SIGMA)).all()


def test_nees_of_poses_is_in_its_band():
    squares = []
    for seed in range(40):
        found = solve(window(seed))
        off = se3.log(se3.inverse(found.window.poses[1:]) @ truth(seed=seed)[0][1:]).ravel()
        squares.append(off @ np.linalg.solve(found.pose_covariance[6:, 6:], off))
    mean = np.mean(squares) / (6 * (POSES - 1))
    assert 0.9 < mean < 1.1  # standard deviation of the mean: sqrt(2 / (24 · 40)) = 0.046


def with_everything():
    """A window with each kind of knowledge."""
    path, points = truth()
    basis, origin = chart_kernels.relative_charts(path[1], points[:3] * 1.01)
    root = np.tile(np.diag([50.0, 50.0, 80.0]), (3, 1, 1))
    information = np.zeros((POINTS, 3, 3))
    information[5:8] = np.diag([9.0, 4.0, 1.0])
    sigma = np.full((POSES - 1, 6), 0.3)
    triples = np.array([(-1, 0, 1), *((k - 2, k - 1, k) for k in range(2, POSES))])
    return window(
        places=Places(np.full(3, 1), np.arange(3), basis, origin, root), mean=points + 0.05, information=information,
        motion=Motion(triples, np.full((POSES - 1, 2), 0.1), 0 * sigma, sigma**2),
    )  # fmt: skip


def test_motion_tells_nothing_of_how_all_poses_are_turned_in_the_world():
    """Its rows in the world's axes did, to first order: the normal equations knew of it what nothing had measured."""
    w = with_everything()
    path = np.array([w.poses[0]] * POSES)
    for k in range(1, POSES):
        path[k] = path[k - 1] @ se3.exp(VELOCITY + 0.05 * np.sin(np.arange(6) + k))
    one = Motion(*(column[1:] for column in w.motion.arrays[:4]))
    e = linearised(Window(STEREO, path, np.zeros((0, 3)), Rows.none(), motion=one))
    H = np.tril(e.H) + np.tril(e.H, -1).T
    together = np.concatenate([se3.adjoint(se3.inverse(T)) for T in path])
    np.testing.assert_allclose(H @ together, 0.0, atol=1e-9 * np.abs(H).max())


def test_gradient_is_the_costs_derivative():
    """Of a window with each kind of knowledge, whose points are at their best for its poses."""
    w = with_everything()
    part = replace(w, rows=w.rows.select(w.rows.pose == 0), motion=Motion.none(), places=Places.none())
    prior = marginalised(replace(part, joining=np.arange(10, 20)), [0], np.zeros(0, bool))[0]
    rest = w.rows.select(w.rows.pose > 0)
    w = replace(w, poses=w.poses[1:], rows=replace(rest, pose=rest.pose - 1), prior=prior, motion=Motion(
        np.array([(0, 1, 2), (1, 2, 3)]), np.full((2, 2), 0.1), np.zeros((2, 6)), np.full((2, 6), 1 / 9)))  # fmt: skip
    for _ in range(12):  # only the points move: what is left is the gradient of the poses
        e = linearised(w)
        w = after(e, np.zeros(w.layout.unknowns))
    e = linearised(w)
    numeric = np.empty(w.layout.unknowns)
    for i in range(w.layout.unknowns):
        x = np.zeros(w.layout.unknowns)
        x[i] = 1e-6
        numeric[i] = -(cost(after(e, x)) - cost(after(e, -x))) / 2e-6 / 2
    np.testing.assert_allclose(numeric, e.b, rtol=1e-3, atol=1e-3 * np.abs(e.b).max())


def test_a_fixed_pose_stays():
    w = window(prior=RelativePrior.none(), free=np.arange(POSES) > 0)
    found = solve(w)
    np.testing.assert_array_equal(found.window.poses[0], w.poses[0])
    free = solve(window())
    np.testing.assert_allclose(found.window.poses, free.window.poses, atol=1e-5)
    for mine, its in zip(found.point_covariances(0), free.point_covariances(0)):
        np.testing.assert_allclose(mine, its, rtol=1e-3, atol=1e-3 * np.trace(its, axis1=1, axis2=2).max())


@pytest.mark.parametrize("leaves", [[0], [1], [0, 1], [1, 3]])
def test_poses_that_leave_changes_nothing(leaves):
    """The rest is solved as before, with the same covariance: here everything is linear next to the solution."""
    found = solve(window())
    w, rows = found.window, found.window.rows
    part = replace(w, rows=rows.select(np.isin(rows.pose, leaves)), joining=np.arange(POINTS))
    prior, conditional, _ = marginalised(part, leaves, np.zeros(0, bool))
    others = ~np.isin(np.arange(POSES), leaves)
    rest = rows.select(others[rows.pose])
    rest = replace(rest, pose=(np.cumsum(others) - 1)[rest.pose])
    after = solve(Window(STEREO, w.poses[others], w.points, rest, prior=prior))
    np.testing.assert_allclose(after.window.poses, w.poses[others], atol=1e-6)
    keep = np.repeat(others, 6)
    before = solve(w).pose_covariance[np.ix_(keep, keep)]
    np.testing.assert_allclose(after.pose_covariance, before, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(conditional.mean, 0, atol=1e-6)


def test_a_point_that_has_moved_far_counts_by_its_inverse_distance():
    """By its distance, what left would follow it by a hundred times as much, and the next one by as much again."""
    E = np.diag([5.0, 5.0, -25.0])[None]  # of a point 5 m ahead
    gain = np.zeros((9, 9))
    gain[2, 2] = 1.0
    moved, _ = Conditional(np.zeros(9), gain, E, E).of(np.array([[0.0, 0.0, 495.0]]), np.zeros((1, 6)))
    np.testing.assert_allclose(moved, [[0.0, 0.0, 1 / (2 / 5 - 1 / 500) - 5]])


def test_the_prior_does_not_mind_where_all_stands():
    """Moved as one, only what is known of the first pose in the world resists."""
    w = solve(window()).window
    part = replace(w, rows=w.rows.select(w.rows.pose == 0), joining=np.arange(POINTS))
    prior = marginalised(part, [0], np.zeros(0, bool))[0]
    far = se3.exp(np.array([0.3, -1.0, 0.4, 30, -20, 10]))
    there = replace(prior, T=far @ prior.T)
    moved = Window(STEREO, far @ w.poses[1:], se3.transform(far, w.points), Rows.none(), prior=there)
    here = Window(STEREO, w.poses[1:], w.points, Rows.none(), prior=prior)
    assert cost(moved) == pytest.approx(cost(here), abs=1e-6)


def test_what_is_refused_leaves_nothing_in_memory():
    """An exception inside a kernel would: all of its arrays, megabytes for each window that is not determined."""
    w = window(prior=RelativePrior.none())
    w = replace(w, rows=w.rows.select(w.rows.pose != 2), joining=np.arange(POINTS))
    with pytest.raises(np.linalg.LinAlgError):
        solve(w)
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    for _ in range(3):
        with pytest.raises(np.linalg.LinAlgError):
            solve(w)
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 8, 13, 150])
def test_the_factor_is_that_of_numpy(n):
    A = np.random.default_rng(n).standard_normal((n, n + 5))
    H = A @ A.T
    lower = np.tril(H) + np.triu(np.full((n, n), np.nan), 1)
    U = np.zeros((n, n))
    assert factor(lower, U)
    np.testing.assert_allclose(U.T, np.linalg.cholesky(H), atol=1e-12 * max(n, 1))
    for i in range(n):
        for bad in (-1.0, np.nan):
            wrong = lower.copy()
            wrong[i, i] = bad
            assert not factor(wrong, U)


def test_a_wrong_match_to_a_near_landmark_does_not_stop_the_pose():
    """The step that all others ask for takes that landmark behind the camera."""
    rng, true = np.random.default_rng(5), np.eye(4)
    true[2, 3] = 2.0
    points = np.concatenate([rng.uniform([-2, -1.5, 6], [2, 1.5, 14], (60, 3)), [[0.1, 0.05, 0.45]]])
    z = STEREO.project(points - true[:3, 3])[0]
    z[60] = rng.uniform([200, 150, 150], [500, 350, 400])
    noise = np.tile(0.1 * np.eye(3), (61, 1, 1))
    noise[60] *= 1000  # so near, its own uncertainty is many pixels
    problem = PoseProblem(STEREO, points, z, noise, np.eye(4), 0.1 * np.eye(6), 0.99)
    T, used = pose_only.solve(problem, np.eye(4))
    np.testing.assert_allclose(T, true, atol=0.01)
    assert used[:60].all() and not used[60]


@pytest.mark.parametrize("entry", [0, 1])
def test_a_row_without_its_left_pixel_agrees_with_nothing(entry):
    _, points = truth()
    z = STEREO.project(points)[0]
    z[3, entry] = np.nan
    noise = np.tile(np.eye(3), (POINTS, 1, 1))
    T, used = pose_only.solve(PoseProblem(STEREO, points, z, noise, np.eye(4), np.eye(6), 0.99), np.eye(4))
    np.testing.assert_allclose(T, np.eye(4), atol=1e-9)
    assert used.sum() == POINTS - 1 and not used[3]
    found = solve(window())
    w = found.window
    newest = w.rows.pose == POSES - 1
    z, m = w.rows.z[newest], w.rows.point[newest]
    z[3, entry] = np.nan
    local, _ = found.point_covariances(-1)
    infinite = np.isinf(found.left_out_distances(-1, m, z, local[m], SIGMA, 2.0))
    np.testing.assert_array_equal(np.flatnonzero(infinite), [3])


def test_a_reference_that_leaves_without_points_leaves_a_prior_of_poses():
    w = window(prior=RelativePrior.of_pose(truth()[0][0], START, np.zeros((6, 2))))
    part = replace(w, rows=w.rows.select(w.rows.pose == 0))
    prior = marginalised(part, [0], np.zeros(0, bool), np.zeros((len(part.rows), 3, 2)))[0]
    assert len(prior.points) == 0 and prior.by_rig.shape == (len(prior.vector), 2)


@pytest.mark.parametrize("intervals", [(0.1, 0.1), (0.1, 0.25), (0.4, 0.1)])
def test_derivatives_of_the_next_pose_are_those_of_differences(intervals):
    rng = np.random.default_rng(5)
    T0 = se3.exp(rng.standard_normal(6) / 3)
    T1 = T0 @ se3.exp(rng.standard_normal(6) / 10)
    T2, J0, J1, _ = predict(T0, T1, *intervals)

    def moved(change: np.ndarray) -> np.ndarray:
        return se3.log(se3.inverse(T2) @ predict(T0 @ se3.exp(change[:6]), T1 @ se3.exp(change[6:]), *intervals)[0])

    np.testing.assert_allclose(np.hstack([J0, J1]), jacobian(moved, np.zeros(12)), atol=1e-8)
