"""Features that carry images, and front ends from elsewhere that align them: wrong sizes, types and answers."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import slam
from frontends.surf import SurfFrontend
from slam.config import SystemConfig
from slam.data import ImagePair, Patches, StereoFeatures, StereoFrame
from slam.errors import PartError, SlamError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp
from slam.sequences.calibration import rig_from_transform
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject, require_line
from tests.fuzz.hostile import VALUES, choose
from tests.fuzz.library import _require_estimate, _require_sound
from tests.slam.test_interrupted import Lines

Array = np.ndarray

_FRAMES = 5
_BACKENDS = ("ekf", "smoother")
_WORLD = "synthetic:desk?frames=5&width=224&height=160"
_NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, -1e300, 1e9, 1e-300)


@lru_cache(maxsize=3)
def _recording(kind: str) -> tuple[StereoRig, tuple[StereoFrame, ...], tuple[StereoFeatures, ...]]:
    """A rig, what its cameras see, and the features with their images."""
    world = slam.open_sequence(_WORLD + ("&rig=toedin" if kind == "toedin" else ""))
    rig, frames = world.rig, tuple(world)
    if kind == "fisheye":
        rig = _fisheye()
    frontend = SurfFrontend(rig, features=150)
    return rig, frames, tuple(frontend.extract(frame) for frame in frames)


def _fisheye() -> StereoRig:
    """Fisheye cameras, turned against each other."""
    size = {"width": 224, "height": 160}
    k = (0.02, -0.01, 0.003, -0.001)
    left = PinholeCamera(150, 150, 112, 80, **size, distortion=k, model="equidistant")
    right = PinholeCamera(151, 149, 111, 81, **size, distortion=k, model="equidistant")
    return rig_from_transform(left, right, exp(np.array([0.01, -0.02, 0.01, -0.12, 0.0, 0.0])))


class _Misbehaving(SurfFrontend):
    """The SURF front end, whose answers are spoilt now and then."""

    def __init__(self, rig: StereoRig, rng: np.random.Generator) -> None:
        super().__init__(rig, features=150)
        self.rng, self.wild = rng, True

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        features = super().extract(frame)
        return _spoilt(self.rng, features) if self.wild and self.rng.random() < 0.2 else features

    def patches(self, images: ImagePair, uv_left: Array, size: Array) -> Any:
        patches = super().patches(images, uv_left, size)
        return _spoilt_patches(self.rng, patches) if self.wild and self.rng.random() < 0.3 else patches

    def align(self, images: ImagePair, patches: Patches, warps: Array, uv_left: Array, uv_right: Array) -> Any:
        found = super().align(images, patches, warps, uv_left, uv_right)
        return _spoilt_pixels(self.rng, found) if self.wild and self.rng.random() < 0.3 else found


class _Defect(Exception):  # noqa: N818 it says what it is
    """Raised by a front end from elsewhere."""


def _spoilt(rng: np.random.Generator, features: StereoFeatures) -> Any:
    """Features whose images, sizes or pixels are not as documented, or missing."""
    images = features.images
    assert images is not None
    kind = int(rng.integers(7))
    if kind == 0:
        return replace(features, images=choose(rng, (*VALUES, None)))
    if kind == 1:
        return replace(features, images=replace(images, right=None))
    if kind == 2:
        return replace(features, scale=features.scale * choose(rng, (0.0, -1.0, 1e-300, 1e300, 10.0, np.nan)))
    if kind == 3:
        return replace(features, uv_right=choose(rng, (features.uv_right[:, 0], features.uv_left * np.nan, VALUES)))
    if kind == 4:
        return choose(rng, (None, features.uv_left, images, StereoFeatures.empty(features.stamp, 64)))
    left, right = _spoilt_image(rng, images.left), images.right
    if right is not None and rng.random() < 0.5:
        right = _spoilt_image(rng, right)
    return replace(features, images=ImagePair(left, right))


def _spoilt_image(rng: np.random.Generator, image: Array) -> Any:
    """An image of another size or type, or full of what is no brightness."""
    frozen = image.copy()
    frozen.setflags(write=False)
    return choose(
        rng,
        (
            image[:90], image[:, :90], image[:0], image[None], np.dstack([image] * 3), image[::2, ::2], None,
            image.astype(np.uint8), image.astype(np.uint16) * 200, image.astype(float), image.astype(">f4"),
            image.astype(complex), image.tolist(), frozen, np.asfortranarray(image), image[::-1, ::-1],
            np.full_like(image, np.nan), np.full_like(image, np.inf), np.full_like(image, 1e38), np.zeros_like(image),
            -image, "x",
        ),
    )  # fmt: skip


def _spoilt_patches(rng: np.random.Generator, patches: Patches) -> Any:
    """Patches of other shapes or numbers, none, or an exception."""
    kind = int(rng.integers(6))
    if kind == 0:
        raise _Defect("patches")
    if kind == 1:
        return choose(rng, (None, patches.images, (), Patches.none()))
    if kind == 2:
        return patches.select(np.arange(max(len(patches) - 1, 0)))
    name = choose(rng, ("images", "centres", "size"))
    array = getattr(patches, name)
    if kind == 3:
        shapes = (array[:-1], array[..., None], array.ravel(), array[..., :2], array.astype("U8"), None, array.tolist())
        return replace(patches, **{name: choose(rng, shapes)})
    with np.errstate(all="ignore"):
        return replace(patches, **{name: np.full_like(array, choose(rng, _NUMBERS))})


def _spoilt_pixels(rng: np.random.Generator, found: tuple[Array, Array]) -> Any:
    """Pixels of another shape, far away, none, or an exception."""
    kind = int(rng.integers(6))
    if kind == 0:
        raise _Defect("align")
    if kind == 1:
        return choose(rng, (None, found[0], (), (*found, found[0]), (None, None), [1]))
    left, right = found[0].copy(), found[1].copy()
    if kind == 2:
        shape = choose(rng, (left[:-1], left[:, :1], left[None], left.T, left.astype("U8"), left.tolist(), left > 0))
        return (shape, right) if rng.random() < 0.5 else (left, shape)
    spoilt = choose(rng, (left, right))
    spoilt[rng.random(spoilt.shape) < choose(rng, (0.1, 0.5, 1.0))] = choose(rng, _NUMBERS)
    return left, right


def _aligning(rig: StereoRig, frontend: Any, backend: str) -> StereoSlam:
    config = SystemConfig.for_kind("handheld", None, backend)
    config = replace(config, association=replace(config.association, align=True))
    return StereoSlam(rig, frontend, backend, config=config)


def images_of_features(rng: np.random.Generator, folder: Path) -> None:
    """Features given to a system whose front end aligns them: with and without images, of this rig or of none."""
    rig, _, given = _recording(choose(rng, ("rectified", "toedin", "fisheye")))
    system = _aligning(rig, SurfFrontend(rig, features=150), choose(rng, _BACKENDS))
    system.process_features(given[0])
    for features in given[1:4]:
        try:
            _check(system.process_features(_spoilt(rng, features) if rng.random() < 0.6 else features))
        except SlamError as error:
            require_line(error)
    _check(system.process_features(given[4]))
    _require_estimate(system.estimate())


def front_ends(rng: np.random.Generator, folder: Path) -> None:
    """A front end whose answers are wrong now and then; the frames after them must be taken."""
    rig, frames, _ = _recording(choose(rng, ("rectified", "toedin", "fisheye")))
    frontend = _Misbehaving(rig, rng)
    backend = choose(rng, _BACKENDS)
    system = _aligning(rig, frontend, backend)
    for frame in frames[:-1]:
        try:
            _check(system.process(_dimmed(rng, frame)))
        except SlamError as error:
            require_line(error)
            if isinstance(error, PartError) and not isinstance(error.__cause__, _Defect):
                raise Broken("an answer was not looked at") from error
        if backend == "ekf" and rng.random() < 0.2:
            system = pickle.loads(pickle.dumps(system)) if rng.random() < 0.5 else copy.deepcopy(system)
    assert isinstance(system.frontend, _Misbehaving)
    system.frontend.wild = False
    _check(system.process(frames[-1]))
    _require_estimate(system.estimate())


def interrupts(rng: np.random.Generator, folder: Path) -> None:
    """An interrupt at any line of a step with images: the frames after it are taken."""
    rig, frames, _ = _recording(choose(rng, ("rectified", "toedin")))
    backend = choose(rng, _BACKENDS)
    system = _aligning(rig, SurfFrontend(rig, features=150), backend)
    for frame in frames[:2]:
        system.process(frame)
    try:
        with Lines(int(10 ** rng.uniform(0, 3.5))).watched():
            system.process(frames[2])
    except KeyboardInterrupt:
        pass
    if backend == "ekf" and rng.random() < 0.5:
        system = pickle.loads(pickle.dumps(system)) if rng.random() < 0.5 else copy.deepcopy(system)
    for frame in frames[3:]:
        result = system.process(frame)
        _check(result)
        if not result.status.measured:
            raise Broken(f"a frame after an interrupt is {result.status}: {result.reason}")
    _require_estimate(system.estimate())


def same_bytes(rng: np.random.Generator, folder: Path) -> None:
    """Frames, some of them dark or without a right image, by systems that must not differ."""
    rig, frames, _ = _recording(choose(rng, ("rectified", "toedin", "fisheye")))
    frames = tuple(_dimmed(rng, frame) for frame in frames)
    backend, at = choose(rng, _BACKENDS), int(rng.integers(1, len(frames)))
    system = _aligning(rig, SurfFrontend(rig, features=150, threads=1), backend)
    start = b"".join(_bytes(system.process(frame)) for frame in frames[:at])
    copies = [system]
    if backend == "ekf":  # the smoother's cannot be copied
        copies += [copy.deepcopy(system), pickle.loads(pickle.dumps(system))]
    ends = [b"".join(_bytes(one.process(frame)) for frame in frames[at:]) for one in copies]
    for threads, overlap in ((2, True), (2, False)):
        other = _aligning(rig, SurfFrontend(rig, features=150, threads=threads), backend)
        whole = b"".join(_bytes(result) for _, result in other.run(frames, overlap))
        if whole != start + ends[0]:
            raise Broken(f"two threads, overlap {overlap}: other bytes")
    if len(set(ends)) > 1:
        raise Broken("a copy goes on with other bytes")


def _bytes(result: slam.FrameResult) -> bytes:
    """All numbers of a step."""
    e, f = result.estimate, result.features
    arrays = (e.T_world_left, e.covariance, result.matched, result.added, f.uv_left, f.uv_right, f.descriptors)
    return b"".join(array.tobytes() for array in arrays)


def _dimmed(rng: np.random.Generator, frame: StereoFrame) -> StereoFrame:
    """A frame; now and then one that is black, without a right image, of 16 bits or in colour."""
    left, right = frame.left, frame.right
    assert right is not None
    kind = int(rng.integers(12))
    if kind == 0:
        return replace(frame, right=None)
    if kind == 1:
        return replace(frame, left=np.zeros_like(left))
    if kind == 2:
        return replace(frame, left=left.astype(np.uint16) * 257, right=right.astype(np.uint16) * 257)
    if kind == 3:
        return replace(frame, left=np.dstack([left] * 3), right=np.zeros_like(right))
    return frame


def _check(result: slam.FrameResult) -> None:
    """A step is sound, and does not hold the images."""
    _require_sound(result.estimate.T_world_left, result.estimate.covariance, "a frame's pose")
    if result.features.images is not None:
        raise Broken("a result holds the images")
    if np.isinf(result.features.uv_right).any() or not np.isfinite(result.features.uv_left).all():
        raise Broken("a feature's pixel is not finite")


SUBJECTS = (
    Subject("images of features", "features with images of other sizes and types, three kinds of rig",
            "a sound result or one line", images_of_features, short=8),
    Subject("front ends", "front ends whose features, patches and aligned pixels are wrong, or that raise",
            "a sound result or one line; later frames are taken", front_ends, short=8),
    Subject("interrupts", "interrupts at any line of a step with images, then copies", "the next frames are tracked",
            interrupts, short=6),
    Subject("same bytes", "images, some dark or without a right one; copies, one thread or two, overlap or none",
            "the same bytes", same_bytes, short=4),
)  # fmt: skip
