"""The modified SURF of paper A (III.A, III.B), with the regular 64-D descriptor beside the 16-D one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from frontends.surf.descriptor import TURNED_BOX, UPRIGHT_BOX, describe, gaussian_weights
from frontends.surf.detector import COLUMNS, detect_octave
from frontends.surf.filters import layer_sizes, make_filters
from frontends.surf.images import FULL_SCALE, binary_mask, grey
from frontends.surf.integral import float_integral_image, integral_image
from frontends.surf.keypoints import UPRIGHT_ANGLE, Keypoints
from frontends.surf.localisation import first_of_each, localise
from frontends.surf.orientation import DISC, orientations
from frontends.surf.workers import Workers
from slam.errors import ConfigurationError

if TYPE_CHECKING:
    import cv2

_SMALLEST_STRIPE = 48  # cost: rows [px] that are worth a task of their own
_REACH = 0.15  # furthest that localisation moves a feature, in units of its size


class Surf:
    """Detects and describes SURF features.

    Args:
        threshold: D_threshold, the least determinant of the Hessian, on OpenCV's scale for 8-bit images.
        octaves: 1 to 4. Paper A uses two.
        layers: layers searched for maxima in each octave, 2 or 3.
        descriptor: 16 (paper A) or 64 (regular) dimensions.
        upright: leave the orientation out; better where the camera keeps its roll, as in stereo.
        threads: number of threads; results do not depend on it.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    def __init__(
        self,
        threshold: float = 100.0,
        octaves: int = 2,
        layers: int = 2,
        descriptor: int = 64,
        upright: bool = True,
        threads: int = 1,
    ) -> None:
        self.setHessianThreshold(threshold)
        self.setNOctaves(octaves)
        self.setNOctaveLayers(layers)
        if descriptor not in (16, 64):
            raise ConfigurationError(f"descriptor: must be 16 or 64, not {descriptor}")
        if not isinstance(threads, int) or threads < 1:
            raise ConfigurationError(f"threads: must be a whole number of at least 1, not {threads}")
        self.descriptor = descriptor
        self.setUpright(upright)
        self.workers = Workers(threads)
        self._weights = gaussian_weights(4 if descriptor == 64 else 2)

    @classmethod
    def create(
        cls,
        hessianThreshold: float = 100.0,
        nOctaves: int = 4,
        nOctaveLayers: int = 3,
        extended: bool = False,
        upright: bool = False,
    ) -> Surf:
        """As ``cv2.xfeatures2d.SURF_create``: the same arguments in the same order, with the same defaults.

        Args:
            hessianThreshold: least determinant of the Hessian.
            nOctaves: 1 to 4.
            nOctaveLayers: 2 or 3.
            extended: 128 numbers in a descriptor, which this SURF does not have; only False is taken.
            upright: leave the orientation out.

        Raises:
            ConfigurationError: a value is out of its range.

        Examples:
            >>> Surf.create(400).octaves
            4
        """
        surf = cls(hessianThreshold, nOctaves, nOctaveLayers, 64, upright)
        surf.setExtended(extended)
        return surf

    def detect(self, image: NDArray, mask: NDArray | None = None, threshold: float | None = None) -> Keypoints:
        """Features of an image (H, W) or (H, W, 3|4), uint8 or uint16, by falling response; no angle yet.

        Args:
            image: the image, of any size.
            mask: (H, W); features lie where it is not zero.
            threshold: D_threshold for this image alone.

        Raises:
            SequenceError: the image or the mask is unusable.
        """
        image = grey(image)
        mask = None if mask is None else binary_mask(mask, image.shape)
        return self.detect_in(integral_image(image), FULL_SCALE[image.dtype], mask, threshold)

    def localise(self, image: NDArray, keypoints: Keypoints) -> Keypoints:
        """Move features to the maxima of the response in continuous position and size.

        They then stay in place when the image moves or grows: a tenth of a pixel instead of half a pixel when it
        grows by a tenth. Those without a maximum near by (about a quarter) are left out; sizes are no whole numbers.

        Raises:
            SequenceError: the image is unusable.
        """
        image = grey(image)
        return self.localise_in(image, keypoints, FULL_SCALE[image.dtype])

    def describe(self, image: NDArray, keypoints: Keypoints) -> tuple[Keypoints, NDArray[np.float32]]:
        """Orient (unless upright) and describe features; those that cannot be oriented are left out.

        Returns the features and their unit descriptors (N, 16 or 64) float32.

        Raises:
            SequenceError: the image is unusable.
        """
        return self.describe_in(integral_image(grey(image)), keypoints)

    def detect_and_describe(self, image: NDArray, mask: NDArray | None = None) -> tuple[Keypoints, NDArray[np.float32]]:
        """`detect` and `describe` in one."""
        image = grey(image)
        integral = integral_image(image)
        mask = None if mask is None else binary_mask(mask, image.shape)
        return self.describe_in(integral, self.detect_in(integral, FULL_SCALE[image.dtype], mask))

    # What people know from OpenCV's Feature2D; `detect` is above, and gives what serves as a list of cv2.KeyPoint.

    def compute(
        self, image: NDArray, keypoints: Iterable[cv2.KeyPoint]
    ) -> tuple[tuple[cv2.KeyPoint, ...], NDArray[np.float32]]:
        """Describe key points of any detector, as OpenCV's method of this name: those described, and descriptors.

        Their orientation is measured again, unless upright. Left out are those that cannot be oriented, whose centre is
        not in the image, or that are larger than it. None is smaller than SURF's smallest filter, 9 px.

        Raises:
            SequenceError: the image or a key point is unusable.
        """
        image = grey(image)
        given, (height, width) = Keypoints.from_cv2(keypoints), image.shape
        inside = (given.uv > -0.5).all(axis=1) & (given.uv < (width - 0.5, height - 0.5)).all(axis=1)
        inside &= given.size <= max(height, width)
        given = replace(given, size=np.maximum(given.size, layer_sizes(0, 2)[0])).select(inside)
        found, descriptors = self.describe_in(integral_image(image), given)
        return found.to_cv2(), descriptors

    def detectAndCompute(
        self, image: NDArray, mask: NDArray | None = None, descriptors: None = None, useProvidedKeypoints: bool = False
    ) -> tuple[tuple[cv2.KeyPoint, ...], NDArray[np.float32]]:
        """The same as OpenCV's method of this name: ``cv2.KeyPoint`` objects and descriptors (N, 16 or 64).

        `descriptors` is OpenCV's place for the output; keypoints of one's own are for `compute`.

        Raises:
            ConfigurationError: `useProvidedKeypoints` is true.
        """
        if useProvidedKeypoints:
            raise ConfigurationError("useProvidedKeypoints: use compute(image, keypoints)")
        keypoints, described = self.detect_and_describe(image, mask)
        return keypoints.to_cv2(), described

    def getHessianThreshold(self) -> float:
        """Least determinant of the Hessian."""
        return self.threshold

    def setHessianThreshold(self, hessianThreshold: float) -> None:
        """Set it; raises ConfigurationError below 0."""
        if not (isinstance(hessianThreshold, (int, float, np.number)) and 0 <= hessianThreshold < np.inf):
            raise ConfigurationError(f"threshold: must be a number of at least 0, not {hessianThreshold}")
        self.threshold = float(hessianThreshold)

    def getNOctaves(self) -> int:
        """Number of octaves."""
        return self.octaves

    def setNOctaves(self, nOctaves: int) -> None:
        """Set it; raises ConfigurationError outside 1 to 4."""
        if nOctaves not in (1, 2, 3, 4):
            raise ConfigurationError(f"octaves: must be 1 to 4, not {nOctaves}")
        self.octaves = int(nOctaves)

    def getNOctaveLayers(self) -> int:
        """Layers searched for maxima in each octave."""
        return self.layers

    def setNOctaveLayers(self, nOctaveLayers: int) -> None:
        """Set it; raises ConfigurationError outside 2 to 3."""
        if nOctaveLayers not in (2, 3):
            raise ConfigurationError(f"layers: must be 2 or 3, not {nOctaveLayers}")
        self.layers = int(nOctaveLayers)

    def getExtended(self) -> bool:
        """Whether descriptors have 128 numbers: never."""
        return False

    def setExtended(self, extended: bool) -> None:
        """Raises ConfigurationError for True."""
        if extended:
            raise ConfigurationError("extended: there are no descriptors of 128 numbers; extended=False gives 64")

    def getUpright(self) -> bool:
        """Whether the orientation is left out."""
        return self.upright

    def setUpright(self, upright: bool) -> None:
        """Set it."""
        self.upright = bool(upright)

    def descriptorSize(self) -> int:
        """Numbers in a descriptor."""
        return self.descriptor

    def descriptorType(self) -> int:
        """OpenCV's name for 32-bit floats."""
        import cv2

        return int(cv2.CV_32F)

    def defaultNorm(self) -> int:
        """OpenCV's name for the distance of descriptors: Euclidean."""
        import cv2

        return int(cv2.NORM_L2)

    def empty(self) -> bool:
        """As of OpenCV's own: true, nothing is learnt or loaded."""
        return True

    def getDefaultName(self) -> str:
        """Name as OpenCV gives one."""
        return "Feature2D.SURF"

    def detect_in(
        self,
        integral: NDArray[np.int32],
        full_scale: float,
        mask: NDArray[np.uint8] | None = None,
        threshold: float | None = None,
    ) -> Keypoints:
        """`detect` on an integral image of pixels 0..full_scale, to share it between steps."""
        limit = self.threshold if threshold is None else threshold
        height, width = integral.shape[0] - 1, integral.shape[1] - 1
        usable = [o for o in range(self.octaves) if min(width, height) >= layer_sizes(o, self.layers)[2]]
        bank = [make_filters(o, self.layers, 255.0 / full_scale, width + 1) for o in usable]
        count = max(1, min(self.workers.threads, height // _SMALLEST_STRIPE))

        def search(stripe: int) -> list[NDArray[np.float64]]:
            """Candidates in a stripe of the image, by octave."""
            edges = [[(height >> o) * k // count for k in (stripe, stripe + 1)] for o in usable]
            return [detect_octave(integral, f, o, limit, a, b) for o, f, (a, b) in zip(usable, bank, edges)]

        found = self.workers.run([partial(search, stripe) for stripe in range(count)])
        rows = np.concatenate([np.zeros((0, COLUMNS)), *(part for octave in zip(*found) for part in octave)])
        if mask is not None:
            rows = rows[_mostly_inside(rows, mask)]
        return _as_keypoints(rows[np.argsort(-rows[:, 3], kind="stable")])

    def localise_in(self, image: NDArray, keypoints: Keypoints, full_scale: float) -> Keypoints:
        """`localise` in an image as `grey` gives it; of several features that share a maximum one stays."""
        if not len(keypoints):
            return keypoints
        integral = float_integral_image(image)
        uv, size = keypoints.uv, keypoints.size
        place = np.concatenate(self.workers.over(len(uv), lambda a, b: localise(integral, uv[a:b], size[a:b], _REACH)))
        rows = np.flatnonzero(np.isfinite(place[:, 0]))
        response = place[rows, 3] * (255.0 / full_scale) ** 2
        order = np.argsort(-response, kind="stable")
        rows, response = rows[order], response[order]
        uv, size = place[rows, :2], place[rows, 2]
        first = first_of_each(np.argsort(uv[:, 0], kind="stable"), uv, size)
        rows = rows[first]
        return Keypoints(
            uv[first], size[first], keypoints.angle[rows], response[first], keypoints.laplacian[rows],
            keypoints.octave[rows],
        )  # fmt: skip

    def describe_in(self, integral: NDArray[np.int32], keypoints: Keypoints) -> tuple[Keypoints, NDArray[np.float32]]:
        """`describe` on an integral image."""
        shares = self.workers.over(len(keypoints), self.describer(integral, keypoints))
        angles, descriptors = (np.concatenate(parts) for parts in zip(*shares))
        good = np.isfinite(angles)
        return replace(keypoints, angle=angles).select(good), descriptors[good]

    def describer(
        self, integral: NDArray[np.int32], keypoints: Keypoints
    ) -> Callable[[int, int], tuple[NDArray[np.float64], NDArray[np.float32]]]:
        """What returns the angles [rad], NaN where there is none, and the descriptors of features number a to b."""
        box = UPRIGHT_BOX if self.upright else TURNED_BOX

        def orient_and_describe(a: int, b: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
            uv, size = keypoints.uv[a:b], keypoints.size[a:b]
            angle = np.full(b - a, UPRIGHT_ANGLE) if self.upright else orientations(integral, uv, size, DISC)
            return angle, describe(integral, uv, size, np.nan_to_num(angle), box, self._weights)

        return orient_and_describe


def _as_keypoints(rows: NDArray[np.float64]) -> Keypoints:
    """Candidate rows of the detector as arrays of their own, angle not measured."""
    return Keypoints(
        np.ascontiguousarray(rows[:, :2]), rows[:, 2].copy(), np.full(len(rows), np.nan), rows[:, 3].copy(),
        rows[:, 4].astype(np.int8), rows[:, 5].astype(np.int8),
    )  # fmt: skip


def _mostly_inside(rows: NDArray[np.float64], mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Candidates at least half of whose filter square lies on the mask."""
    sums = integral_image(mask)
    half = 0.5 * rows[:, 2]
    left = np.clip(np.rint(rows[:, 0] + 0.5 - half), 0, mask.shape[1]).astype(int)
    right = np.clip(np.rint(rows[:, 0] + 0.5 + half), 0, mask.shape[1]).astype(int)
    top = np.clip(np.rint(rows[:, 1] + 0.5 - half), 0, mask.shape[0]).astype(int)
    bottom = np.clip(np.rint(rows[:, 1] + 0.5 + half), 0, mask.shape[0]).astype(int)
    inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return 2 * inside >= np.maximum((right - left) * (bottom - top), 1)
