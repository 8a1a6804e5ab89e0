from __future__ import annotations

import numpy as np
import pytest

from slam.bodies import scene_kernels, track_kernels
from tests.slam.bodies.test_scene import scene

RNG = np.random.default_rng(5)
TRACKS, SLOTS = 7, 6


def windows():
    """Information and points by slot, as of stereo measurements; the last slot of the first track is empty."""
    J = 100 * RNG.standard_normal((TRACKS, SLOTS, 3, 3))
    A = np.swapaxes(J, 2, 3) @ J
    A[0, -1] = 0.0
    return A, 0.1 * RNG.standard_normal((TRACKS, SLOTS, 3)), np.where(A[..., 0, 0] > 0, 3, 0).astype(np.int8)


def test_constant_velocities_are_least_squares_in_point_and_velocity():
    A, p, dof = windows()
    times, (points, velocity) = np.linspace(-0.5, 0.0, SLOTS), np.zeros((2, TRACKS, 3))
    P, PV = np.zeros((2, TRACKS, 3, 3))
    test = track_kernels.fit_tracks(
        A, p, dof, np.zeros((TRACKS, 3)), np.arange(TRACKS), np.ones(TRACKS, bool), 0, times, 0.25, -np.inf, points, P,
        velocity, PV,
    )  # fmt: skip
    for n in range(TRACKS):
        H = np.stack([np.hstack([np.eye(3), t * np.eye(3)]) for t in times])
        normal = np.einsum("wki,wkl,wlj->ij", H, A[n], H) + np.diag([0.0] * 3 + [0.25] * 3)
        x = np.linalg.solve(normal, np.einsum("wki,wkl,wl->i", H, A[n], p[n]))
        covariance = np.linalg.inv(normal)
        np.testing.assert_allclose(np.concatenate([points[n], velocity[n]]), x, atol=1e-6)
        np.testing.assert_allclose(P[n], covariance[:3, :3], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(PV[n], covariance[3:, 3:], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(test[n], x[3:] @ np.linalg.solve(covariance[3:, 3:], x[3:]), rtol=1e-5)


def test_a_displacement_is_less_certain_by_the_slide_of_a_feature_seen_from_elsewhere():
    """The camera goes by 0.2 m across a line of sight of 2 m: 0.1 rad, so much variance of the direction, at 2 m."""
    A, p, dof = np.tile(1e6 * np.eye(3), (1, SLOTS, 1, 1)), np.zeros((1, SLOTS, 3)), np.full((1, SLOTS), 3, np.int8)
    ages, ray = np.arange(SLOTS)[::-1].copy(), np.array([[0.0, 0.0, 2.0]])
    centres, P = 0.04 * np.arange(SLOTS)[:, None] * np.array([1.0, 0, 0]), {}
    for slide in (0.0, 1e-4):
        _, W, _ = track_kernels.displaced(A, p, dof, np.array([0]), ages, 3, ray, centres, slide)
        P[slide] = np.linalg.inv(W[0])
    np.testing.assert_allclose(P[1e-4] - P[0.0], 1e-4 * 0.1 * 2.0**2 * np.diag([1.0, 1.0, 0.0]), atol=1e-12)


@pytest.mark.parametrize("known", [1.0, 0.1])
def test_the_test_of_a_window_is_that_of_two_motions(known):
    """Also where a few near points know more of some motions than all others."""
    moved, view = scene(count=60, near=6, shift=(0.004, 0.0, 0.0))
    moved.W[6:] *= known
    sums = scene_kernels.normal_equations(moved.points, moved.d, 0.5 * moved.W, moved.lag)
    windows = [np.arange(3, 9), np.arange(6), np.arange(5, 60, 9)]
    cell = np.arange(60) + np.zeros((8, 1), int)  # a window for each track
    for kind, tracks in enumerate(windows):
        cell[kind, tracks] = 2**35 + 2**23 + 2**11  # and one about the origin
    values = scene_kernels.groups_apart(
        sums, view, np.sort(60 * cell + np.arange(60)), np.full((1, 3), 100.0), np.full(61, 5.0), 4
    )[1]
    full, eta = np.zeros((60, 6, 6)), sums[:, 21:27]
    full[:, *np.tril_indices(6)] = sums[:, :21]
    full += np.swapaxes(np.tril(full, -1), 1, 2)
    rest = np.arange(6, 60)
    H, G = (full[k].sum(axis=0) + np.diag(scene_kernels.PRIOR) for k in (windows[1], rest))
    gap = np.linalg.solve(H, eta[windows[1]].sum(axis=0)) - np.linalg.solve(G, eta[rest].sum(axis=0))
    assert values == pytest.approx([gap @ np.linalg.solve(np.linalg.inv(H) + np.linalg.inv(G), gap)], rel=1e-6)
