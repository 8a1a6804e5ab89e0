"""The whole system against a plain model of what it has to keep count of."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import slam
from slam.atlas.config import AtlasConfig
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.errors import SlamError
from slam.system import StereoSlam
from slam.tracks.config import MapConfig
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.mutations import choose

_WORLDS = ("synthetic:desk?frames=60&density=6&seed=1", "synthetic:box?frames=90&density=300")
_KINDS = ("usual", "usual", "usual", "usual", "usual", "dark", "dim", "one-eyed", "strange", "late")


@cache
def _world(name: str) -> tuple[slam.StereoRig, tuple[StereoFeatures, ...]]:
    """A rig and what it sees: a desk all around, or a shelf before which a box moves."""
    world = slam.open_sequence(name)
    return world.rig, tuple(world.observations(k) for k in range(50, 60 if "desk" in name else 84))


def _changed(rng: np.random.Generator, features: StereoFeatures, kind: str) -> StereoFeatures:
    """More or less of what is in a frame."""
    features = features.select(rng.random(len(features)) < {"dark": 0.0, "dim": 0.1}.get(kind, 1.0))
    if kind == "one-eyed":
        features = replace(features, uv_right=np.full_like(features.uv_right, np.nan))
    return replace(features, descriptors=rng.permutation(features.descriptors)) if kind == "strange" else features


def keep_books(rng: np.random.Generator, folder: Path) -> None:
    """Frames in order or not, whole or not, with questions in between."""
    rig, frames = _world(choose(rng, _WORLDS))
    in_view, loops = int(rng.integers(3, 60)), bool(rng.random() < 0.3)
    most, counts = in_view + int(rng.integers(0, 80)), ("lost_after", "restart_after", "erase_missed")
    limits = MapConfig(
        target_in_view=in_view, max_landmarks=most, **{name: int(rng.integers(1, 4)) for name in counts},
        confirmed=int(rng.integers(0, 4)), forget_after=int(rng.integers(0, 4)),
    )  # fmt: skip
    config = SystemConfig(map=limits, atlas=AtlasConfig(enabled=loops))
    system = StereoSlam(rig, None, choose(rng, ("ekf", "ekf", "smoother")), config=config)
    held, ever, bodies_ever, bodies, stamp, at = set(), set(), set(), set(), 0.0, int(rng.integers(len(frames)))
    for index in range(int(rng.integers(3, 16))):
        at = at + 1 if rng.random() < 0.85 and at + 1 < len(frames) else int(rng.integers(len(frames)))
        kind = choose(rng, _KINDS)
        stamp += 1.0 if kind == "late" else 0.05
        features = _changed(rng, replace(frames[at], stamp=stamp), kind)
        try:
            result = system.process_features(features)
            estimate = system.estimate() if rng.random() < 0.5 else None
        except SlamError as error:
            raise Broken(f"a good frame or question is refused: {error}") from error
        report, ids = result.report, [thing.id for thing in result.objects]
        matched, used, rejected, added, erased, returned = (
            set(rows.tolist())
            for rows in (result.matched, report.used, report.rejected, result.added, result.erased, result.returned)
        )
        rows = [*result.matched_features.tolist(), *result.added_features.tolist()]
        moving = result.moving_features.tolist()
        after = (held | added | returned) - erased
        now = set() if system.landmarks is None else set(system.landmarks.ids.tolist())
        for promise, kept in {
            "frames are numbered, with their stamps": result.index == index and result.estimate.stamp == stamp,
            "ids of new landmarks are new": not added & ever,
            "places come back where they are kept": loops or not returned,
            "what is matched is in the map": matched <= held | returned,
            "what is used or rejected was matched, and not both": used | rejected <= matched and not used & rejected,
            "what is erased was there": erased <= held | added | returned,
            "the map is what joined it and did not leave": now == after,
            "the map is counted, and no larger than allowed": result.map_size == len(after) <= most,
            "a feature is one landmark, or moves": len(set(rows)) == len(rows) and not set(rows) & set(moving),
            "features are the frame's": all(0 <= row < len(features) for row in (*rows, *moving)),
            "bodies have ids of their own": ids == sorted(set(ids)) and not (set(ids) - bodies) & bodies_ever,
        }.items():
            if not kept:
                raise Broken(f"frame {index}: {promise}")
        held, ever, bodies, bodies_ever = after, ever | added | returned, set(ids), bodies_ever | set(ids)
        if estimate is not None and (estimate.ids.tolist() != sorted(held) or len(estimate.covariances) != len(held)):
            raise Broken("the estimate's landmarks are not those that were added and not erased")
    path = system.trajectory()
    if not np.isfinite(path.poses).all() or path.stamps[-1] != stamp:
        raise Broken("the path is not that of the frames")


SUBJECTS = (Subject("bookkeeping", keep_books, short=12),)
