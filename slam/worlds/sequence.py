"""A recording of a world: images, or observations without images, and the truth of both."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from slam.data import BoolArray, StereoFeatures, StereoFrame
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.stamps import frame_range, require_frame
from slam.geometry.trajectory import Trajectory
from slam.naming import sequence_line
from slam.worlds.observe import Appearance, SimulatedFeatures, appearance, simulate
from slam.worlds.options import faulty_frames
from slam.worlds.world import World

Masks = tuple[BoolArray | None, BoolArray | None]  #: of both cameras (H, W), see `slam.data.StereoFrame`


class WorldSequence:
    """A recording of a built-in world, made when asked for; frame k is the same however it is asked for.

    Attributes:
        name: text that opens it again, such as ``"aisle?frames=200&seed=3"``.
        format: ``"synthetic"``.
        kind: of motion, ``"handheld"`` or ``"driving"``.
        world: what is recorded.
        values: the values of all options.
        rig: the stereo rig as the system is told of it; `world.rig` is the true one.
        stamps: times of the frames (N,) [s].
        landmarks: of the world; the row is the id.
        ground_truth: pose of the left camera at every frame.
        warnings: lines of what was asked for beyond its end; recorded sequences have faults to report here, too.
        masks: of both cameras (H, W) bool, see `slam.data.StereoFrame`.
    """

    format = "synthetic"

    def __init__(self, name: str, world: World, values: Mapping[str, Any], rig: StereoRig | None = None) -> None:
        self.name, self.kind, self.values = name, world.kind, dict(values)
        self.world, self.landmarks = world, world.landmarks
        self.rig = world.rig if rig is None else rig
        self.warnings: list[str] = []
        self.masks: Masks = (None, None)
        self.faults = faulty_frames(values, len(world), values["seed"])
        self._kept = np.flatnonzero(~self.faults["drop"])
        self.stamps: Array = world.stamps[self._kept]
        self._images: list[StereoFrame] = []

    @cached_property
    def ground_truth(self) -> Trajectory:
        """Pose of the left camera at every frame."""
        return Trajectory(self.stamps, self.world.T_world_left[self._kept])

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[StereoFrame]:
        return self.frames()

    __repr__ = sequence_line

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """Images of frames `start` up to, but without, `stop`, each rendered when it is asked for.

        Raises:
            SequenceError: `start` is negative or not before the end, or `stop` is not after `start`.
        """
        first, last = frame_range(start, stop, len(self))
        if stop is not None and stop > last:
            self.warnings.append(f"{self.name}: frames {start}:{stop} asked for, it has {len(self)}")
            logging.getLogger("slam.worlds").warning("%s", self.warnings[-1])
        return (self.frame(k) for k in range(first, last))

    def frame(self, k: int) -> StereoFrame:
        """Images of frame k, as ``sequence[k]``; SequenceError where there is none."""
        k = require_frame(self.name, k, len(self))
        if self._images:
            return self._images[k]
        from slam.worlds.recorder import record  # with OpenCV

        source = self.source(k)
        right, black = not self.faults["dropright"][source], bool(self.faults["black"][source])
        left, *rest = record(self.world, self.values, source, right, black)
        return StereoFrame(k, float(self.stamps[k]), left, rest[0] if rest else None, *self.masks)

    __getitem__ = frame

    def keep_images(self) -> None:
        """Render all images now and keep them, for several runs on the same ones."""
        self._images = list(self)

    def depth(self, k: int) -> np.ndarray:
        """True distance along the left camera's axis in frame k (H, W) float32 [m], 0 where nothing is."""
        return self._truth(k)[0]

    def object_ids(self, k: int) -> np.ndarray:
        """Which object each pixel of frame k's left image shows (H, W) int32, 0 for the still world."""
        return self._truth(k)[1]

    def objects(self, k: int) -> Array:
        """Poses ``T_world_object`` (B, 4, 4) of the moving objects 1 to B in frame k."""
        return self.world.T_world_object[:, self.source(k)]

    def observations(self, k: int) -> StereoFeatures:
        """Features of frame k, without images."""
        return self.simulate(k).features

    def simulate(self, k: int) -> SimulatedFeatures:
        """Features of frame k with their truth, without images."""
        source = self.source(k)
        rng = np.random.default_rng([self.values["seed"], source, 1])
        seen = simulate(self.world, self._looks, self.values, source, float(self.stamps[int(k)]), rng)
        return seen.without(all_rows=self.faults["black"][source], right=self.faults["dropright"][source])

    @cached_property
    def _looks(self) -> Appearance:
        return appearance(self.world, self.values)

    def _truth(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        from slam.worlds.recorder import truth_images

        return truth_images(self.world, self.source(k))

    def source(self, k: int) -> int:
        """The world's frame that is frame k of the recording."""
        return int(self._kept[require_frame(self.name, k, len(self))])
