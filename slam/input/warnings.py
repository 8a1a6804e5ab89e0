"""Warnings about suspicious images, time stamps and baselines, each given once, with what to do."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace

import numpy as np

from slam.data import StereoFeatures, StereoFrame
from slam.errors import CalibrationError, SequenceError
from slam.geometry.camera import baseline_doubt, oblong, size_doubt
from slam.geometry.rig import StereoRig
from slam.grey_range import eight_bits, grey_range
from slam.input.grain import grain_doubt
from slam.input.moment import ONE_MOMENT
from slam.input.pair import NO_DISPARITY, PairGeometry, Points, most, pair_geometry, points_of
from slam.models import EstimatorModels
from slam.tracks.step import ENOUGH_FEATURES

logger = logging.getLogger("slam.input")

#: Why a frame is no measurement though its images show enough.
REPEATED = "the images are those of the frame before"

#: guard: plausible times between frames [s]: a thousand frames a second to one in ten seconds.
SHORTEST, LONGEST = 1e-3, 10.0

_LEAP = 900.0  # guard: time between frames [s] from which on the clock may have been set: by time zones, at least

_INTERVALS = 5  # guard: times between frames whose median is tested: single frames may be missing
_POOR = 5  # guard: successive frames that must show too little before a warning
_LAST_LOOK = 1024  # guard: last frame at which the stereo pair is checked
_ALIKE = 0.2  # guard: distance of descriptors of which there is hardly a pair in an image without repeated patterns

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
        # Time between frames [s] after which the prediction's rotation error (1σ) moves a feature by half an image: the
        # angular velocity changes by ``density · √Δt`` in Δt, and the rotation by that times Δt.
        half_view = float(np.arctan(0.5 * rig.width / rig.left.fu))
        self._farthest = (half_view / models.motion.angular_acceleration) ** (2 / 3)
        self._stamps: list[float] = []  # of the first frames
        self._last_stamp, self._leapt = np.inf, False  # whether that was said, or what explains it
        self._count = self._poor = self._unpaired = 0
        self._pair_warned = self._pair_is_right = False
        self._texture_warned = self._partners_explained = False
        self._two_images = self._copy_warned = False  # a pair of different images was seen, a copy was named
        self._before: StereoFrame | None = None  # the frame before, until a pair was right
        self._last: Checksum | None = None  # of the frame before
        self._last_copy = ""  # why its right image was a copy
        self._grain_warned = False
        if unit := baseline_doubt(rig.baseline):
            self._warn(unit, no_path=True)
            self._pair_warned = self._partners_explained = True  # and what follows from it is not
        if size := size_doubt(rig.left, rig.right):
            self._warn(size)  # whether there is a path the images show: `slam.calibration`
            self._partners_explained = True
        if not self.lines and (odd := oblong(rig.left, rig.right)):
            self._warn(odd)

    def look(self, frame: StereoFrame, features: StereoFeatures) -> None:
        """Check a frame and the features found in it, which are as documented.

        Raises SequenceError, with nothing changed, where left and right are exchanged for certain: no pair before was
        right, features fit the rig the other way round, and hardly any has a right match as it is.
        """
        looked_at = self._count & (self._count - 1) == 0 and self._count <= _LAST_LOOK  # 0, 1, 2, 4 …
        if looked_at and not self._grain_warned and (grain := grain_doubt(frame.left)):
            self._grain_warned = True
            self._warn(grain)
        if looked_at and not self._pair_warned:
            self._check_pair(frame, features)
        self._before = None if self._pair_is_right or self._pair_warned else frame
        leap, self._last_stamp = features.stamp - self._last_stamp, features.stamp
        what = f"frame {frame.index}: its stamp is"
        if len(self._stamps) <= _INTERVALS:  # whose median tells the unit
            self._stamps.append(features.stamp)
            intervals, leap = np.diff(self._stamps), 0.0
            if len(self._stamps) > _INTERVALS:
                self._check_intervals(float(np.median(intervals)))
                leap, what = float(intervals.max()), f"before frame {frame.index}: a stamp is"
        if leap >= _LEAP and not self._leapt:
            self._leapt = True
            self._warn(
                f"{what} {leap:.4g} s after that of the frame before: if the clock was set there, correct the stamps; "
                "else nothing is known of the motion in that time"
            )
        if not self._texture_warned:
            self._check_texture(frame.left, len(features))
        if not self._partners_explained and frame.right is not None:
            self._check_partners(features)
        self._count += 1

    def _check_intervals(self, interval: float) -> None:
        if not 0 < interval < float("inf"):
            return  # a step refuses them
        if not SHORTEST <= interval <= LONGEST:
            self._leapt = True
            guess = next((unit for unit, size in _UNITS if interval * size <= LONGEST), _UNITS[-1][0])
            what = f" (are they in {guess}?)" if interval > LONGEST else ""
            self._warn(f"stamps are {interval:.3g} s apart{what}: give them in seconds")
        elif interval > self._farthest:
            self._warn(
                f"frames are {interval:.3g} s apart: in that time a camera can turn so far that it sees nothing of "
                f"the frame before; use {1 / self._farthest:.2g} frames per second or more"
            )

    def _check_texture(self, image: np.ndarray, features: int) -> None:
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

    def _check_pair(self, frame: StereoFrame, features: StereoFeatures) -> None:
        """Warn if left and right image look swapped, mirrored or the same, or rows do not match.

        Where half of the features have a right pixel, in images that are rectified, they are a pair.
        """
        stereo = int(features.has_stereo.sum())
        if 2 * stereo >= max(len(features), ENOUGH_FEATURES) and (self._rig.is_rectified or self._pair_is_right):
            self._pair_is_right = True
            return
        left, right = (_points(image, self._rig) for image in (frame.left, frame.right))
        if left is None or right is None:
            return
        try:
            own = pair_geometry(self._rig, left, right, self._rows)
        except CalibrationError:  # the rig cannot be rectified: a front end may not need that
            self._pair_warned = True
            return
        if not self._pair_is_right and own.swapped and 10 * stereo < len(features):
            raise SequenceError(_swapped(own))
        said = ""
        if not self._pair_is_right and own.swapped:
            said = _swapped(own)
        elif not self._pair_is_right and own.mostly(own.at_same_place):
            horizon = self._rig.rectified.rig.left.fu * self._rig.baseline / NO_DISPARITY
            said = (
                f"left and right image show the same: {own.at_same_place} of {own.matches} features have no "
                f"disparity; this is one image twice, or nothing in view is nearer than {horizon:.0f} m"
            )
        elif 4 * stereo < len(features) and not most(own.as_given, own.matches - own.as_given):
            said = self._mirrored(left, right, own)
        if not said and (own.mostly(own.off_rows) or (own.shown < 1 and not self._pair_is_right)):
            if self._before is None and not self._pair_is_right:
                return  # until there is a frame before, of whose moment one of the images may be
            said = self._explained(left, right, own) or _rows_differ(own, self._rig)
        self._pair_is_right |= own.conclusive
        if said:
            self._pair_warned = self._partners_explained = True  # the reason is known then
            self._warn(said, no_path=True)

    def _mirrored(self, left: Points, right: Points, own: PairGeometry) -> str:
        """That far more features are found in the mirrored right image, where they are."""
        flipped = pair_geometry(self._rig, left, points_of(np.ascontiguousarray(right.image[:, ::-1])), self._rows)
        if not (flipped.conclusive and most(flipped.matches, own.matches)):
            return ""
        return (
            f"one of the images looks mirrored: {flipped.matches} features are found in the mirrored right image, and "
            f"{own.matches} in it as it is; give both images as their cameras see"
        )

    def _explained(self, left: Points, right: Points, own: PairGeometry) -> str:
        """What makes rows agree best, where something does: another moment of one image, or the rotation's inverse."""
        rig, before = self._rig, self._before
        was = (None, None) if before is None else (_points(before.left, rig), _points(before.right, rig))
        tried = [
            (was[0], right, rig, "where right images are taken to come a frame late"),
            (left, was[1], rig, "where right images are taken to come a frame early"),
        ]
        if not rig.is_rectified:
            tried.append((left, right, replace(rig, R=rig.R.T), "with the inverse of the calibration's rotation"))
        best, said = 1.0, ""
        for one, two, other, how in tried:
            with suppress(CalibrationError):
                found = pair_geometry(other, one, two, self._rows) if one and two else PairGeometry(0)
                agree, share = found.mostly(found.matches - found.off_rows), found.off_rows / max(found.matches, 1)
                if agree and share < best and most(own.off_rows, found.off_rows):
                    best, said = share, f"{found.off_rows} of {found.matches} {how}"
        cause = f"left and right image are not of one moment ({ONE_MOMENT}), or the two cameras' K and D are exchanged"
        if "inverse" in said:
            cause = (
                "is R transposed, or from the right camera to the left one, are the images not of one moment, or were "
                "they rectified before?"
            )
        return said and f"rows of {own.off_rows} of {own.matches} features differ, and {said}; {cause}"

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
                f"frame {number}: {REPEATED}: the camera froze, or its driver or a video's frame rate gave them twice; "
                "such frames are no measurements (simulated images need noise)"
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
    left, right = rig.left, rig.right
    lenses, share = left.has_distortion or right.has_distortion, 100 * found.shown
    plain = not lenses and np.abs(rig.R - np.eye(3)).max() <= 1e-9
    differ = (
        f"rows of left and right image do not agree: {found.off_rows} of {found.matches} features are off by "
        f"{found.row_offset:.1f} px in the median"
    )
    if found.mostly(found.along_columns):
        cause = "the images are turned by 90°, or the cameras stand above each other: turn both, or calibrate them so"
        return f"{differ}; {cause}"
    if plain and found.shown < 1:
        fx, fy, cy = (
            f"{a:.1f} and {b:.1f}" for a, b in ((left.fu, right.fu), (left.fv, right.fv), (left.v0, right.v0))
        )
        return (
            f"rows of left and right image show {max(share, 0.0):.0f} % of what rectification by focal lengths and "
            f"principal points does to them (fx {fx}, fy {fy}, cy {cy} px): is one of them mistyped?"
        )
    if plain:
        return (
            f"{differ}; were they rectified, as this calibration says (no distortion or rotation), and are they of one "
            "moment, or must numbers be shifted by one?"
        )
    if found.shown >= 1:
        return (
            f"{differ}; check that the calibration is this camera's, at this size, that K and D of the two cameras are "
            "not exchanged, that no image is mirrored, and that both are of one moment"
        )
    twice = "the images were rectified before, or undistorted, and are again; give the calibration after that"
    if found.shown < -0.5:  # guard: between images without it, 0, and with the opposite, -1
        cause = "is the sign of the distortion exchanged?"
    elif lenses:
        cause = f"{twice}, or leave the distortion out; or it is that of another lens, or of one camera alone"
    else:
        cause = f"the lenses' distortion is missing in it; or {twice}"
    return (
        f"rows of left and right image show {share:.0f} % of what the calibration's rectification does to rows: {cause}"
    )


def shows_something(image: object) -> bool:
    """Whether this is an array of numbers that are not all the same; others the front end refuses."""
    if not isinstance(image, np.ndarray) or image.dtype.kind not in "uif" or not image.size:
        return False
    rows = image[len(image) // 2], image  # one nearly always shows something
    return any(some.min() != some.max() for some in rows)


def _points(image: np.ndarray | None, rig: StereoRig) -> Points | None:
    """The points of an image; None where it is missing or unusable: the front end refuses it, or has its own format."""
    import cv2

    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16):
        return None
    if image.shape[:2] != (rig.height, rig.width) or image.shape[2:] not in ((), (1,), (3,), (4,)):
        return None
    if image.ndim == 3:
        one = image.shape[2] == 1
        image = image[:, :, 0] if one else np.asarray(cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY))
    return points_of(np.ascontiguousarray(eight_bits(image)))
