"""The modified SURF of paper A (III.A, III.B), with the regular 64-D descriptor beside the 16-D one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from frontends.surf.config import SurfConfig
from frontends.surf.descriptor import TURNED_EXCESS, UPRIGHT_EXCESS, describe, gaussian_weights
from frontends.surf.detector import detect_octave, layer_sizes, make_filters
from frontends.surf.images import Picture, integral_image
from frontends.surf.keypoints import UPRIGHT_ANGLE, Keypoints
from frontends.surf.localisation import first_of_each, localise
from frontends.surf.orientation import orientations
from frontends.surf.workers import Workers
from slam.errors import ConfigurationError, SequenceError

if TYPE_CHECKING:
    import cv2

_SMALLEST_STRIPE = 48  # cost: rows [px] that are worth a task of their own
_REACH = 0.15  # furthest that localisation moves a feature, in units of its size


class Surf:
    """Detects and describes SURF features.

    Images are (H, W) or (H, W, 3|4), uint8 or uint16, of any size; methods raise SequenceError for others.

    Args:
        threshold: least determinant of the Hessian; as the other settings, see `SurfConfig`.
        octaves, layers, descriptor, upright, threads: see `SurfConfig`.

    Attributes:
        config: these settings.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    def __init__(
        self, threshold: float = 100.0, octaves: int = 2, layers: int = 2, descriptor: int = 64, upright: bool = True,
        threads: int = 1,
    ) -> None:  # fmt: skip
        settings = {"threshold": threshold, "octaves": octaves, "layers": layers, "descriptor": descriptor}
        self.config = SurfConfig(**settings, upright=upright, threads=threads)  # type: ignore[arg-type]
        self.workers = Workers(threads)
        self._weights = gaussian_weights(4 if descriptor == 64 else 2)

    @classmethod
    def create(
        cls, hessianThreshold: float = 100.0, nOctaves: int = 4, nOctaveLayers: int = 3, extended: bool = False,
        upright: bool = False,
    ) -> Surf:  # fmt: skip
        """As ``cv2.xfeatures2d.SURF_create``: the same arguments in the same order, with the same defaults.

        There is no `extended` descriptor of 128 numbers: only False is taken. Raises ConfigurationError where a value
        is out of its range.

        Examples:
            >>> Surf.create(400).config.octaves
            4
        """
        surf = cls(hessianThreshold, nOctaves, nOctaveLayers, 64)
        surf.setUpright(upright)
        surf.setExtended(extended)
        return surf

    def detect(
        self, image: NDArray | Picture, mask: NDArray | None = None, threshold: float | None = None
    ) -> Keypoints:
        """Features of an image by falling response; no angle yet.

        They lie where the `mask` (H, W) is not zero. `threshold` is D_threshold for this image alone. Raises
        SequenceError where the image is unusable, or the mask is of another shape.
        """
        picture, c = Picture.of(image), self.config
        if mask is not None and np.shape(mask) != picture.grey.shape:
            raise SequenceError(f"mask: shape {np.shape(mask)} is not the image's, {picture.grey.shape}")
        integral, (height, width) = picture.integral, picture.grey.shape
        limit = np.float32(c.threshold if threshold is None else threshold)
        usable = [o for o in range(c.octaves) if min(width, height) >= layer_sizes(o, c.layers)[2]]
        bank = [make_filters(o, c.layers, 255.0 / picture.white, width + 1) for o in usable]
        count = max(1, min(c.threads, height // _SMALLEST_STRIPE))

        def search(stripe: int) -> list[NDArray[np.float64]]:
            """Candidates in a stripe of the image, by octave."""
            edges = [[(height >> o) * k // count for k in (stripe, stripe + 1)] for o in usable]
            return [detect_octave(integral, f, o, limit, a, b) for o, f, (a, b) in zip(usable, bank, edges)]

        found = self.workers.run([partial(search, stripe) for stripe in range(count)])
        rows = np.concatenate([np.zeros((0, 6)), *(part for octave in zip(*found) for part in octave)])
        if mask is not None:
            rows = rows[_mostly_inside(rows, np.asarray(mask))]
        rows = rows[np.argsort(-rows[:, 3], kind="stable")]
        size, response, sign, octave = rows[:, 2:].T.copy()
        uv, angle = np.ascontiguousarray(rows[:, :2]), np.full(len(rows), np.nan)
        return Keypoints(uv, size, angle, response, sign.astype(np.int8), octave.astype(np.int8))

    def localise(self, image: NDArray | Picture, keypoints: Keypoints) -> Keypoints:
        """Move features to the maxima of the response in continuous position and size, again by falling response.

        They then stay in place when the image moves or grows: a tenth of a pixel instead of half a pixel when it
        grows by a tenth. Those without a maximum near by (about a quarter) are left out, and all but one of those that
        share a maximum; sizes are no whole numbers.
        """
        if not len(keypoints):
            return keypoints
        picture = Picture.of(image)
        order = np.argsort(keypoints.uv[:, 1])  # cost: the rows that one feature needs are in the cache for the next
        integral, uv, size = picture.integral, keypoints.uv[order], keypoints.size[order]
        (found,) = self.workers.over(len(uv), lambda a, b: (localise(integral, uv[a:b], size[a:b], _REACH),))
        place = np.empty_like(found)
        place[order] = found
        rows = np.flatnonzero(np.isfinite(place[:, 0]))
        rows = rows[np.argsort(-place[rows, 3], kind="stable")]
        rows = rows[first_of_each(np.argsort(place[rows, 0], kind="stable"), place[rows, :2], place[rows, 2])]
        response = place[rows, 3] * (255.0 / picture.white) ** 2
        return replace(keypoints.select(rows), uv=place[rows, :2], size=place[rows, 2], response=response)

    def describe(self, image: NDArray | Picture, keypoints: Keypoints) -> tuple[Keypoints, NDArray[np.float32]]:
        """Orient (unless upright) and describe features; those that cannot be oriented are left out.

        Returns the features and their unit descriptors (N, 16 or 64) float32.
        """
        integral, uv, size = Picture.of(image).integral, keypoints.uv, keypoints.size
        angle, descriptors = self.workers.over(len(uv), lambda a, b: self.described(integral, uv[a:b], size[a:b]))
        good = np.isfinite(angle)
        return replace(keypoints, angle=angle).select(good), descriptors[good]

    def described(
        self, integral: NDArray[np.int32], uv: NDArray[np.float64], size: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Angles, NaN where there is none, and descriptors of features with pixels (N, 2) and sizes (N,) [px]."""
        upright = self.config.upright
        angle = np.full(len(uv), UPRIGHT_ANGLE) if upright else orientations(integral, uv, size)
        excess = UPRIGHT_EXCESS if upright else TURNED_EXCESS
        return angle, describe(integral, uv, size, angle, excess, self._weights)

    def detect_and_describe(self, image: NDArray, mask: NDArray | None = None) -> tuple[Keypoints, NDArray[np.float32]]:
        """`detect` and `describe` in one."""
        picture = Picture.of(image)
        return self.describe(picture, self.detect(picture, mask))

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
        picture, given = Picture.of(image), Keypoints.from_cv2(keypoints)
        height, width = picture.grey.shape
        inside = (given.uv > -0.5).all(axis=1) & (given.uv < (width - 0.5, height - 0.5)).all(axis=1)
        inside &= given.size <= max(height, width)
        given = replace(given, size=np.maximum(given.size, layer_sizes(0, 2)[0])).select(inside)
        found, descriptors = self.describe(picture, given)
        return tuple(found), descriptors

    def detectAndCompute(
        self, image: NDArray, mask: NDArray | None = None, descriptors: None = None, useProvidedKeypoints: bool = False
    ) -> tuple[tuple[cv2.KeyPoint, ...], NDArray[np.float32]]:
        """The same as OpenCV's method of this name: ``cv2.KeyPoint`` objects and descriptors (N, 16 or 64).

        `descriptors` is OpenCV's place for the output. Raises ConfigurationError where `useProvidedKeypoints` is true:
        keypoints of one's own are for `compute`.
        """
        if useProvidedKeypoints:
            raise ConfigurationError("useProvidedKeypoints: use compute(image, keypoints)")
        keypoints, described = self.detect_and_describe(image, mask)
        return tuple(keypoints), described

    def getHessianThreshold(self) -> float:
        """Least determinant of the Hessian."""
        return self.config.threshold

    def setHessianThreshold(self, hessianThreshold: float) -> None:
        """Set it; raises ConfigurationError for a value out of range, as the other setters do."""
        self.config = replace(self.config, threshold=hessianThreshold)

    def getNOctaves(self) -> int:
        """Number of octaves."""
        return self.config.octaves

    def setNOctaves(self, nOctaves: int) -> None:
        """Set it, 1 to 4."""
        self.config = replace(self.config, octaves=nOctaves)

    def getNOctaveLayers(self) -> int:
        """Layers searched for maxima in each octave."""
        return self.config.layers

    def setNOctaveLayers(self, nOctaveLayers: int) -> None:
        """Set it, 2 or 3."""
        self.config = replace(self.config, layers=nOctaveLayers)

    def getUpright(self) -> bool:
        """Whether the orientation is left out."""
        return self.config.upright

    def setUpright(self, upright: bool) -> None:
        """Set it; a whole number is taken as OpenCV does: 0 is False, others are True."""
        number = isinstance(upright, (int, np.integer, np.bool_))
        self.config = replace(self.config, upright=bool(upright) if number else upright)

    def getExtended(self) -> bool:
        """Whether descriptors have 128 numbers: never."""
        return False

    def setExtended(self, extended: bool) -> None:
        """Raises ConfigurationError for True."""
        if extended:
            raise ConfigurationError("extended: there are no descriptors of 128 numbers; extended=False gives 64")

    def descriptorSize(self) -> int:
        """Numbers in a descriptor."""
        return self.config.descriptor

    def defaultNorm(self) -> int:
        """OpenCV's name for the distance of descriptors: Euclidean."""
        import cv2

        return int(cv2.NORM_L2)


def _mostly_inside(rows: NDArray[np.float64], mask: NDArray) -> NDArray[np.bool_]:
    """Candidates at least half of whose filter square lies where the mask is not zero."""
    sums, size = integral_image((mask != 0).astype(np.uint8)), np.array(mask.shape[::-1])
    first, last = (
        np.clip(np.rint(rows[:, :2] + 0.5 + side * rows[:, 2:3]), 0, size).astype(int) for side in (-0.5, 0.5)
    )
    (left, top), (right, bottom) = first.T, last.T
    inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return 2 * inside >= np.maximum((right - left) * (bottom - top), 1)
