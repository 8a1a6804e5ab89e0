"""The SURF front end: a stereo frame in, features with stereo matches out."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frontends.surf.config import SurfConfig
from frontends.surf.correlation import align, cut_patches, patch_windows
from frontends.surf.epipolar import ROW, search_rows
from frontends.surf.images import Picture, Sampler, following_white, grey
from frontends.surf.keypoints import Keypoints, adapted_threshold, spread
from frontends.surf.surf import Surf
from slam.bounds import from_options
from slam.data import ImagePair, Patches, StereoFeatures, StereoFrame
from slam.errors import SequenceError
from slam.geometry.rig import StereoRig

_SURPLUS = 1.35  # cost: features detected for each one needed, to have a choice when spreading them
_CHOICE = 1.5  # cost: features localised for each one kept: some prove to be no maxima
_THRESHOLDS = 5.0, 20000.0  # guard: limits of the D_threshold that is adapted
_GRID = 8, 5  # cost: columns and rows over which features are spread: each cell has an equal share
_CORRELATION = 0.8  # least one of the left and the right patch
_UNIQUENESS = 0.8  # largest ratio of 1 - correlation of the best and the next best place on the epipolar line
_TRIES = 4  # cost: detections at most in one image
_REACH = 3.0  # largest sub-pixel correction along the row [px]
_FINE_REACH = _REACH / 2  # largest further correction by the narrow window, either way [px]
_COARSE = 0.9  # the search along the row may correlate less than the final patches, by this factor


class SurfFrontend:
    """Detects SURF features in the left image, matches them along epipolar lines, and refines the right pixels.

    Args:
        rig: the stereo rig; images that are not rectified are rectified. Results are in the rectified pair's pixels.
        **options: see `SurfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of its range.
    """

    def __init__(self, rig: StereoRig, **options: Any) -> None:
        self.rig = rig
        self.config = c = from_options(SurfConfig, "surf", options)
        self._surf = Surf(c.threshold, c.octaves, c.layers, c.descriptor, c.upright, c.threads)
        maps = () if rig.is_rectified else rig.rectified.maps  # made here: the first frame must not wait for them
        self._samplers = [Sampler(places) for places in maps]
        self._threshold = float(np.clip(c.threshold, *_THRESHOLDS))
        self._white = 0.0
        self._windows = np.stack([patch_windows(0.4), patch_windows(0.3)])  # a wide and a narrow one
        self._masks: tuple[NDArray | None, NDArray | None] = None, None  # of the last frame: as given, and rectified

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """Features of one stereo frame, see `slam.interfaces.Frontend`."""
        if not isinstance(frame, StereoFrame):
            raise SequenceError(f"a frame must be a StereoFrame, got {type(frame).__name__}")
        if frame.left_mask is not self._masks[0]:  # it is the same array in all frames of a sequence
            self._masks = frame.left_mask, self._rectified_mask(frame.left_mask)
        given = [frame.left] if frame.right is None else [frame.left, frame.right]
        given = [self._checked(frame, image, side) for side, image in enumerate(given)]
        self._white = white = following_white(given[0], self._white)
        tasks = [partial(self._picture, image, k, white) for k, image in enumerate(given)]
        left, *right = self._surf.workers.run(tasks)
        keypoints, threshold = self._detect(left)
        keypoints = self._spread(keypoints, int(_CHOICE * self.config.features))
        keypoints = self._spread(self._surf.localise(left, keypoints), self.config.features)
        order = np.argsort(keypoints.uv[:, 1])  # cost: the rows that one feature needs are in the cache for the next
        uv, size = keypoints.uv[order], keypoints.size[order]

        def describe_and_match(first: int, last: int) -> tuple[NDArray, ...]:
            """Angles, descriptors and right pixels of some of the features."""
            here = uv[first:last], size[first:last]
            matched = self._match(left, right[0], *here) if right else np.full_like(here[0], np.nan)
            return *self._surf.described(left.integral, *here), matched

        by_response = np.empty_like(order)
        by_response[order] = np.arange(len(order))
        found = self._surf.workers.over(len(order), describe_and_match)
        angle, descriptors, uv_right = (column[by_response] for column in found)
        features = StereoFeatures(
            frame.stamp, keypoints.uv, uv_right, keypoints.size, np.zeros(len(uv)) if self.config.upright else angle,
            keypoints.response, keypoints.laplacian, descriptors, threshold,
            ImagePair(left.floats[0], right[0].floats[0] if right else None), rectified=True,
        )  # fmt: skip
        return features if np.isfinite(angle).all() else features.select(np.isfinite(angle))

    def patches(self, images: ImagePair, uv_left: NDArray, size: NDArray) -> Patches:
        """The left image around pixels, see `slam.interfaces.AligningFrontend`."""
        return Patches(*cut_patches(images.left, uv_left), size)

    def align(
        self, images: ImagePair, patches: Patches, warps: NDArray, uv_left: NDArray, uv_right: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Where patches are in a later pair of images, see `slam.interfaces.AligningFrontend`."""
        size = patches.size
        left = align(
            patches.images, patches.centres, warps, images.left, size, uv_left, _CORRELATION,
            np.full((1, 2), _REACH), self._windows[:1],
        )  # fmt: skip
        if images.right is None:
            return left, np.full_like(left, np.nan)
        start = np.column_stack([uv_right[:, 0] + left[:, 0] - uv_left[:, 0], left[:, 1]])
        return left, self._refine(images.left, images.right, left, size, start)

    def _checked(self, frame: StereoFrame, image: NDArray, side: int) -> NDArray:
        """The image of the left (0) or right (1) camera in grey."""
        what = f"frame {frame.index}, {('left', 'right')[side]} image"
        image = grey(image, what)
        if image.shape != (self.rig.height, self.rig.width):
            raise SequenceError(
                f"{what}: {image.shape[1]}x{image.shape[0]} pixels, "
                f"but the calibration is for {self.rig.width}x{self.rig.height}"
            )
        return image

    def _picture(self, image: NDArray, side: int, white: float) -> Picture:
        """The image of the left (0) or right (1) camera, rectified, with what is needed of it."""
        picture = Picture(self._rectified(image, side), white)
        _ = picture.floats
        return picture

    def _rectified(self, image: NDArray, side: int) -> NDArray:
        """Image of the rectified rig's left (0) or right (1) camera."""
        return self._samplers[side](image) if self._samplers else image

    def _rectified_mask(self, mask: NDArray | None) -> NDArray | None:
        if mask is None:
            return None
        if mask.shape != (self.rig.height, self.rig.width):
            size = "x".join(str(n) for n in mask.shape[::-1])
            raise SequenceError(f"mask: {size}, but the images are {self.rig.width}x{self.rig.height}")
        return self._rectified((mask != 0).astype(np.uint8), 0)

    def _detect(self, picture: Picture) -> tuple[Keypoints, float]:
        """Features, and the D_threshold that found them: lowered at once where it finds less than half (A, III.A)."""
        target = int(_CHOICE * _SURPLUS * self.config.features)
        for _ in range(_TRIES):
            threshold = self._threshold
            keypoints = self._surf.detect(picture, self._masks[1], threshold)
            self._threshold = adapted_threshold(threshold, len(keypoints), target, *_THRESHOLDS)
            if 2 * len(keypoints) >= target or self._threshold >= threshold:
                break
        return keypoints, threshold

    def _spread(self, keypoints: Keypoints, limit: int) -> Keypoints:
        return keypoints.select(spread(keypoints.uv, limit, _GRID, (self.rig.width, self.rig.height)))

    def _match(self, left: Picture, right: Picture, uv: NDArray, size: NDArray) -> NDArray[np.float64]:
        """Right pixels (N, 2) of left features in the rectified images, NaN where unmatched."""
        c = self.config
        rectified = self.rig.rectified.rig
        shift, product = rectified.left.u0 - rectified.right.u0, rectified.left.fu * rectified.baseline
        low, high = product / c.max_depth + shift, product / c.min_depth + shift
        band = int(c.epipolar / 2)  # rows of half resolution
        (pixels, half), (pixels_right, half_right) = left.floats, right.floats
        start = search_rows(half, half_right, uv, low, high, band, _COARSE * _CORRELATION, _UNIQUENESS, ROW)
        found = self._refine(pixels, pixels_right, uv, size, start)
        disparity = uv[:, 0] - found[:, 0]
        off_line = np.abs(found[:, 1] - uv[:, 1]) > c.epipolar
        found[~((disparity >= low) & (disparity <= high)) | off_line] = np.nan
        return found

    def _refine(self, left: NDArray, right: NDArray, uv: NDArray, size: NDArray, start: NDArray) -> NDArray[np.float64]:
        """Right pixels (N, 2) of left ones by correlation, NaN where they do not correlate."""
        # Beside a depth edge a narrow window sees less of the other surface; where it fails the wide one stands.
        reaches = np.array([(_REACH, self.config.epipolar), (_FINE_REACH, _FINE_REACH)])
        return align(left[None], uv, np.zeros((0, 2, 2)), right, size, start, _CORRELATION, reaches, self._windows)
