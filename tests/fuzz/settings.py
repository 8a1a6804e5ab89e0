"""Settings as texts; what is accepted must work."""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import slam
from backends.ekf import EkfConfig
from backends.smoother.config import SmootherConfig
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.system import StereoSlam
from tests.fuzz.harness import Subject
from tests.fuzz.mutations import NUMBERS, choose

FRAMES = 4

TEXTS = (
    *NUMBERS, "[" * 100_000, "[" * 900 + "]" * 900, "{" * 50, "[1, 2", "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    "[[1,0,0,1e308],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    "[1e308]", "[" + "1," * 3000 + "1]", '"' * 3, "a\nb", "a\0b", "1e9",
    "1e-9", "1000000", "0.5", "[0.5, 0.5]", "[8, 4]", "[1000, 1000]", "1e10", "NaN", "Infinity", "[NaN]", "{}", "[]",
)  # fmt: skip


@lru_cache(maxsize=1)
def scene() -> tuple[StereoRig, tuple[StereoFeatures, ...]]:
    """A rig and what it sees of a small world, frame by frame."""
    world = slam.open_sequence("synthetic:desk?frames=5&density=6&seed=1")
    return world.rig, tuple(world.observations(k) for k in range(5))


def texts(rng: np.random.Generator, folder: Path) -> None:
    """``section.key=value`` texts, and trees of JSON with hostile leaves."""
    backend = choose(rng, ("ekf", "smoother"))
    default = SystemConfig.for_kind(choose(rng, ("handheld", "driving")))
    chosen = [_setting(rng, default.to_json(), backend) for _ in range(int(rng.integers(1, 4)))]
    config = default.with_settings(chosen)
    if config.objects.database:
        return
    _run(config, backend)


def _setting(rng: np.random.Generator, tree: dict[str, Any], backend: str) -> str:
    """One setting, most often of a key that there is."""
    if rng.random() < 0.05:
        return choose(
            rng, ("=", "map", "map.=1", ".=", "map.a.b.c=1", "x=1", "map.grid.x=1", "é.ü=1", "." * 5000 + "=1")
        )
    section = choose(rng, (*tree, "backend", "models"))
    options = {"ekf": EkfConfig, "smoother": SmootherConfig}[backend]
    keys = [f.name for f in fields(options)] if section == "backend" else list(tree[section]) or ["features", "grid"]
    key = choose(rng, keys)
    if isinstance(tree[section].get(key), dict):
        key = f"{key}.{choose(rng, list(tree[section][key]))}"
    default = tree[section].get(key)
    value = choose(rng, TEXTS)
    if isinstance(default, (int, float)) and not isinstance(default, bool) and rng.random() < 0.5:
        value = repr(type(default)(default * 10.0 ** rng.integers(-12, 12)))
    return f"{section}.{key}={value}"


def _run(config: SystemConfig, backend: str) -> None:
    """A few frames with what was accepted."""
    rig, frames = scene()
    system = StereoSlam(rig, None, backend, config=config)
    for features in frames[:FRAMES]:
        system.process_features(features)


SUBJECTS = (Subject("settings", texts, quiet=False, short=60),)
