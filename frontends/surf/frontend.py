"""The SURF front end: a stereo frame in, features with stereo matches out."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from frontends.surf.config import SurfConfig
from frontends.surf.correlation import align_patches, cut_patches, patch_windows, refine
from frontends.surf.epipolar import HalfImage, half_image, search_rows
from frontends.surf.images import FullScale, grey
from frontends.surf.integral import integral_image
from frontends.surf.keypoints import Keypoints
from frontends.surf.selection import adapted_threshold, spread
from frontends.surf.surf import Surf
from slam.bounds import from_options
from slam.data import ImagePair, Patches, StereoFeatures, StereoFrame
from slam.errors import SequenceError
from slam.geometry.rig import StereoRig

_SURPLUS = 1.35  # cost: features detected for each one needed, to have a choice when spreading them
_CHOICE = 1.5  # cost: features localised for each one kept: some prove to be no maxima
_THRESHOLDS = 5.0, 20000.0  # limits of the D_threshold that is adapted
_GRID = 8, 5  # cost: columns and rows over which features are spread: each cell has an equal share
_CORRELATION = 0.8  # least one of the left and the right patch
_UNIQUENESS = 0.8  # largest ratio of 1 - correlation of the best and the next best place on the epipolar line
_TRIES = 4  # cost: detections at most in one image
_REACH = 3.0  # largest sub-pixel correction along the row [px]
_FINE_REACH = 1.5  # largest further correction by the narrow window, either way [px]
_COARSE = 0.9  # the search along the row may correlate less than the final patches, by this factor
_OWN_BAND = 1.5  # rows [px] that the search reaches without looking into neighbouring rows


class _View(NamedTuple):
    """A rectified image: as it came, as float32, and at half resolution if it is one of two; what counts as white."""

    grey: NDArray
    pixels: NDArray[np.float32]
    half: HalfImage | None
    white: float


class SurfFrontend:
    """Detects SURF features in the left image, matches them along epipolar lines, and refines the right pixels.

    Args:
        rig: the stereo rig; images that are not rectified are rectified inside, results are in the rig's own pixels.
        **options: see `SurfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of its range.
    """

    def __init__(self, rig: StereoRig, **options: Any) -> None:
        self.rig = rig
        self.config = config = from_options(SurfConfig, "surf", options)
        self._surf = Surf(
            config.threshold, config.octaves, config.layers, config.descriptor, config.upright, config.threads
        )
        self._threshold = float(np.clip(config.threshold, *_THRESHOLDS))
        self._white = FullScale()
        self._windows = np.stack([patch_windows(0.4), patch_windows(0.3)])  # a wide and a narrow one
        self._masks: tuple[NDArray | None, NDArray | None] = None, None  # of the last frame: as given, and rectified

    @property
    def threshold(self) -> float:
        """D_threshold for the next frame."""
        return self._threshold

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """Features of one stereo frame, see `slam.interfaces.Frontend`."""
        if not isinstance(frame, StereoFrame):
            raise SequenceError(f"a frame must be a StereoFrame, got {type(frame).__name__}")
        if frame.left_mask is not self._masks[0]:  # it is the same array in all frames of a sequence
            self._masks = frame.left_mask, self._rectified_mask(frame.left_mask)
        given = [frame.left] if frame.right is None else [frame.left, frame.right]
        given = [self._checked(frame, image, side) for side, image in enumerate(given)]
        white, paired = self._white.of(given[0]), len(given) > 1
        views = self._surf.workers.run([partial(self._view, image, k, white, paired) for k, image in enumerate(given)])
        integral = integral_image(views[0].grey)
        keypoints, threshold = self._keypoints(views[0], integral)
        describe = self._surf.describer(integral, keypoints)
        images = ImagePair(views[0].pixels, None if frame.right is None else views[1].pixels)

        def finish(first: int, last: int) -> tuple[NDArray, ...]:
            """Angles, descriptors and right pixels of some of the features."""
            uv, size = keypoints.uv[first:last], keypoints.size[first:last]
            right = np.full(uv.shape, np.nan) if images.right is None else self._match(views, images, uv, size)
            return *describe(first, last), right

        angles, descriptors, uv_right = map(np.concatenate, zip(*self._surf.workers.over(len(keypoints), finish)))
        good = np.isfinite(angles)
        uv, uv_right = keypoints.uv[good], uv_right[good]
        if not self.rig.is_rectified:
            uv, uv_right = self.rig.rectified.unrectify_left(uv), self.rig.rectified.unrectify_right(uv_right)
        angles = np.zeros(len(uv)) if self.config.upright else angles[good]
        return StereoFeatures(
            frame.stamp, uv, uv_right, keypoints.size[good], angles, keypoints.response[good],
            keypoints.laplacian[good], descriptors[good], threshold, images,
        )  # fmt: skip

    def patches(self, images: ImagePair, uv_left: NDArray, size: NDArray) -> Patches:
        """The left image around pixels, see `slam.interfaces.AligningFrontend`."""
        return Patches(*cut_patches(images.left, uv_left), size)

    def align(
        self, images: ImagePair, patches: Patches, warps: NDArray, uv_left: NDArray, uv_right: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Where patches are in a later pair of images, see `slam.interfaces.AligningFrontend`."""
        size = patches.size
        left = align_patches(
            images.left, patches.images, patches.centres, warps, size, uv_left, _CORRELATION, _REACH, self._windows[0]
        )
        if images.right is None:
            return left, np.full_like(left, np.nan)
        start = np.column_stack([uv_right[:, 0] + left[:, 0] - uv_left[:, 0], left[:, 1]])
        return left, self._refine(images, left, size, start)

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

    def _view(self, image: NDArray, side: int, white: float, paired: bool) -> _View:
        """What is needed of the rectified image of the left (0) or right (1) camera."""
        image = self._rectify(image, side)
        return _View(image, image.astype(np.float32), half_image(image, white) if paired else None, white)

    def _rectify(self, image: NDArray, side: int) -> NDArray:
        """Image of the rectified rig's left (0) or right (1) camera."""
        if self.rig.is_rectified:
            return image
        import cv2

        return cv2.remap(image, self.rig.rectified.maps[side], None, cv2.INTER_LINEAR)

    def _rectified_mask(self, mask: NDArray | None) -> NDArray[np.uint8] | None:
        """The mask of a frame, 0 and 1, in the rectified left image."""
        if mask is None:
            return None
        if mask.shape != (self.rig.height, self.rig.width):
            size = "x".join(str(n) for n in mask.shape[::-1])
            raise SequenceError(f"mask: {size}, but the images are {self.rig.width}x{self.rig.height}")
        return (self._rectify((mask != 0).astype(np.uint8), 0) != 0).astype(np.uint8)

    def _detect(self, white: float, integral: NDArray[np.int32]) -> tuple[Keypoints, float]:
        """Features, and the D_threshold that found them (paper A, III.A).

        It was adapted after the last image. Should it still find less than half of what is wanted, as in the first
        image or after the light went out, it is lowered at once.
        """
        c = self.config
        target = int((_CHOICE if c.localise else 1.0) * _SURPLUS * c.features)
        for _ in range(_TRIES):
            threshold = self._threshold
            keypoints = self._surf.detect_in(integral, white, self._masks[1], threshold)
            if c.adaptive:
                self._threshold = adapted_threshold(threshold, len(keypoints), target, *_THRESHOLDS)
            if 2 * len(keypoints) >= target or self._threshold >= threshold:
                break
        return keypoints, threshold

    def _keypoints(self, view: _View, integral: NDArray[np.int32]) -> tuple[Keypoints, float]:
        """Features of the left image, spread over it, and the D_threshold that found them."""
        keypoints, threshold = self._detect(view.white, integral)
        if self.config.localise:
            keypoints = self._spread(keypoints, int(_CHOICE * self.config.features))
            keypoints = self._surf.localise_in(view.grey, keypoints, view.white)
        return self._spread(keypoints, self.config.features), threshold

    def _spread(self, keypoints: Keypoints, limit: int) -> Keypoints:
        """At most `limit` features, spread over the image."""
        return keypoints.select(spread(keypoints.uv, limit, _GRID, (self.rig.width, self.rig.height)))

    def _match(self, views: list[_View], images: ImagePair, uv: NDArray, size: NDArray) -> NDArray[np.float64]:
        """Right pixels (N, 2) of left features in the rectified images, NaN where unmatched."""
        c = self.config
        low, high = self._disparities()
        band = max(int(np.rint(0.5 * (c.epipolar - _OWN_BAND))), 0)
        left, right = views[0].half, views[1].half
        assert left is not None and right is not None
        start = search_rows(left, right, uv, low, high, band, _COARSE * _CORRELATION, _UNIQUENESS)
        found = self._refine(images, uv, size, start)
        disparity = uv[:, 0] - found[:, 0]
        off_line = np.abs(found[:, 1] - uv[:, 1]) > c.epipolar
        found[~((disparity >= low) & (disparity <= high)) | off_line] = np.nan
        return found

    def _refine(self, images: ImagePair, uv: NDArray, size: NDArray, start: NDArray) -> NDArray[np.float64]:
        """Right pixels (N, 2) of left ones by correlation, NaN where they do not correlate."""
        c = self.config
        assert images.right is not None
        # Beside a depth edge a narrow window sees less of the other surface; where it fails the wide one stands.
        reaches = np.array([(_REACH, c.epipolar), (_FINE_REACH, _FINE_REACH)])
        return refine(images.left, images.right, uv, size, start, _CORRELATION, reaches, self._windows)

    def _disparities(self) -> tuple[float, float]:
        """Range of disparities [px] of the rectified pair for the range of depths."""
        rectified_rig = self.rig.rectified.rig
        shift = rectified_rig.left.u0 - rectified_rig.right.u0
        product = rectified_rig.left.fu * rectified_rig.baseline
        return product / self.config.max_depth + shift, product / self.config.min_depth + shift
