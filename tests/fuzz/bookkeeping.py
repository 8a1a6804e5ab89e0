"""The whole system against a plain model of what it has to keep count of."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import slam
from slam.atlas.config import AtlasConfig
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures
from slam.errors import SlamError
from slam.system import StereoSlam
from slam.tracks.config import MapConfig
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.mutations import choose

_WORLDS = ("synthetic:desk?frames=60&density=6&seed=1", "synthetic:box?frames=90&density=300")


@cache
def _world(name: str) -> tuple[slam.StereoRig, tuple[StereoFeatures, ...]]:
    """A rig and what it sees: a desk all around, or a shelf before which a box moves."""
    world = slam.open_sequence(name)
    return world.rig, tuple(world.observations(k) for k in range(50, 60 if "desk" in name else 84))


class Books:
    """A system, and what is known of it without knowing how it works."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        rig, self.frames = _world(choose(rng, _WORLDS))
        in_view = int(rng.integers(3, 60))
        self.most = in_view + int(rng.integers(0, 80))
        config = SystemConfig(
            map=MapConfig(
                target_in_view=in_view, max_landmarks=self.most, lost_after=int(rng.integers(1, 4)),
                restart_after=int(rng.integers(1, 4)), erase_missed=int(rng.integers(1, 4)),
                confirmed=int(rng.integers(0, 4)), forget_after=int(rng.integers(0, 4)),
            ),
            atlas=AtlasConfig(enabled=bool(rng.random() < 0.3)),
        )  # fmt: skip
        self.loops = config.atlas.enabled
        self.system = StereoSlam(rig, None, choose(rng, ("ekf", "ekf", "smoother")), config=config)
        self.stamps: list[float] = []
        self.stamp = 0.0
        self.map: set[int] = set()
        self.ever: set[int] = set()
        self.objects: set[int] = set()
        self.objects_ever: set[int] = set()

    def step(self, at: int, kind: str) -> None:
        """A frame of the world, with more or less of what is in it, after the usual time or a longer one."""
        self.stamp += 1.0 if kind == "late" else 0.05
        features = replace(self.frames[at], stamp=self.stamp)
        share = {"dark": 0.0, "dim": 0.1}.get(kind, 1.0)
        features = features.select(self.rng.random(len(features)) < share)
        if kind == "one-eyed":
            features = replace(features, uv_right=np.full_like(features.uv_right, np.nan))
        if kind == "strange":
            features = replace(features, descriptors=self.rng.permutation(features.descriptors))
        try:
            self._account(features, self.system.process_features(features))
        except SlamError as error:
            raise Broken(f"a good frame is refused: {error}") from error

    def count(self) -> None:
        """What the system says it holds."""
        if not self.stamps:
            return
        try:
            estimate, path = self.system.estimate(), self.system.trajectory()
        except SlamError as error:
            raise Broken(f"a question is refused: {error}") from error
        ids = np.array(sorted(self.map), np.int64)
        shapes = [estimate.positions.shape, estimate.covariances.shape, estimate.covariance.shape]
        if not np.array_equal(estimate.ids, ids) or shapes != [(len(ids), 3), (len(ids), 3, 3), (6, 6)]:
            raise Broken("the estimate's landmarks are not those that were added and not erased")
        rows = self.system.landmarks
        if rows is None or not np.array_equal(np.sort(rows.ids), ids):
            raise Broken("the rows of the map are not those that were added and not erased")
        if not np.isin(self.stamps, path.stamps).all() or not np.isfinite(path.poses).all():
            raise Broken("the path is not that of the frames")

    def _account(self, features: StereoFeatures, result: FrameResult) -> None:
        """Check a result by what was there before, and keep count."""
        if result.index != len(self.stamps) or result.estimate.stamp != features.stamp:
            raise Broken(f"frame {len(self.stamps)} is called {result.index}, at {result.estimate.stamp}")
        matched, used, rejected, added, erased, returned = (
            _set(ids)
            for ids in (result.matched, result.report.used, result.report.rejected, result.added, result.erased,
                        result.returned)
        )  # fmt: skip
        if added & self.ever:
            raise Broken(f"ids of new landmarks were used before: {sorted(added & self.ever)[:5]}")
        self.ever |= added | returned  # a place may return with features that were no landmarks
        now = _set(() if self.system.landmarks is None else self.system.landmarks.ids)
        if not now - self.map - added <= returned or (returned and not self.loops):
            raise Broken("a landmark joined the map unannounced, or came back although no places are kept")
        if not matched <= self.map | returned or not used | rejected <= matched or used & rejected:
            raise Broken("landmarks were matched, used or rejected that are not in the map, or both")
        if not erased <= self.map | added | returned:
            raise Broken("a landmark was erased that was not there")
        self.map = (self.map | added | returned) - erased
        if result.map_size != len(self.map) or len(self.map) > self.most:
            raise Broken(f"the map has {result.map_size} landmarks, of {len(self.map)} counted and {self.most} allowed")
        rows = [*result.matched_features.tolist(), *result.added_features.tolist()]
        if len(set(rows)) != len(rows) or set(rows) & _set(result.moving_features):
            raise Broken("a feature is two landmarks, or one that moves")
        if any(not 0 <= row < len(features) for row in (*rows, *result.moving_features.tolist())):
            raise Broken("a feature is none of the frame's")
        self._check_objects(result)
        self.stamps.append(features.stamp)

    def _check_objects(self, result: FrameResult) -> None:
        """The moving bodies: each with an id of its own, that no other one had before."""
        ids = [thing.id for thing in result.objects]
        if ids != sorted(set(ids)) or (set(ids) - self.objects) & self.objects_ever:
            raise Broken(f"moving objects are numbered {ids}")
        self.objects = set(ids)
        self.objects_ever |= self.objects


_KINDS = ("usual", "usual", "usual", "usual", "usual", "dark", "dim", "one-eyed", "strange", "late")


def keep_books(rng: np.random.Generator, folder: Path) -> None:
    """Frames in order or not, whole or not, with questions in between."""
    books = Books(rng)
    at = int(rng.integers(len(books.frames)))
    for _ in range(int(rng.integers(3, 16))):
        at = at + 1 if rng.random() < 0.85 and at + 1 < len(books.frames) else int(rng.integers(len(books.frames)))
        books.step(at, choose(rng, _KINDS))
        if rng.random() < 0.1 and books.stamps:
            books.system.estimate()
        if rng.random() < 0.4:
            books.count()
    books.count()


def _set(ids: object) -> set[int]:
    return set(np.asarray(ids).tolist())


SUBJECTS = (Subject("bookkeeping", keep_books, short=12),)
