"""Anything may happen to a camera, at any stage of a step: no frame ends a run, and nothing refers to what is gone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures
from slam.mapping.config import MapConfig
from slam.models import EstimatorModels
from slam.runtime.stages import Stages
from slam.system import StereoSlam
from tests.slam.scene import RIG, Cloud
from tests.slam.test_interrupted import Lines

CONFIG = SystemConfig(
    models=EstimatorModels(pixel_sigma=0.5),
    map=MapConfig(target_in_view=40, max_depth_error=0.3, restart_after=2, lost_after=2),
).with_settings(["association.kidnapped_after=2", "atlas.agreeing=1", "atlas.inliers=8"])
STAGES = ("predict", "associate", "update", "estimate", "objects", "manage", "atlas")


def each(features: StereoFeatures, change: Callable[[str, np.ndarray], np.ndarray]) -> StereoFeatures:
    """Features whose arrays are changed, given their names."""
    names = [f.name for f in fields(features) if isinstance(getattr(features, f.name), np.ndarray)]
    return replace(features, **{name: change(name, getattr(features, name)) for name in names})


@contextmanager
def interrupted(name: str, line: int) -> Iterator[None]:
    """Raise KeyboardInterrupt at a line of a stage."""
    original = Stages.stage

    @contextmanager
    def stage(stages: Stages, entered: str) -> Iterator[None]:
        with original(stages, entered):
            if entered == name:
                with Lines(line).watched():
                    yield
            else:
                yield

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Stages, "stage", stage)
        yield


class Camera:
    """A camera that is tracked, moved, blinded, carried to other places, and whose steps are interrupted."""

    def __init__(self, backend: str, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.system = StereoSlam(RIG, None, backend, config=CONFIG)
        self.places = [Cloud(150, seed=seed) for seed in range(3)]
        self.place, self.x, self.stamp = 0, 0.0, 0.0
        self.map: set[int] = set()
        self.stamps: list[float] = []

    def _features(self, share: float = 1.0, noise: float = 0.3) -> StereoFeatures:
        self.stamp += 1 / 30
        T = np.eye(4)
        T[0, 3] = self.x
        features = self.places[self.place].features(T, self.stamp, noise)[0]
        keep = self.places[0].rng.random(len(features)) < share
        return each(features, lambda _, x: x[keep])

    def _process(self, features: StereoFeatures) -> None:
        result = self.system.process_features(features)
        self._account(result)
        self.stamps.append(features.stamp)

    def _account(self, result: FrameResult) -> None:
        """What a result names is in the map, before the frame or after it."""
        e, added, erased = result.estimate, set(result.added.tolist()), set(result.erased.tolist())
        now = set(self.system.landmarks.ids.tolist())
        came = now - self.map - added
        used = set(result.report.used.tolist()) | set(result.report.rejected.tolist())
        assert used <= set(result.matched.tolist())
        assert set(result.matched.tolist()) <= self.map | came
        assert not erased & now  # those of an old place may join the map and leave it in one step
        assert now == (self.map | added | came) - erased
        assert np.isfinite(e.T_world_left).all() and np.linalg.eigvalsh(e.covariance)[0] > 0
        assert result.map_size == len(now)
        self.map = now

    def act(self) -> None:
        """Whatever comes next, for one to four frames."""
        acts = (self.goes_on, self.goes_on, self.is_carried_off, self.sees_little, self.is_shaken, self.sees_two_places)
        if self.rng.random() < 0.15:
            return self.is_interrupted()
        act = acts[self.rng.integers(len(acts))]
        if act == self.is_carried_off:
            self.place, self.x = int(self.rng.integers(3)), float(self.rng.choice([0.0, 0.3, -0.5]))
        for _ in range(self.rng.integers(1, 5)):
            self._process(act())
        return None

    def goes_on(self) -> StereoFeatures:
        self.x += float(self.rng.choice([0.0, 0.01, 0.02]))
        return self._features()

    def is_carried_off(self) -> StereoFeatures:
        return self._features()

    def sees_little(self) -> StereoFeatures:
        return self._features(self.rng.choice([0.0, 0.05, 0.2]))

    def is_shaken(self) -> StereoFeatures:
        return self._features(noise=self.rng.choice([2.0, 8.0]))

    def sees_two_places(self) -> StereoFeatures:
        """Some landmarks are still used, but most of what is seen is new."""
        known = self._features(self.rng.choice([0.1, 0.2, 0.3]))
        new = self.places[self.rng.integers(3)].features(np.eye(4), self.stamp, 0.3)[0]
        return each(known, lambda name, x: np.concatenate([x, getattr(new, name)]))

    def is_interrupted(self) -> None:
        """A stage of the step is ended at one of its lines."""
        features, stage, line = self._features(), STAGES[self.rng.integers(7)], int(self.rng.integers(1, 200))
        try:
            with interrupted(stage, line):
                result = self.system.process_features(features)
        except KeyboardInterrupt:
            self.system.estimate()
            self.map = set(self.system.landmarks.ids.tolist())
        else:
            self._account(result)
            self.stamps.append(features.stamp)

    def check(self) -> None:
        """Map and back end agree, and every question is answered."""
        np.testing.assert_array_equal(self.system.estimate().ids, self.system.landmarks.ids)
        assert np.isin(self.stamps, self.system.trajectory().stamps).all()
        self.system.snapshot()


@pytest.mark.parametrize("backend", ["ekf", "smoother", "window"])
def test_no_frame_ends_a_run(backend):
    restarted = 0
    for seed in range(4):
        camera = Camera(backend, seed)
        camera._process(camera.goes_on())
        for _ in range(12):
            camera.act()
            camera.check()
        restarted += len(camera.system.restarted)
    assert restarted >= 4
