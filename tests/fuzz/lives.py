"""Whole lives of a system: frames, questions, copies, maps, interrupts and threads in any order."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import slam
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.errors import CopyError, SlamError
from slam.geometry.rig import StereoRig
from slam.mapping.map_io import load_map, save_map
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject, require_line
from tests.fuzz.hostile import choose
from tests.fuzz.library import _require_estimate, _require_sound
from tests.slam.test_interrupted import Lines

_FRAMES = 40
_SETTINGS = (
    [], [], ["atlas.on_disk=true"], ["atlas.enabled=false"], ["map.max_landmarks=30"],
    ["self_calibration.enabled=false"],
    ["atlas.agreeing=1", "atlas.inliers=5", "atlas.return_depths=0.5"], ["map.lost_after=2"], ["objects.mode=off"],
    ["atlas.keyframe_share=1.0", "atlas.features=5"], ["association.consistency_sigmas=0.5"],
)  # fmt: skip


@lru_cache(maxsize=2)
def _recording(kind: str) -> tuple[StereoRig, tuple[StereoFeatures, ...]]:
    """A camera before a desk with features without images; there and back again, so that places are seen again."""
    world = slam.open_sequence(f"synthetic:desk?frames={_FRAMES}&density=8{'&rig=toedin' if kind == 'toedin' else ''}")
    there = [world.observations(k) for k in range(_FRAMES)]
    return world.rig, tuple(replace(f, stamp=k / 15) for k, f in enumerate([*there, *there[::-1], *there]))


class _Life:
    """A system on its way, and which frame is next."""

    def __init__(self, rng: np.random.Generator, folder: Path) -> None:
        self.rng, self.folder, self.next, self.known = rng, folder, 0, False
        self.rig, self.frames = _recording(choose(rng, ("rectified", "toedin")))
        self.backend = choose(rng, ("ekf", "ekf", "smoother"))
        self.config = SystemConfig.for_kind(choose(rng, ("handheld", "driving")), None, self.backend)
        self.config = self.config.with_settings(choose(rng, _SETTINGS))
        self.system = StereoSlam(self.rig, None, self.backend, config=self.config)

    def _features(self) -> StereoFeatures:
        """The next frame's, that of a later one, or nothing to be seen."""
        self.next += int(choose(self.rng, (1, 1, 1, 1, 1, 3, 20)))
        features = replace(self.frames[self.next % len(self.frames)], stamp=self.next / 15)
        return StereoFeatures.empty(features.stamp, 64) if self.rng.random() < 0.1 else features

    def step(self) -> None:
        for _ in range(int(self.rng.integers(1, 5))):
            result = self.system.process_features(self._features())
            if result.located:
                _require_sound(result.estimate.T_world_left, result.estimate.covariance, "a frame's pose")

    def ask(self) -> None:
        repr(self.system), len(self.system.trajectory()), self.system.roll_back(), self.system.warnings
        if self.next and not self.known:
            _require_estimate(self.system.estimate())

    def duplicate(self) -> None:
        try:
            twin = pickle.loads(pickle.dumps(self.system)) if self.rng.random() < 0.5 else copy.deepcopy(self.system)
        except CopyError:
            if self.backend == "ekf":
                raise
            return
        features = self._features()
        first, second = (one.process_features(features).estimate for one in (self.system, twin))
        if first.T_world_left.tobytes() != second.T_world_left.tobytes():
            raise Broken("a copy goes on with other bytes")
        self.system = twin

    def keep(self) -> None:
        """Save the map, and go on in it, in a new system or the same."""
        path = self.folder / "a.map"
        save_map(path, self.system)
        loaded = load_map(path)
        if self.rng.random() < 0.6:
            self.system, self.known = (
                StereoSlam(self.rig, None, self.backend, config=self.config, prior_map=loaded),
                True,
            )

    def interrupt(self) -> None:
        try:
            with Lines(int(10 ** self.rng.uniform(0, 3.5))).watched():
                choose(self.rng, (lambda: self.system.process_features(self._features()), self.system.estimate,
                                  self.system.trajectory, self.system.snapshot))()  # fmt: skip
        except KeyboardInterrupt:
            pass

    def elsewhere(self) -> None:
        """From another thread, alone or with this one."""
        errors: list[BaseException] = []

        def work(features: StereoFeatures) -> None:
            try:
                self.system.process_features(features)
            except BaseException as error:  # noqa: BLE001 it is looked at below
                errors.append(error)

        threads = [threading.Thread(target=work, args=(self._features(),)) for _ in range(int(self.rng.integers(1, 3)))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for error in errors:
            if not isinstance(error, SlamError):
                raise error

    def odd(self) -> None:
        """A frame from the past, or of another length of descriptors."""
        features = self._features()
        late = replace(features, stamp=features.stamp - 100)
        short = replace(features, descriptors=features.descriptors[:, :16])
        self.system.process_features(choose(self.rng, (late, short)))


def lives(rng: np.random.Generator, folder: Path) -> None:
    """One life; the frames at its end are taken."""
    life = _Life(rng, folder)
    acts: tuple[Callable[[], None], ...] = (
        life.step, life.step, life.step, life.ask, life.duplicate, life.keep, life.interrupt, life.elsewhere, life.odd,
    )  # fmt: skip
    for _ in range(int(rng.integers(5, 15))):
        try:
            choose(rng, acts)()
        except SlamError as error:
            require_line(error)
    life.step()
    life.ask()


SUBJECTS: tuple[Any, ...] = (
    Subject("lives", "frames, questions, copies, saved maps, interrupts and threads in any order",
            "sound results or one line; copies go on with the same bytes; later frames are taken", lives, quiet=False,
            short=12),
)  # fmt: skip
