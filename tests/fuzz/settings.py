"""Settings, in the library's configuration classes and as texts; what is accepted must work."""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import slam
from backends.ekf.filter import EkfConfig
from backends.smoother.config import SmootherConfig
from frontends.surf.config import SurfConfig
from slam.bodies.config import ObjectsConfig
from slam.calibration.config import SelfCalibrationConfig
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels, MotionModel, ObjectModels
from slam.system import StereoSlam
from slam.tracks.config import AssociationConfig, MapConfig
from tests.fuzz.harness import Subject
from tests.fuzz.hostile import NUMBERS, VALUES, choose

FRAMES = 4

CLASSES = (
    SurfConfig, EkfConfig, SmootherConfig, MapConfig, AssociationConfig, SelfCalibrationConfig, ObjectsConfig,
    EstimatorModels, MotionModel, ObjectModels, SystemConfig,
)  # fmt: skip

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


def construct(rng: np.random.Generator, folder: Path) -> None:
    """A configuration class with hostile values in some fields."""
    kind = choose(rng, CLASSES)
    names = [f.name for f in fields(kind)]
    chosen = {choose(rng, names): choose(rng, VALUES) for _ in range(int(rng.integers(1, 3)))}
    config = kind(**chosen)
    if isinstance(config, SurfConfig) or (isinstance(config, ObjectsConfig) and config.database):
        return
    _run(_with(config), choose(rng, ("ekf", "smoother")))


def _with(config: Any) -> SystemConfig:
    """Everything at its default but one part."""
    if isinstance(config, SystemConfig):
        return config
    if isinstance(config, (EkfConfig, SmootherConfig)):
        return SystemConfig(backend={})
    if isinstance(config, (MotionModel, ObjectModels)):
        part = {"motion" if isinstance(config, MotionModel) else "objects": config}
        return SystemConfig(models=EstimatorModels(**part))
    names = {AssociationConfig: "association", MapConfig: "map", EstimatorModels: "models", ObjectsConfig: "objects"}
    return SystemConfig(**{names.get(type(config), "self_calibration"): config})


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


SUBJECTS = (
    Subject("configuration classes", construct, quiet=False, short=60),
    Subject("settings", texts, quiet=False, short=60),
)
