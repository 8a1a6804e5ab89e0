"""Two cameras: the general, unrectified stereo rig of paper A (Eqs. 5-10) and its rectified rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from slam.errors import CalibrationError
from slam.geometry.camera import PinholeCamera, floats, size_doubt
from slam.geometry.se3 import Array, is_rotation, nearest_rotation, pose

_ZERO_DISPARITY = 1024  # fixed: OpenCV's CALIB_ZERO_DISPARITY, whose module differs between its versions
MINIMAL_POINTS = 3  #: fixed: points that fix a pose

#: By which a rig is recognised, of files that are of one rig alone.
NUMBERS = ("width", "height", "focal", "baseline", "u0", "v0", "right_u0")

#: What is said of cameras above each other, where their images are not at hand.
NOT_SIDE_BY_SIDE = (
    "the cameras do not stand side by side: the baseline is not along image rows. Of cameras above each other turn "
    "both images by 90 degrees; recordings with such a calibration are turned when they are read"
)


def measurement_rows(uv_left: Array, uv_right: Array) -> Array:
    """Stereo measurements (M, 3) = (uL, vL, uR) of pixels (M, 2); uR is NaN where there is no right pixel."""
    return np.concatenate([uv_left, uv_right[:, :1]], axis=1)


def quarter_turn(turns: int) -> Array:
    """Rotation (3, 3) that takes camera axes to those of an image turned so many quarters anticlockwise."""
    return np.linalg.matrix_power(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), turns % 4)


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two pinhole cameras and how they stand to each other (paper A, Eqs. 6 and 7).

    ``h_right = R (h_left + b)``, as Eq. (6) is printed; so `b` is minus the right camera's centre in left-camera axes.
    A rectified rig with baseline B > 0 has ``R = I``, ``b = (−B, 0, 0)``.

    Attributes:
        left, right: the cameras, with images of the same size.
        R: rotation (3, 3) from left-camera to right-camera axes.
        b: translation (3,) [m].
        turns: by how many quarter turns, anticlockwise, images as recorded are turned to be those of this rig, see
            `side_by_side`.

    Raises:
        CalibrationError: R is no rotation, the baseline is zero or not finite, the image sizes differ, or the
            right camera stands on the left of the left one.
    """

    left: PinholeCamera
    right: PinholeCamera
    R: Array
    b: Array
    turns: int = 0

    def __post_init__(self) -> None:
        if not (isinstance(self.left, PinholeCamera) and isinstance(self.right, PinholeCamera)):
            raise CalibrationError("a stereo rig is made of two PinholeCamera")
        R, b = floats("stereo extrinsics", self.R), floats("stereo extrinsics", self.b).reshape(-1)
        if R.shape != (3, 3) or b.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(b).all()):
            raise CalibrationError("stereo extrinsics must be a finite (3, 3) rotation and (3,) translation")
        if not is_rotation(R, 1e-4):
            raise CalibrationError("stereo extrinsics: R is not a rotation matrix")
        if np.abs(b).max() > 1e6:  # 1e6: baseline [m]
            raise CalibrationError(f"stereo baseline is impossibly long: {b.tolist()} m")
        if (self.left.width, self.left.height) != (self.right.width, self.right.height):
            raise CalibrationError(
                f"left images are {self.left.width}x{self.left.height}, "
                f"right images {self.right.width}x{self.right.height}: they must have one size"
            )
        baseline = float(np.linalg.norm(b))
        if baseline < 1e-6:
            raise CalibrationError("stereo baseline is zero: depth cannot be measured")
        if abs(b[0]) < 0.5 * baseline:
            raise CalibrationError(NOT_SIDE_BY_SIDE)
        if b[0] > 0:
            raise CalibrationError(
                f"the right camera stands {b[0]:.4f} m to the left of the left one: "
                "are the cameras swapped, or is the sign of T (or of P2) wrong? T is about (-baseline, 0, 0)"
            )
        R = nearest_rotation(R)
        R.flags.writeable = b.flags.writeable = False
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "b", b)

    @classmethod
    def rectified_pair(
        cls, f: float, u0: float, v0: float, baseline: float, width: int, height: int, doffs: float = 0.0
    ) -> StereoRig:
        """A rectified rig: two equal cameras `baseline` [m] apart; `doffs` [px] is u0 of the right less the left."""
        left = PinholeCamera(f, f, u0, v0, width, height)
        right = PinholeCamera(f, f, u0 + doffs, v0, width, height)
        return cls(left, right, np.eye(3), np.array([-baseline, 0, 0]))

    @classmethod
    def side_by_side(cls, left: PinholeCamera, right: PinholeCamera, R: Array, b: Array) -> StereoRig:
        """A rig of cameras as they are, turned by a quarter where they stand above each other, so that `b` is along x.

        Raises:
            CalibrationError: see the class.
        """
        across, along = np.abs(np.asarray(b, float)[:2])
        if not along > 2 * across:
            return cls(left, right, R, b)
        turns = 1 if b[1] < 0 else -1  # the second camera stands below the first, or above it
        Q = quarter_turn(turns)
        return cls(left.turned(turns), right.turned(turns), Q @ R @ Q.T, Q @ b, turns)

    @classmethod
    def from_pinhole(
        cls,
        K_left: ArrayLike,
        K_right: ArrayLike | None = None,
        *,
        size: tuple[int, int],
        baseline: float | None = None,
        R: ArrayLike | None = None,
        T: ArrayLike | None = None,
        D_left: ArrayLike | None = None,
        D_right: ArrayLike | None = None,
        fisheye: bool = False,
    ) -> StereoRig:
        """A rig by camera matrices, as ``cv2.stereoCalibrate`` gives them, or by one matrix and a baseline.

        Args:
            K_left: camera matrix (3, 3) [px].
            K_right: that of the right camera; without it the two cameras are equal.
            size: width and height of the images [px].
            baseline: distance of the cameras [m], where they stand exactly side by side; in place of T.
            R: rotation (3, 3) in ``h_right = R h_left + T``; without it the cameras look the same way.
            T: translation (3,) [m] in it.
            D_left: distortion coefficients in OpenCV's order.
            D_right: those of the right camera; not given for equal cameras.
            fisheye: the coefficients are those of ``cv2.fisheye``.

        Raises:
            CalibrationError: neither or both of T and baseline are given, or a value is impossible.

        Examples:
            >>> K = [[450, 0, 319.5], [0, 450, 239.5], [0, 0, 1]]
            >>> StereoRig.from_pinhole(K, baseline=0.12, size=(640, 480)).baseline
            0.12
        """
        if (T is None) == (baseline is None):
            raise CalibrationError("give either T or baseline: how far the cameras are apart")
        left = right = PinholeCamera.from_matrix(K_left, D_left, size, fisheye)
        if K_right is not None or D_right is not None:
            right = PinholeCamera.from_matrix(K_left if K_right is None else K_right, D_right, size, fisheye)
        rotation = floats("stereo extrinsics", np.eye(3) if R is None else R)
        offset = floats("stereo extrinsics", T if baseline is None else baseline).reshape(-1)
        offset = offset * [-1.0, 0.0, 0.0] if T is None else offset
        if rotation.shape != (3, 3) or offset.shape != (3,):
            raise CalibrationError("stereo extrinsics must be a (3, 3) rotation and a (3,) translation")
        with np.errstate(all="ignore"):  # what is not finite is refused right away
            return cls(left, right, rotation, rotation.T @ offset)

    @cached_property
    def baseline(self) -> float:
        """Distance between the camera centres [m]."""
        return float(np.linalg.norm(self.b))

    @property
    def width(self) -> int:
        """Image width [px]."""
        return self.left.width

    @property
    def height(self) -> int:
        """Image height [px]."""
        return self.left.height

    @cached_property
    def T_right_left(self) -> Array:
        """Pose (4, 4) taking left-camera to right-camera coordinates."""
        return pose(self.R, self.R @ self.b)

    def __repr__(self) -> str:
        kind = "rectified" if self.is_rectified else "not rectified"
        return (
            f"StereoRig({self.width}x{self.height}, {kind}, focal length {self.left.fu:.1f} px, "
            f"baseline {self.baseline:.4f} m)"
        )

    @cached_property
    def is_rectified(self) -> bool:
        """No distortion, parallel axes, baseline along rows, and the same focal length and rows in both images."""
        a, c = self.left, self.right
        return bool(
            not (a.has_distortion or c.has_distortion)
            and np.abs(self.R - np.eye(3)).max() < 1e-9
            and np.abs(self.b[1:]).max() < 1e-9 * self.baseline
            and abs(a.fu - c.fu) + abs(a.fv - c.fv) + abs(a.v0 - c.v0) < 1e-9 * a.fu
            and abs(a.fu - a.fv) < 1e-9 * a.fu
        )

    def project(self, points: Array) -> tuple[Array, Array]:
        """Left and right pixels (N, 2) of points (N, 3) [m] in left-camera coordinates; NaN behind a camera."""
        return self.left.project(points), self.right.project((points + self.b) @ self.R.T)

    def project_stereo(self, points: Array, jacobian: bool = True) -> tuple[Array, Array]:
        """Stereo measurements ``(uL, vL, uR)`` (N, 3) and Jacobian (N, 3, 3) by points (N, 3) in left coordinates.

        The right image's row adds only the epipolar check (paper A uses only its x, Eq. 8), so it is no part of the
        measurement. Rows of points behind a camera are NaN. With ``jacobian=False`` the Jacobian is empty.

        Raises:
            CalibrationError: the rig is not rectified.
        """
        from slam.geometry.kernels import project_rectified

        z, J = project_rectified(self.rectified_parameters, np.ascontiguousarray(points, float), jacobian)
        return z, J

    @cached_property
    def rectified_parameters(self) -> Array:
        """What projection by a rectified rig depends on (7,): fu, fv, u0, v0, fu and u0 of the right camera, b_x.

        Raises:
            CalibrationError: the rig is not rectified.
        """
        if not self.is_rectified:
            raise CalibrationError("the cameras are not rectified: take rig.rectified.rig")
        a, c = self.left, self.right
        return np.array([a.fu, a.fv, a.u0, a.v0, c.fu, c.u0, self.b[0]])

    def triangulate(self, uv_left: Array, uv_right: Array) -> Array:
        """Points (N, 3) [m] in left-camera coordinates by paper A, Eqs. (8)-(9).

        The misprints of Eqs. (8b) and (8c) are mended: all three use the right image's x. Rows whose rays are
        parallel, whose depth comes out negative, or whose pixels are NaN are NaN.
        """
        if self.is_rectified:
            from slam.geometry.kernels import triangulate_rectified

            left, right = np.ascontiguousarray(uv_left, float), np.ascontiguousarray(uv_right, float)
            return np.asarray(triangulate_rectified(self.rectified_parameters, left, right))
        rays, x_right = self.left.rays(uv_left), self.right.normalise(uv_right)[:, 0]
        d = self.R @ self.b  # Eq. (9b)
        k = rays @ self.R[0] - x_right * (rays @ self.R[2])  # Eq. (9a)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (x_right * d[2] - d[0]) / k  # Eq. (8c)
            depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
        return rays * depth[:, None]

    def triangulation_covariance(self, points: Array, sigma: float | Array) -> Array:
        """Covariance (N, 3, 3) [m²] of triangulated points (N, 3) for pixel noise `sigma` [px] on uL, vL and uR.

        First order: the inverse of the (3, 3) stereo projection Jacobian carries the noise back. `sigma` is one
        number or (3,) numbers.

        Raises:
            CalibrationError: the rig is not rectified.
        """
        _, J = self.project_stereo(points)
        out = np.full((len(points), 3, 3), np.nan)
        good = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        good[good] = np.linalg.det(J[good]) != 0  # of points so far away that nothing tells their depth: NaN
        inverse = np.linalg.inv(J[good]) * np.broadcast_to(sigma, (3,))
        out[good] = inverse @ np.swapaxes(inverse, 1, 2)
        return out

    def depth_deviation(self, points: Array, sigma: float) -> Array:
        """Standard deviations (N,) [m] of the depths that a rectified rig triangulates; points (N, 3)."""
        with np.errstate(over="ignore"):  # at infinity
            return np.asarray(points[:, 2] ** 2 * (np.sqrt(2.0) * sigma / (self.left.fu * self.baseline)))

    @cached_property
    def rectified(self) -> RectifiedRig:
        """The rectified rig: itself where `is_rectified`, else OpenCV's, with only valid pixels (no black borders).

        Raises:
            CalibrationError: the cameras look so far apart that no common rectified image is left.
        """
        if self.is_rectified:
            return RectifiedRig(self, self, np.eye(3), np.eye(3))
        import cv2

        a, c, size, t = self.left, self.right, (self.width, self.height), (self.R @ self.b).reshape(3, 1)
        if "equidistant" in (a.model, c.model) and a.model != c.model:
            raise CalibrationError("one camera is a fisheye and the other is not: such a pair cannot be rectified")
        fisheye = a.model == "equidistant"
        D_left, D_right = (np.array(camera.distortion or (0.0,) * 4) for camera in (a, c))
        stereo_rectify, options = (cv2.fisheye.stereoRectify, {}) if fisheye else (cv2.stereoRectify, {"alpha": 0})
        try:
            R_left, R_right, P_left, P_right, *_ = stereo_rectify(
                a.K, D_left, c.K, D_right, size, self.R, t, flags=_ZERO_DISPARITY, **options
            )
        except cv2.error as error:
            raise CalibrationError("stereo rig cannot be rectified") from error
        f = float(P_left[0, 0])
        if fisheye:
            # A flat image cannot hold a fisheye's whole view: keep the middle at a useful resolution instead.
            # 0.7: focal length of a fisheye's rectified rig: 2 · atan(0.5 / 0.7 · width / fu) of view
            f = max(f, 0.7 * a.fu)
            P_left[0, 2], P_left[1, 2] = (self.width - 1) / 2, (self.height - 1) / 2
            P_right[0, 2] = P_left[0, 2]
        if not (np.isfinite(P_left).all() and np.isfinite(P_right).all() and 0.05 * a.fu < f < 20 * a.fu):
            reason = size_doubt(a, c) or "the two cameras share no usable view"
            raise CalibrationError(f"stereo rig cannot be rectified: {reason}")
        u0, v0, doffs = float(P_left[0, 2]), float(P_left[1, 2]), float(P_right[0, 2] - P_left[0, 2])
        return RectifiedRig(
            self, StereoRig.rectified_pair(f, u0, v0, self.baseline, self.width, self.height, doffs), R_left, R_right
        )


@dataclass(frozen=True, eq=False)
class RectifiedRig:
    """The rectified rig that sees the same, and the ways between its pixels and the original's.

    Attributes:
        original: the rig as calibrated.
        rig: the rectified rig (same image size).
        R_left, R_right: rotations (3, 3) taking original camera axes to rectified camera axes.
    """

    original: StereoRig
    rig: StereoRig
    R_left: Array
    R_right: Array

    @cached_property
    def T_left_rectified(self) -> Array:
        """Pose (4, 4) of the rectified left camera in the original left camera: a pure rotation."""
        return pose(self.R_left.T, np.zeros(3))

    @cached_property
    def scale(self) -> float:
        """Rectified pixels per original pixel of the left image, on average over it."""
        if self.original is self.rig:
            return 1.0
        u, v = np.meshgrid(*(np.linspace(0.1, 0.9, 9) * size for size in (self.rig.width, self.rig.height)))
        uv = np.stack([u.ravel(), v.ravel()], axis=1)
        right, down = np.array([0.5, 0.0]), np.array([0.0, 0.5])
        du = self.rectify_left(uv + right) - self.rectify_left(uv - right)
        dv = self.rectify_left(uv + down) - self.rectify_left(uv - down)
        return float(np.sqrt(np.nanmean(np.abs(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]))))

    def rectify_left(self, uv: Array) -> Array:
        """Rectified left pixels (N, 2) of original left pixels (N, 2); the same array where the rig is rectified."""
        return self._along_rays(self.original.left, self.rig.left, self.R_left, uv)

    def rectify_right(self, uv: Array) -> Array:
        """Rectified right pixels (N, 2) of original right pixels (N, 2)."""
        return self._along_rays(self.original.right, self.rig.right, self.R_right, uv)

    def unrectify_left(self, uv: Array) -> Array:
        """Original left pixels (N, 2) of rectified left pixels (N, 2)."""
        return self._along_rays(self.rig.left, self.original.left, self.R_left.T, uv)

    def unrectify_right(self, uv: Array) -> Array:
        """Original right pixels (N, 2) of rectified right pixels (N, 2)."""
        return self._along_rays(self.rig.right, self.original.right, self.R_right.T, uv)

    def _along_rays(self, source: PinholeCamera, target: PinholeCamera, R: Array, uv: Array) -> Array:
        """Pixels of `target` that look along the same rays as pixels of `source`, turned by R."""
        return uv if self.original is self.rig else target.project(source.rays(uv) @ R.T)

    @cached_property
    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Tables (2, H, W) for ``cv2.remap``, left and right: columns and rows in the original image."""
        v, u = np.mgrid[: self.rig.height, : self.rig.width]
        grid = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
        pixels = self.unrectify_left(grid), self.unrectify_right(grid)
        left, right = (
            np.nan_to_num(uv.T, nan=-1.0).astype(np.float32, order="C").reshape(2, *u.shape) for uv in pixels
        )
        return left, right


def rig_numbers(rig: StereoRig) -> dict[str, float]:
    """The rectified cameras as delivered, to which all corrections refer, by the names of `NUMBERS` [px], [m]."""
    r = rig.rectified.rig
    values = r.width, r.height, r.left.fu, r.baseline, r.left.u0, r.left.v0, r.right.u0
    return dict(zip(NUMBERS, map(float, values)))


def rig_difference(there: Mapping[str, float], here: Mapping[str, float], share: float = 1e-5) -> str:
    """The first number of two rigs that differs, in words; empty if none does.

    Numbers of one calibration, written and read, differ by less than the default `share` of their size. Only those
    that are in `there` are compared.
    """
    for name, value in there.items():
        if abs(value - here[name]) > share * max(abs(value), abs(here[name])):
            return f"{name} {value:g} there, {here[name]:g} here"
    return ""
