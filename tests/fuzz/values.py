"""Public classes and functions of the library, made and called with hostile values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import slam
from slam.atlas.map_io import SavedMap
from slam.config import SystemConfig
from slam.data import Observations, StereoFeatures
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.system import StereoSlam
from tests.fuzz.harness import Subject
from tests.fuzz.hostile import NUMBERS, VALUES, choose

CLASSES = (StereoRig, PinholeCamera, Trajectory, Observations, StereoFeatures, SavedMap)


def made_of_anything(rng: np.random.Generator, folder: Path) -> None:
    """A public class made of hostile values, shown if it can be."""
    kind = choose(rng, CLASSES)
    arrays = (np.zeros(0), np.zeros(3), np.zeros((3, 2)), np.zeros((3, 3)), np.zeros((0, 4, 4)), np.arange(3))
    values = {f.name: choose(rng, (*VALUES, *arrays)) for f in fields(kind)}
    kind(**values)


def functions(rng: np.random.Generator, folder: Path) -> None:
    """Public functions and methods of sequences with hostile arguments."""
    world = slam.open_sequence("synthetic:desk?frames=3&width=96&height=72")
    path = folder / "x"
    path.write_bytes(rng.bytes(50))
    value = choose(rng, (*VALUES, *NUMBERS, path, str(path), folder))
    other = choose(rng, (*VALUES, *NUMBERS, 1, 2))
    calls: tuple[Callable[[], Any], ...] = (
        lambda: slam.open_sequence(value),
        lambda: slam.open_sequence("synthetic:desk?frames=2", format=value),
        lambda: slam.load_map(value),
        lambda: slam.load_calibration(value),
        lambda: list(world.frames(value, other)),
        lambda: world.frame(value),
        lambda: world.observations(value),
        lambda: StereoSlam(world.rig, value, other),
        lambda: StereoSlam(world.rig, None, "ekf", kind=value),
        lambda: StereoSlam(world.rig, None, "ekf", config=value),
        lambda: StereoSlam(world.rig, None, "ekf", prior_map=value),
        lambda: StereoSlam(world.rig, None, "ekf", rig_prior=value),
        lambda: StereoSlam(value, None, "ekf"),
        lambda: StereoSlam(world.rig, None, "ekf").process(value, other, 0.0),
        lambda: StereoSlam(world.rig, None, "ekf").process_features(value),
        lambda: list(StereoSlam(world.rig, "surf", "ekf").run(value)),
        lambda: list(StereoSlam(world.rig, "surf", "ekf").run([*world, value], overlap=bool(rng.random() < 0.5))),
        lambda: SystemConfig.for_kind(value, other),
        lambda: SystemConfig().with_settings(value),
        lambda: SystemConfig.from_json(value),
    )
    choose(rng, calls)()


SUBJECTS = (
    Subject("public classes", made_of_anything, quiet=False, short=60),
    Subject("public functions", functions, quiet=False, short=40),
)
