"""One pinhole camera with lens distortion: projection, and the way back (paper A, Eq. 5)."""

from __future__ import annotations

import numbers
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.errors import CalibrationError
from slam.geometry.se3 import Array

#: Distortion models and the number of coefficients each accepts.
DISTORTION_MODELS = {"none": (0,), "radtan": (4, 5, 8), "equidistant": (4,)}

_NEAREST = 1e-9  # numerics: no depth up to this [m] is projected

_WIDEST = 100_000  # guard: width or height [px]


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole camera with distortion (paper A, Eq. 5 with its misprint mended: ``I_x = u0 + f_u h_x / h_z``).

    Attributes:
        fu, fv: focal lengths [px].
        u0, v0: principal point [px]; the centre of the first pixel is (0, 0).
        width, height: image size [px].
        model: ``"none"``, ``"radtan"`` (Brown-Conrady: k1, k2, p1, p2[, k3[, k4, k5, k6]], OpenCV's order) or
            ``"equidistant"`` (Kannala-Brandt fisheye: k1..k4).
        distortion: its coefficients.

    Raises:
        CalibrationError: a value is not finite, a focal length or size is not positive, or the number of
            distortion coefficients does not fit the model.
    """

    fu: float
    fv: float
    u0: float
    v0: float
    width: int
    height: int
    model: str = "none"
    distortion: tuple[float, ...] = field(default=())

    def __post_init__(self) -> None:
        if not isinstance(self.distortion, (tuple, list, np.ndarray)):
            raise CalibrationError(f"distortion must be a tuple of coefficients, got {type(self.distortion).__name__}")
        values = (self.fu, self.fv, self.u0, self.v0, *self.distortion)
        if not all(isinstance(v, numbers.Real) for v in (*values, self.width, self.height)):
            raise CalibrationError(f"camera calibration is not of numbers: {values}")
        if not all(-1e9 <= v <= 1e9 for v in values):  # 1e9: of a calibration's numbers
            raise CalibrationError(f"camera calibration is not finite, or impossibly large: {values}")
        if self.fu <= 0 or self.fv <= 0:
            raise CalibrationError(f"focal lengths must be positive, got fu={self.fu}, fv={self.fv}")
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(f"image size must be positive, got {self.width}x{self.height}")
        if not (self.width <= _WIDEST and self.height <= _WIDEST):
            raise CalibrationError(f"image size must be at most {_WIDEST}, got {self.width}x{self.height}")
        if not isinstance(self.model, str) or self.model not in DISTORTION_MODELS:
            raise CalibrationError(f"unknown distortion model {self.model!r}: {', '.join(DISTORTION_MODELS)}")
        if len(self.distortion) not in DISTORTION_MODELS[self.model]:
            raise CalibrationError(
                f"distortion model {self.model!r} takes {DISTORTION_MODELS[self.model]} coefficients, "
                f"got {len(self.distortion)}"
            )

    @classmethod
    def from_matrix(
        cls, K: ArrayLike, D: ArrayLike | None, size: tuple[int, int], fisheye: bool = False
    ) -> PinholeCamera:
        """A camera by OpenCV's camera matrix and distortion coefficients.

        Args:
            K: camera matrix (3, 3) [px].
            D: coefficients in OpenCV's order, as many as there are; None for none.
            size: width and height [px].
            fisheye: they are those of ``cv2.fisheye``.

        Raises:
            CalibrationError: K is no camera matrix, or there are coefficients that are not supported.
        """
        matrix, coefficients = floats("camera matrix", K), floats("distortion", D if D is not None else ()).ravel()
        if matrix.shape != (3, 3):
            raise CalibrationError(f"the camera matrix must be (3, 3), got {matrix.shape}")
        if not is_camera_matrix(matrix):
            raise CalibrationError(f"no camera matrix [fx 0 cx; 0 fy cy; 0 0 1]: {matrix.tolist()}")
        if 0 < len(coefficients) < 4:
            raise CalibrationError(f"OpenCV's distortion has at least 4 coefficients, got {len(coefficients)}")
        values = coefficients.tolist()
        while len(values) > 8 and values[-1] == 0:
            values.pop()
        if len(values) > 8:
            raise CalibrationError(
                f"{len(values)} distortion coefficients: thin prisms and tilted sensors are not supported"
            )
        values += [0.0] * (next(n for n in (0, 4, 5, 8) if n >= len(values)) - len(values))
        model = "equidistant" if fisheye else "radtan" if any(values) else "none"
        if fisheye and not values:
            values = [0.0] * 4
        distortion = () if model == "none" else tuple(values)
        return cls(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *size, model, distortion)

    def turned(self, turns: int) -> PinholeCamera:
        """The camera of images that are turned so many quarters anticlockwise, as ``numpy.rot90`` does."""
        if turns % 4 == 0:
            return self
        D = list(self.distortion)
        if self.model == "radtan":
            D[2:4] = -D[3], D[2]
        once = PinholeCamera(
            self.fv, self.fu, self.v0, self.width - 1 - self.u0, self.height, self.width, self.model, tuple(D)
        )
        return once.turned(turns % 4 - 1)

    @property
    def K(self) -> Array:
        """Camera matrix (3, 3)."""
        return np.array([[self.fu, 0, self.u0], [0, self.fv, self.v0], [0, 0, 1.0]])

    @property
    def has_distortion(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return self.model == "equidistant" or any(c != 0 for c in self.distortion)

    def project(self, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 3) [m] in camera coordinates; NaN for points not in front of the camera."""
        points = np.ascontiguousarray(points, float).reshape(-1, 3)
        if self.model == "equidistant":
            ab = points[:, :2] / np.where(points[:, 2:] > _NEAREST, points[:, 2:], np.nan)
            return np.asarray(self._distort_fisheye(ab) * (self.fu, self.fv) + (self.u0, self.v0))
        from slam.geometry import kernels

        return np.asarray(kernels.project(points, *self._lens, _NEAREST))

    def normalise(self, uv: Array) -> Array:
        """Undistorted normalised coordinates (N, 2) = (x/z, y/z) of pixels (N, 2); NaN stays NaN."""
        uv = np.asarray(uv, float).reshape(-1, 2)
        distorted = (uv - (self.u0, self.v0)) / (self.fu, self.fv)
        return self._undistort(distorted) if self.has_distortion and len(uv) else distorted

    def rays(self, uv: Array) -> Array:
        """Rays (N, 3) = (x/z, y/z, 1) of pixels (N, 2)."""
        return np.concatenate([self.normalise(uv), np.ones((len(uv), 1))], axis=1)

    def in_image(self, uv: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which pixels (N, 2) lie inside the image, `margin` [px] away from its border; NaN lies outside."""
        u, v = uv[:, 0], uv[:, 1]
        with np.errstate(invalid="ignore"):
            inside = (u >= margin) & (v >= margin)
            return inside & (u <= self.width - 1 - margin) & (v <= self.height - 1 - margin)

    def in_view(self, points: Array) -> NDArray[np.bool_]:
        """Which points (N, 3) are in the angle of view: in front and inside the image (paper A, Fig. 3)."""
        return self.in_image(self.project(points))

    def _distort_fisheye(self, ab: Array) -> Array:
        """Distorted normalised coordinates (N, 2) of a fisheye."""
        import cv2

        lens = np.array(self.distortion)
        return np.asarray(cv2.fisheye.distortPoints(ab[:, None], np.eye(3), lens)[:, 0]) if len(ab) else ab

    @cached_property
    def _lens(self) -> tuple[Array, bool, Array, float]:
        """What compiled code projects by: (fu, fv, u0, v0), whether rays are distorted, coefficients, and the limit."""
        pinhole = np.array([self.fu, self.fv, self.u0, self.v0], float)
        return pinhole, self.has_distortion, self._coefficients, self._radius_limit

    @cached_property
    def _coefficients(self) -> Array:
        """Of the Brown-Conrady model (8,), those that are not given are zero."""
        return np.array([*self.distortion, *[0.0] * (8 - len(self.distortion))], float)

    @cached_property
    def _radius_limit(self) -> float:
        """Undistorted radius up to which the radial distortion grows with the radius."""
        if self.model == "equidistant":
            return np.inf
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        r = np.linspace(0, 5, 2001)
        r2 = r * r
        distorted = r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        falling = np.diff(distorted) <= 0
        return float(r[np.argmax(falling)]) if falling.any() else np.inf

    def _undistort(self, target: Array) -> Array:
        """Normalised coordinates (N, 2) of distorted ones; NaN where no ray leads to the pixel."""
        if self.model == "equidistant":
            import cv2

            until, lens = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-13), np.array(self.distortion)
            ab = cv2.fisheye.undistortPoints(target[:, None], np.eye(3), lens, criteria=until)[:, 0]
            off = np.abs(self._distort_fisheye(ab) - target).max(axis=1, keepdims=True)
            return np.where(off < 1e-9, ab, np.nan)  # 1e-9: of rays 90° or more off the axis OpenCV gives others
        from slam.geometry import kernels

        return np.asarray(kernels.undistort(np.ascontiguousarray(target), self._coefficients, self._radius_limit))


#: guard: largest skew as a share of the focal length: a thousandth moves the image's border by half a pixel.
_SKEW = 1e-3


def is_camera_matrix(K: Array) -> bool:
    """Whether K (3, 3) is ``[fx 0 cx; 0 fy cy; 0 0 1]``."""
    return bool(abs(K[0, 1]) <= _SKEW * abs(K[0, 0]) and K[1, 0] == 0 and (K[2] == (0, 0, 1)).all())


#: guard: plausible baselines [m]; others are more often a length in another unit.
_SHORTEST, _LONGEST = 0.005, 10.0

_USUAL = (0.02, 2.0)  # guard: baselines [m] that a unit is proposed for

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # of a calibration's lengths, by the option unit [m]


def baseline_doubt(baseline: float) -> str:
    """What is wrong with an implausible baseline; empty if it is plausible."""
    if _SHORTEST <= baseline <= _LONGEST:
        return ""
    return f"the cameras are {baseline:g} m apart by their calibration: is it in metres?{in_units(baseline)}"


def in_units(baseline: float) -> str:
    """What each unit makes of a baseline that was read as metres, and how to give it; empty where none is usual."""
    metres = {unit: baseline * size for unit, size in UNITS.items() if unit != "m"}
    likely = [f"unit={unit} makes it {m:.3g} m" for unit, m in metres.items() if _USUAL[0] <= m <= _USUAL[1]]
    which = "" if len(likely) == 1 else "; measure which is right"
    return f" (of numbers read as metres, {', '.join(likely)}{which}; in Python scale T)" if likely else ""


#: guard: Largest distance of a principal point from the middle of an image, as a share of half its width or height, and
#: the same of one that is off to the same side in all directions and cameras, as with images of another size. Right
#: ones scatter by about 0.04, and those of a rectified pair are two numbers, not four.
_OFF, _OFF_ALIKE = 0.3, 0.1
_OBLONG = 0.1  # guard: largest difference of the focal lengths along rows and columns, as a share: pixels are square
_NOT_SQUARE = 0.03  # guard: the same that digital cameras do not have; analog video has 0.07 to 0.09


def size_doubt(left: PinholeCamera, right: PinholeCamera) -> str:
    """What is wrong with a principal point far from the middle, or pixels that are not square; empty for neither."""
    cameras = {"left": left, "right": right}
    shares = {side: off_middle(camera) for side, camera in cameras.items()}
    every = np.concatenate(list(shares.values()))
    alike = bool(every.min() > _OFF_ALIKE or every.max() < -_OFF_ALIKE)
    for side, camera in cameras.items():
        if abs(camera.fu / camera.fv - 1) > _OBLONG:
            return (
                f"the focal lengths of the {side} camera, {camera.fu:.0f} px along rows and {camera.fv:.0f} px along "
                "columns, differ, but pixels are square: is one of them mistyped, or were images scaled in one way?"
            )
        if alike or np.abs(shares[side]).max() > _OFF:
            said = (
                f"the principal point of the {side} camera, ({camera.u0:.0f}, {camera.v0:.0f}) px, is far from the "
                f"middle of the images, ({camera.width / 2:.0f}, {camera.height / 2:.0f}) px: "
            )
            if shares[side].min() > -1 and np.ptp(shares[side]) < _OFF_ALIKE * (1 + shares[side].mean()):
                return said + (
                    f"the calibration is for images of about {2 * camera.u0:.0f}x{2 * camera.v0:.0f} px, "
                    f"{1 + shares[side].mean():.2g} times the size of these, or these were cropped"
                )
            return said + "were they cropped or turned, or is the calibration for others, or cx and cy exchanged?"
    return ""


def oblong(*cameras: PinholeCamera) -> str:
    """What to ask of cameras whose pixels are not square, as few are, or whose images may have been scaled in one way.

    Empty where nothing says so: principal points are as near to the middle along rows as along columns.
    """
    shares = [camera.fu / camera.fv - 1 for camera in cameras]
    share = min(shares, key=abs)  # where one alone is odd, rows disagree, which says more
    if abs(share) > _NOT_SQUARE:
        return (
            f"by the calibration the focal lengths along rows and columns differ by {100 * abs(share):.0f} %: pixels "
            "of digital cameras are square; is one mistyped, or were images scaled in one way?"
        )
    off = np.array([off_middle(camera) for camera in cameras])
    for name, one, other in (("width", off[:, 0], off[:, 1]), ("height", off[:, 1], off[:, 0])):
        if np.abs(one).min() > _OFF_ALIKE and np.ptp(one) < _OFF_ALIKE and np.abs(other).max() < _OFF_ALIKE / 2:
            return (
                f"the principal points are at {50 * (1 + one.mean()):.0f} % of the images' {name}, and in the middle "
                "the other way: were images scaled or cut in one way alone, and the calibration is for others?"
            )
    return ""


def off_middle(camera: PinholeCamera) -> Array:
    """How far the principal point is from the middle of the images (2,), in halves of their width and height."""
    return np.array([2 * camera.u0 / (camera.width - 1), 2 * camera.v0 / (camera.height - 1)]) - 1


def floats(what: str, values: ArrayLike | None) -> Array:
    """An array of numbers.

    Raises:
        CalibrationError: the values are none.
    """
    try:
        return np.array(values, float)
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"{what} must be numbers") from None
