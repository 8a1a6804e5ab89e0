"""Checks that two images are a stereo pair of their rig: not swapped, rows aligned, and disparities not all zero.

The front end cannot tell, as it looks for a feature's match in the same row and to the left only. Here features are
matched anywhere in the image; those that agree on a fundamental matrix (RANSAC) are compared with the rig.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array

_FEATURES = 1000  # guard: features of an image that are matched
_TOLERANCE = 2.0  # guard: [px] from an epipolar line: ORB places features to a pixel or two

_ROWS_AGREE = 1.0  # guard: [px] to which most rows of a rectified pair agree, at ORB's accuracy
_SHOWN = 0.5  # guard: share of what rectification does to rows that images show at least, which are not rectified yet
_SHOWN_PLAIN = 0.9  # guard: the same of cameras that are rectified but for lenses, as no two real ones are

#: Disparities below this count as zero [px].
NO_DISPARITY = _TOLERANCE

_MOVES = 1e-3  # numerics: [px] root mean square, below which a change of rows is rounding
_SAMPLE = 8  # fixed: matches that any fundamental matrix can be made to fit
_SIGMAS = 5.0  # guard: a chance of 3e-7 to be wrong


@dataclass(frozen=True)
class PairGeometry:
    """How the matches of two images fit the rectified rig."""

    matches: int  # that agree with one another
    conclusive: bool = False  # there are more than wrong ones would give by chance; else the other numbers are zero
    as_given: int = 0  # in the same row and with positive disparity, as they must be
    as_swapped: int = 0  # likewise with left and right image exchanged
    at_same_place: int = 0  # at one and the same pixel of both images, as they are, not rectified
    off_rows: int = 0  # whose rows differ, by more than the front end finds reliably
    row_offset: float = 0.0  # median difference of their rows [px]
    along_columns: int = 0  # with a disparity along columns alone, as of images that are turned
    shown: float = 1.0  # share of what rectification does to rows that the images show; 1 where that may be all

    @property
    def swapped(self) -> bool:
        """Most matches fit the rig with the images exchanged, and far fewer as they are."""
        others = max(self.as_given, self.matches - self.as_swapped)
        return self.conclusive and most(self.as_swapped, others)

    def mostly(self, some: int) -> bool:
        """Whether so many are most of the matches."""
        return self.conclusive and most(some, self.matches - some)


class Points(NamedTuple):
    """What is matched of an image."""

    uv: Array  # pixels (N, 2)
    descriptors: NDArray[np.uint8]  # (N, 32), ORB's
    image: NDArray[np.uint8]  # (H, W)


def points_of(image: NDArray) -> Points:
    """Points of a grey image (H, W), uint8."""
    import cv2

    orb = cv2.ORB_create(_FEATURES)  # type: ignore[attr-defined, unused-ignore]
    found, descriptors = orb.detectAndCompute(image, None)
    return Points(np.array([point.pt for point in found], float).reshape(-1, 2), descriptors, image)


def pair_geometry(rig: StereoRig, left: Points, right: Points, rows: float) -> PairGeometry:
    """How the matches of two images fit the rig; `rows` is the largest row difference that it may have [px]."""
    import cv2

    pixels = _matches(left, right)
    if len(pixels[0]) <= _SAMPLE:
        return PairGeometry(len(pixels[0]))
    _, mask = cv2.findFundamentalMat(*pixels, cv2.FM_RANSAC, _TOLERANCE, 0.999)
    inliers = np.zeros(len(pixels[0]), bool) if mask is None else np.asarray(mask).reshape(-1) > 0
    if inliers.sum() <= _by_chance(len(inliers), rig):
        return PairGeometry(int(inliers.sum()))
    a, b = (uv[inliers] for uv in pixels)
    band = max(rows, _TOLERANCE)
    shift, offset = _offsets(rig, a, b)
    shift_swapped, offset_swapped = _offsets(rig, b, a)
    return PairGeometry(
        len(a),
        True,
        int(((shift > _TOLERANCE) & (np.abs(offset) <= band)).sum()),
        int(((shift_swapped > _TOLERANCE) & (np.abs(offset_swapped) <= band)).sum()),
        int((np.abs(b - a).max(axis=1) <= _TOLERANCE).sum()),
        int((np.abs(offset) > band - _TOLERANCE + _ROWS_AGREE).sum()),
        float(np.nanmedian(np.abs(offset))) if np.isfinite(offset).any() else 0.0,
        int(((np.abs(shift) <= _TOLERANCE) & (np.abs(offset) > band)).sum()),
        1.0 if rig.is_rectified else _shown(rig, a, b, left.image, right.image),
    )


def _shown(rig: StereoRig, uv_left: Array, uv_right: Array, left: NDArray, right: NDArray) -> float:
    """Share of what rectification, or its undistortion alone, does to the rows of matches (N, 2) that they show.

    Rows of images that were rectified or undistorted before agree without that. Cameras that are alike distort both
    pixels of a far point alike: what is left is less than ORB's accuracy, so the right pixels are first moved to where
    the image patch is found. 1 where the images may show all.
    """
    import cv2

    own, other = (replace(camera, model="none", distortion=()) for camera in (rig.left, rig.right))
    plain = StereoRig(own, other, rig.R, rig.b)
    a, b = (uv[:, None].astype(np.float32) for uv in (uv_left, uv_right))
    size, flags = (15, 15), cv2.OPTFLOW_USE_INITIAL_FLOW
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(left, right, a, b, winSize=size, maxLevel=0, flags=flags)
    good = (status[:, 0] > 0) & (np.abs(tracked[:, 0] - uv_right).max(axis=1) < _TOLERANCE)
    a, b = uv_left[good], tracked[good, 0].astype(float)
    rectified, level = _offsets(rig, a, b)[1], not plain.is_rectified
    believed, befores = _SHOWN if level else _SHOWN_PLAIN, (b[:, 1] - a[:, 1], _offsets(plain, a, b)[1])
    return min(share_shown(before, rectified, believed, level) for before in befores)


def share_shown(before: Array, after: Array, believed: float, level: bool = False) -> float:
    """Share of the change from row differences `before` to those `after` (N,) [px] that is seen, by least squares.

    1 where it is not certainly less than what is `believed`, or rows do not agree before. Where all rows may be off
    alike, as by a camera that has turned by a tenth of a degree since it was calibrated, changes count but for their
    mean: `level`.
    """
    if not np.nanmedian(np.abs(before)) < _ROWS_AGREE:
        return 1.0
    good = np.minimum(np.abs(before), np.abs(after)) < _TOLERANCE  # NaN is not
    before, change = before[good], (before - after)[good]
    if level and len(change):
        before, change = before - before.mean(), change - change.mean()
    whole = float(change @ change)
    if len(change) <= _SAMPLE or whole < len(change) * _MOVES**2:
        return 1.0
    share = float(change @ before) / whole
    sigma = float(np.sqrt(np.square(before - share * change).mean() / whole))
    return share if share + _SIGMAS * sigma < believed else 1.0


def _offsets(rig: StereoRig, uv_left: Array, uv_right: Array) -> tuple[Array, Array]:
    """Disparities and right less left rows (N,) [px] of pixels (N, 2) in the rectified rig."""
    rectified, cameras = rig.rectified, rig.rectified.rig
    difference = rectified.rectify_right(uv_right) - rectified.rectify_left(uv_left)
    return cameras.right.u0 - cameras.left.u0 - difference[:, 0], difference[:, 1]


def _by_chance(matches: int, rig: StereoRig) -> float:
    """Largest plausible number of wrong matches that agree with a fundamental matrix by chance."""
    share = min(1.0, 2 * _TOLERANCE / min(rig.width, rig.height))
    return _SAMPLE + matches * share + _SIGMAS * float(np.sqrt(matches * share))


def most(some: int, others: int) -> bool:
    """Whether there are significantly more of some than of the others."""
    return some - others > _SIGMAS * np.sqrt(some + others)


def _matches(left: Points, right: Points) -> tuple[Array, Array]:
    """Pixels (N, 2) of points that are each other's best match, wherever they lie."""
    import cv2

    if not (len(left.uv) and len(right.uv)):
        return left.uv[:0], right.uv[:0]
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left.descriptors, right.descriptors)
    return left.uv[[m.queryIdx for m in pairs]], right.uv[[m.trainIdx for m in pairs]]
