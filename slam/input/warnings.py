"""Warnings about suspicious images, time stamps and baselines, each given once, with what to do."""

from __future__ import annotations

import logging
from collections import deque
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np

from slam.data import StereoFeatures, StereoFrame
from slam.errors import CalibrationError, SequenceError
from slam.geometry.camera import baseline_doubt, size_doubt
from slam.geometry.rig import StereoRig
from slam.grey_range import eight_bits, grey_range
from slam.input.grain import grain_doubt
from slam.input.pair import NO_DISPARITY, PairGeometry, Points, most, pair_geometry, points_of
from slam.models import EstimatorModels
from slam.tracks.step import ENOUGH_FEATURES

logger = logging.getLogger("slam.input")

#: Why a frame is no measurement though its images show enough.
REPEATED = "the images are those of the frame before, byte for byte"

#: guard: plausible times between frames [s]: a thousand frames a second to one in ten seconds.
SHORTEST, LONGEST = 1e-3, 10.0

_INTERVALS = 5  # guard: times between frames whose median is tested: single frames may be missing
_POOR = 5  # guard: successive frames that must show too little before a warning
_LAST_LOOK = 1024  # guard: last frame at which the stereo pair is checked
_ALIKE = 0.2  # guard: distance of descriptors of which there is hardly a pair in an image without repeated patterns
_SHIFTS = 2  # guard: frames by which right images are tried to be late or early
_FITS = 0.95  # guard: share of the matches that fit the rig, below which other frames' images are looked at again

Checksum = tuple[int, int]  # of the bytes of the left and the right image

_UNITS = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))


class InputWarnings:
    """Checks the front end's input, and warns once of each thing that looks wrong.

    The front end matches features whose rows differ by `rows` [px] at most.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels, rows: float) -> None:
        self.lines: list[str] = []  # the warnings so far
        self.doubt = ""  # the first of those after which no path can be trusted
        self.repeated = ""  # the warning of repeated images
        self._rig, self._rows = rig, rows
        self._farthest = farthest_apart(rig, models)
        self._stamps: list[float] = []
        self._count = self._poor = self._unpaired = 0
        self._pair_warned = self._pair_is_right = self._moment_is_right = False
        self._texture_warned = self._partners_explained = False
        self._two_images = self._copy_warned = False  # a pair of different images was seen, a copy was named
        self._last: Checksum | None = None  # of the frame before
        self._last_copy = ""  # why its right image was a copy
        self._before: deque[_Images] = deque(maxlen=_SHIFTS)  # the frames before, the last one first
        self._fits = np.zeros(1 + 2 * _SHIFTS, int)  # matches if right images are a frame late, early, two late, …
        self._level = 0  # of the same frames, if rows are shifted
        self._grain_warned = False
        for unlikely in filter(None, (baseline_doubt(rig.baseline), size_doubt(rig.left, rig.right))):
            self._warn(unlikely, no_path=True)
            self._pair_warned = self._partners_explained = True  # and what follows from it is not

    def look(self, frame: StereoFrame, features: StereoFeatures) -> None:
        """Check a frame and the features found in it, which are as documented.

        Raises SequenceError, with nothing changed, where left and right are exchanged for certain: no pair before was
        right, features fit the rig the other way round, and hardly any has a right match as it is.
        """
        own, images = None, _Images(frame, self._rig)
        looked_at = self._count & (self._count - 1) == 0 and self._count <= _LAST_LOOK  # 0, 1, 2, 4 …
        if looked_at and not self._grain_warned and (grain := grain_doubt(frame.left)):
            self._grain_warned = True
            self._warn(grain)
        if looked_at and not self._pair_warned:
            own = self._geometry(images, images)
            unpaired = 10 * int(features.has_stereo.sum()) < len(features)
            if own is not None and not self._pair_is_right and own.swapped and unpaired:
                raise SequenceError(_swapped(own))
        if len(self._stamps) <= _INTERVALS:
            self._stamps.append(features.stamp)
            if len(self._stamps) > _INTERVALS:
                self._check_intervals(float(np.median(np.diff(self._stamps))))
        if not self._texture_warned:
            self._check_texture(frame.left, len(features))
        if own is not None:
            self._check_pair(images, own)
        if not self._partners_explained and frame.right is not None:
            self._check_partners(features)
        self._before.appendleft(images)
        self._count += 1

    def _check_intervals(self, interval: float) -> None:
        """Warn of stamps in another unit, and of frames too far apart in time to predict the motion between."""
        if not 0 < interval < float("inf"):
            return  # a step refuses them
        if not SHORTEST <= interval <= LONGEST:
            guess = next((unit for unit, size in _UNITS if interval * size <= LONGEST), _UNITS[-1][0])
            what = f" (are they in {guess}?)" if interval > LONGEST else ""
            self._warn(f"stamps are {interval:.3g} s apart{what}: give them in seconds")
        elif interval > self._farthest:
            self._warn(
                f"frames are {interval:.3g} s apart: in that time a camera can turn so far that it sees nothing of "
                f"the frame before; use {1 / self._farthest:.2g} frames per second or more"
            )

    def _check_texture(self, image: np.ndarray, features: int) -> None:
        """Warn if images show nothing for several frames."""
        self._poor = self._poor + 1 if features < ENOUGH_FEATURES else 0
        if self._poor >= _POOR:
            self._texture_warned = True
            low, high = grey_range(image)
            self._warn(
                f"the images show hardly anything to follow ({features} features in frame {self._count}, grey values "
                f"from {low:.0f} to {high:.0f} of {np.iinfo(image.dtype).max}): more light, sharper focus, shorter "
                "exposure, or a view with more texture"
            )

    def _check_partners(self, features: StereoFeatures) -> None:
        """Warn if hardly any left feature has a right match, for several frames."""
        stereo = int(features.has_stereo.sum())
        self._unpaired = self._unpaired + 1 if len(features) >= 2 * ENOUGH_FEATURES and stereo < ENOUGH_FEATURES else 0
        if self._unpaired < _POOR:
            return
        self._partners_explained = True
        alike = features.descriptors @ features.descriptors.T > 1 - 0.5 * _ALIKE**2
        apart = np.abs(features.uv_left[:, None] - features.uv_left[None]).max(axis=2) > features.scale[:, None]
        doubles = int((alike & apart).any(axis=1).sum())
        cause = (
            ": check that the images are of two cameras at one moment, the left one first, and that the calibration is "
            "theirs"
        )
        if 2 * doubles > len(features):
            cause = (
                f", because the view is a repeated pattern: {doubles} of them have a look-alike in the same image, so "
                "that which belong together cannot be told; let the view show other things too"
            )
        self._warn(
            f"only {stereo} of {len(features)} features of frame {self._count} are found in the right image{cause}"
        )

    def _check_pair(self, images: _Images, own: PairGeometry) -> None:
        """Warn if left and right image look swapped or the same, are of different moments, or rows do not match."""
        if not self._pair_is_right and (own.swapped or own.same):
            self._pair_warned = True
            horizon = self._rig.rectified.rig.left.fu * self._rig.baseline / NO_DISPARITY
            same = (
                f"left and right image show the same: {own.at_same_place} of {own.matches} features have no "
                f"disparity; this is one image twice, or nothing in view is nearer than {horizon:.0f} m"
            )
            self._warn(_swapped(own) if own.swapped else same, no_path=True)
        elif not self._pair_is_right and self._before and own.shown < 1:
            if len(self._before) == _SHIFTS:  # hardly a feature fits then, and of another moment's some may by chance
                self._pair_warned = True
                self._warn(self._rows_differ(images, own), no_path=True)
        elif self._before and (not self._moment_is_right or own.as_given < _FITS * own.matches):
            self._check_moment(images, own)
        self._partners_explained |= self._pair_warned  # the reason is known then

    def _check_moment(self, images: _Images, own: PairGeometry) -> None:
        """Warn if left images fit the right ones of other frames, or else if rows do not match."""
        others = [self._geometry(*pair) for other in self._before for pair in ((other, images), (images, other))]
        fits = [other.as_given for other in others if other is not None]
        if len(fits) == len(others):
            self._fits[: 1 + len(fits)] += [own.as_given, *fits]
            self._level += own.level
        fit, *shifted = self._fits.tolist()
        if most(max(shifted), fit) and not most(self._level, max(shifted)):
            self._pair_warned = True
            at = int(np.argmax(shifted))
            which, wrong = ("after", "early") if at % 2 else ("before", "late")
            frames, number = ("a frame", "one") if at < 2 else ("two frames", "two")
            since = "left and right image are not of one moment" + ", though they were" * self._moment_is_right
            self._warn(
                f"{since}: {max(shifted)} features fit the rig with the left image {frames} {which}, {fit} with that "
                f"of the same frame, {self._count}; the right images are {frames} too {wrong}: pair them by their "
                f"times, or shift their numbers by {number}",
                no_path=True,
            )
            return
        if all(most(fit, other) for other in shifted):
            self._moment_is_right = True
            self._fits[:] = self._level = 0  # what comes later is counted anew
        if own.conclusive and not self._pair_is_right and (not own.rows_differ or len(self._before) == _SHIFTS):
            self._pair_is_right = True
            if own.rows_differ:
                self._pair_warned = True
                self._warn(self._rows_differ(images, own), no_path=True)

    def _rows_differ(self, images: _Images, own: PairGeometry) -> str:
        """That rows do not agree, and the likely cause."""
        rig = self._rig
        if not rig.is_rectified and images.left is not None and images.right is not None:
            with suppress(CalibrationError):
                inverse = pair_geometry(replace(rig, R=rig.R.T), images.left, images.right, self._rows)
                if not inverse.rows_differ and most(inverse.as_given, own.as_given):
                    return (
                        f"rows of left and right image agree with the inverse of the calibration's rotation, "
                        f"{inverse.as_given} features, and {own.as_given} as it is: is R transposed, or from the right "
                        "camera to the left one?"
                    )
        return _rows_differ(own, rig)

    def _geometry(self, left: _Images, right: _Images) -> PairGeometry | None:
        """How one frame's left image fits another's right one; None where an image is missing or unusable."""
        if left.left is None or right.right is None:
            return None
        try:
            return pair_geometry(self._rig, left.left, right.right, self._rows)
        except CalibrationError:  # the rig cannot be rectified: a front end may not need that
            self._pair_warned = True
            return None

    def copied(self, frame: StereoFrame, checksum: Checksum | None) -> tuple[Checksum | None, str]:
        """Why the right image is a copy, which measures nothing (empty if it is none), and the frame's checksum.

        A copy is equal, byte for byte, to the left image, or to the right one of the frame before. A left image that is
        that of the frame before makes the frame a repeated one, whatever the right one is: its checksum is that of the
        frame before. Nothing is changed until `used`. Raises SequenceError where left and right are equal, and there
        was no pair before: it is one camera twice.
        """
        last = self._last
        if checksum is None or not shows_something(frame.right):
            return checksum, ""
        if checksum[0] == checksum[1]:
            copy = "left and right are one and the same image"
            if not self._two_images:
                raise SequenceError(f"frame {frame.index}: {copy}: two cameras are needed (see left=… and right=…)")
            return checksum, copy
        if last is None or checksum == last:
            return checksum, self._last_copy
        if checksum[0] == last[0]:
            return last, ""
        frozen = "the right image is that of the frame before: its camera froze, or has a lower frame rate"
        return checksum, frozen if checksum[1] == last[1] else ""

    def used(self, frame: StereoFrame, checksum: Checksum | None, copy: str) -> None:
        """Take note of a frame, as it was given, that is used; `checksum` and `copy` are the answer of `copied`."""
        self._two_images |= checksum is not None and shows_something(frame.right)
        if checksum != self._last:
            self._last, self._last_copy = checksum, copy
        if copy and not self._copy_warned:
            self._copy_warned = True
            self._warn(f"frame {frame.index}: {copy}; it and others like it are used without the right image")

    def note_repeated(self, number: int) -> None:
        """Warn of a frame with the images of the frame before, by its number in its sequence."""
        if not self.repeated:
            self.repeated = (
                f"frame {number}: {REPEATED}: the camera froze or its driver gave them twice; such frames are no "
                "measurements (simulated images need noise)"
            )
            logger.warning("%s", self.repeated)

    def _warn(self, line: str, no_path: bool = False) -> None:
        self.lines.append(line)
        self.doubt = self.doubt or (line if no_path else "")
        logger.warning("%s", line)


def _swapped(found: PairGeometry) -> str:
    return (
        f"left and right look swapped: {found.as_swapped} of {found.matches} features fit the cameras when the images "
        f"are exchanged, {found.as_given} as they are; exchange them with the option swap=yes, or leave it out"
    )


def _rows_differ(found: PairGeometry, rig: StereoRig) -> str:
    """That rows do not agree, and the likely cause: images that were rectified twice, or never."""
    if found.turned:
        cause = "the images are turned by 90°, or the cameras stand above each other: turn both, or calibrate them so"
    elif not (rig.left.has_distortion or rig.right.has_distortion or np.abs(rig.R - np.eye(3)).max() > 1e-9):
        cause = "were they rectified, as this calibration says (no distortion or rotation), and are they of one moment?"
    elif found.shown < 1:
        return (
            f"rows of left and right image show {100 * max(found.shown, 0.0):.0f} % of what the calibration's "
            "rectification does to rows: the images were rectified before, or undistorted, and are again; give the "
            "calibration after that, or leave the distortion out"
        )
    else:
        cause = "check that the calibration is this camera's, at this size"
    return (
        f"rows of left and right image do not agree: {found.off_rows} of {found.matches} features are off by "
        f"{found.row_offset:.1f} px in the median; {cause}"
    )


def farthest_apart(rig: StereoRig, models: EstimatorModels) -> float:
    """Time between frames [s] after which the prediction's rotation error (1σ) moves a feature by half an image.

    The angular velocity changes by ``density · √Δt`` in Δt, and the rotation by that times Δt.
    """
    half_view = float(np.arctan(0.5 * rig.width / rig.left.fu))
    return float((half_view / models.motion.angular_acceleration) ** (2 / 3))


def shows_something(image: object) -> bool:
    """Whether this is an array of numbers that are not all the same; others the front end refuses."""
    if not isinstance(image, np.ndarray) or image.dtype.kind not in "uif" or not image.size:
        return False
    return bool(image.min() != image.max())


class _Images:
    """The points of a frame's images, found once, when they are asked for.

    They are None where an image is missing or unusable: the front end refuses it, or has a format of its own.
    """

    def __init__(self, frame: StereoFrame, rig: StereoRig) -> None:
        self._frame, self._size = frame, (rig.height, rig.width)

    @cached_property
    def left(self) -> Points | None:
        return self._points(self._frame.left)

    @cached_property
    def right(self) -> Points | None:
        return self._points(self._frame.right)

    def _points(self, image: np.ndarray | None) -> Points | None:
        import cv2

        if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16):
            return None
        if image.shape[:2] != self._size or image.shape[2:] not in ((), (1,), (3,), (4,)):
            return None
        if image.ndim == 3:
            one = image.shape[2] == 1
            image = image[:, :, 0] if one else np.asarray(cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY))
        return points_of(np.ascontiguousarray(eight_bits(image)))
