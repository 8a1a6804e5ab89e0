"""The compiled face of this room: cameras, poses from known points, and many small Gaussians.

`camera` (7,) is `slam.geometry.rig.StereoRig.rectified_parameters`; points (M, 3) of a pose are in world coordinates;
measurements z (M, 3) are (uL, vL, uR), NaN where missing.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import assign, squared_distance, trace, turn, whitener
from slam.kernels.se3 import adjoint, between, point_by_motion, transform_back
from slam.kernels.stereo import offsets, residual
from slam.runtime.compilation import helper, kernel


@kernel
def project_rectified(camera, points, jacobian):
    """Pixels (uL, vL, uR) (N, 3) of points (N, 3) in left-camera coordinates; NaN behind the camera.

    Second, if `jacobian`, the derivatives (N, 3, 3) by the points; else no rows.
    """
    z, J = np.empty((len(points), 3)), np.zeros((len(points) if jacobian else 0, 3, 3))
    for n in range(len(points)):
        u, v, right_u, inverse = offsets(camera, points[n, 0], points[n, 1], points[n, 2])
        z[n, 0], z[n, 1], z[n, 2] = u + camera[2], v + camera[3], right_u + camera[5]
        if jacobian:
            J[n, 0, 0], J[n, 1, 1], J[n, 2, 0] = camera[0] * inverse, camera[1] * inverse, camera[4] * inverse
            J[n, 0, 2], J[n, 1, 2], J[n, 2, 2] = -u * inverse, -v * inverse, -right_u * inverse
    return z, J


@kernel
def triangulate_rectified(camera, uv_left, uv_right):
    """Points (N, 3) in left-camera coordinates of pixels (N, 2); NaN where these say no positive depth."""
    fu, fv, u0, v0, right_fu, right_u0, shift = camera
    points = np.full((len(uv_left), 3), np.nan)
    for n in range(len(uv_left)):
        x = (uv_left[n, 0] - u0) / fu
        depth = -shift / (x - (uv_right[n, 0] - right_u0) / right_fu)
        if depth > 0 and np.isfinite(depth):
            points[n, 0], points[n, 1], points[n, 2] = x * depth, (uv_left[n, 1] - v0) / fv * depth, depth
    return points


# --- the lens by Brown and Conrady; coefficients (8,): k1, k2, p1, p2, k3, k4, k5, k6 ---


@kernel
def project(points, pinhole, distorts, coefficients, limit, nearest):
    """Pixels (N, 2) of points (N, 3) in a camera with a `pinhole` (4,) = (fu, fv, u0, v0) that `distorts` or not.

    They are NaN where the depth is not beyond `nearest`, and beyond `limit`, where the polynomial folds rays back.
    """
    uv, D = np.empty((len(points), 2)), np.empty((2, 2))
    for i in range(len(points)):
        z = points[i, 2] if points[i, 2] > nearest else np.nan
        a, b = points[i, 0] / z, points[i, 1] / z
        if distorts:
            if np.sqrt(a * a + b * b) > limit:
                a = b = np.nan
            a, b = _distorted(coefficients, a, b, D)
        uv[i, 0], uv[i, 1] = a * pinhole[0] + pinhole[2], b * pinhole[1] + pinhole[3]
    return uv


@kernel
def undistort(target, coefficients, limit):
    """Normalised coordinates (N, 2) of distorted ones, by Newton's method; NaN where no ray leads there."""
    out, D = np.empty_like(target), np.empty((2, 2))
    for i in range(len(target)):
        a, b, step = target[i, 0], target[i, 1], np.inf
        for _ in range(50):  # 50: Newton steps at most
            x, y = _distorted(coefficients, a, b, D)
            x, y = x - target[i, 0], y - target[i, 1]
            det = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
            da, db = (D[1, 1] * x - D[0, 1] * y) / det, (D[0, 0] * y - D[1, 0] * x) / det
            a, b, step = a - da, b - db, max(abs(da), abs(db))
            if not step > 1e-13:  # 1e-13: a step below it is the last
                break
        # 1e-9: a last step above it means that no ray leads to the pixel
        if not (step < 1e-9 and np.sqrt(a * a + b * b) <= limit):
            a = b = np.nan
        out[i, 0], out[i, 1] = a, b
    return out


@helper
def _distorted(coefficients, a, b, D):
    """One pair of coordinates, distorted, and its derivatives D (2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    r2 = a * a + b * b
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
    slope *= 2 / denominator  # d radial / d a = slope · a
    D[0, 0] = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a
    D[0, 1] = D[1, 0] = a * b * slope + 2 * p1 * a + 2 * p2 * b
    D[1, 1] = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a
    x = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    return x, b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b


# --- one pose and known points ---


@kernel
def errors(camera, points, z, poses):
    """Largest error of uL, vL, uR (H, M) [px] under each pose (H, 4, 4); NaN behind the camera."""
    out, local, r, J = np.empty((len(poses), len(points))), np.empty(3), np.empty(3), np.empty((3, 3))
    for h in range(len(poses)):
        for m in range(len(points)):
            transform_back(poses[h], points[m], local)
            residual(camera, local, z[m], r, J)
            largest = abs(r[0])
            for i in range(1, 3):
                if abs(r[i]) > largest or (i == 1 and np.isnan(r[i])):
                    largest = abs(r[i])
            out[h, m] = largest
    return out


# --- many small Gaussians ---


@kernel
def squared_distances(gaps, covariances):
    """``gᵀ C⁻¹ g`` (N,) of gaps (N, 3) with covariances (N, 3, 3), by Cholesky; NaN where one is not positive definite.

    Only the lower triangle is read. Where the third entry of a gap is NaN, the first two count alone.
    """
    out = np.empty(len(gaps))
    for i in range(len(gaps)):
        out[i] = squared_distance(gaps[i], covariances[i])
    return out


@kernel
def whiteners(covariances):
    """Inverses (N, 3, 3) of the Cholesky factors of covariances (N, 3, 3); NaN where one is not positive definite."""
    out = np.empty(covariances.shape)
    for i in range(len(covariances)):
        whitener(covariances[i], out[i])
    return out


# --- landmarks as a camera expects them ---


@kernel
def seen(T, before, points, covariances, motion):
    """Points (M, 3) in the coordinates of a camera T (4, 4), and their covariances (M, 3, 3) there.

    `covariances` are those in the coordinates of the camera `before` (4, 4), from which T has moved by what is known
    with the covariance `motion` (6, 6).
    """
    local, out = np.empty(points.shape), np.empty(covariances.shape)
    R, G, GM = np.empty((3, 4)), np.zeros((3, 6)), np.empty((3, 6))
    between(T, before, R)
    for m in range(len(points)):
        transform_back(T, points[m], local[m])
        turn(R, covariances[m], out[m])
        point_by_motion(local[m], -1.0, G)
        for i in range(3):
            for j in range(6):
                GM[i, j] = 0.0
                for k in range(6):
                    GM[i, j] += G[i, k] * motion[k, j]
        for i in range(3):
            for j in range(3):
                for k in range(6):
                    out[m, i, j] += GM[i, k] * G[j, k]
    return local, out


@kernel
def relative_covariance(P, at, to, earlier, later):
    """Covariance (6, 6) of a pose `later` (4, 4) where another one, `earlier`, is known, both perturbed on the right.

    Their unknowns begin at `to` and `at` in the joint covariance P.
    """
    M, A, W, out = np.empty((3, 4)), np.empty((6, 6)), np.empty((6, 12)), np.empty((6, 6))
    between(later, earlier, M)
    adjoint(M, A)
    for i in range(6):
        for j in range(6):
            x, y = P[to + i, at + j], P[to + i, to + j]
            for k in range(6):
                x -= A[i, k] * P[at + k, at + j]
                y -= A[i, k] * P[at + k, to + j]
            W[i, j], W[i, 6 + j] = x, y
    for i in range(6):
        for j in range(i + 1):
            total = W[i, 6 + j]
            for k in range(6):
                total -= W[i, k] * A[j, k]
            out[i, j] = out[j, i] = total
    return out


@kernel
def predicted_pixels(camera, local, covariances, sigma, most):
    """Left and right pixels (M, 2) of points (M, 3) in the camera, and innovation covariances (M, 2, 2) of the left.

    After a long gap variances are so large that their digits do not hold the noise `sigma` of a pixel: where rounding
    has left less than that, or a correlation beyond `most`, there is the least that is definite.
    """
    count = len(local)
    left, right, S = np.empty((count, 2)), np.empty((count, 2)), np.empty((count, 2, 2))
    for m in range(count):
        u, v, right_u, inverse = offsets(camera, local[m, 0], local[m, 1], local[m, 2])
        left[m, 0], left[m, 1], right[m, 0] = u + camera[2], v + camera[3], right_u + camera[5]
        right[m, 1] = left[m, 1]
        C, a, b, c, d = covariances[m], camera[0] * inverse, camera[1] * inverse, -u * inverse, -v * inverse
        uu = a * a * C[0, 0] + 2.0 * a * c * C[0, 2] + c * c * C[2, 2]
        vv = b * b * C[1, 1] + 2.0 * b * d * C[1, 2] + d * d * C[2, 2]
        uv = a * b * C[0, 1] + a * d * C[0, 2] + c * b * C[1, 2] + c * d * C[2, 2]
        uu, vv = max(uu, 0.0) + sigma * sigma, max(vv, 0.0) + sigma * sigma
        limit = most * np.sqrt(uu * vv)
        S[m, 0, 0], S[m, 1, 1], S[m, 0, 1] = uu, vv, min(max(uv, -limit), limit)
        S[m, 1, 0] = S[m, 0, 1]
    return left, right, S


@kernel
def residual_noise(camera, local, covariances, z, sigma):
    """Covariances (M, 3, 3) [px²] of residuals for a known pose: see `slam.window.pose_only.residual_noise`."""
    out, other, r = np.empty(covariances.shape), np.empty((3, 3)), np.empty(3)
    J, point = np.empty((3, 3)), np.empty(3)
    for m in range(len(local)):
        residual(camera, local[m], z[m], r, J)
        turn(J, covariances[m], out[m])
        x, y = (z[m, 0] - camera[2]) / camera[0], (z[m, 1] - camera[3]) / camera[1]
        depth = -camera[6] / (x - (z[m, 2] - camera[5]) / camera[4])
        if depth > 0.0 and np.isfinite(depth):
            point[0], point[1], point[2] = x * depth, y * depth, depth
            residual(camera, point, z[m], r, J)
            turn(J, covariances[m], other)
            if 0.0 < trace(other) < trace(out[m]):
                assign(other, out[m])
        for i in range(3):
            out[m, i, i] += sigma * sigma
    return out
