"""Public classes and functions with hostile values, and hostile frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import slam
from slam.atlas.map_io import SavedMap
from slam.config import SystemConfig
from slam.data import Observations, StereoFeatures, StereoFrame
from slam.errors import SlamError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.system import StereoSlam
from tests.fuzz.harness import Subject, require_line
from tests.fuzz.hostile import NUMBERS, VALUES, choose

CLASSES = (StereoRig, PinholeCamera, Trajectory, Observations, StereoFeatures, SavedMap)
RIG = StereoRig.rectified_pair(300, 159.5, 119.5, 0.12, 320, 240)

_STAMPS = (
    None, "x", np.nan, np.inf, -np.inf, -1.0, 0.0, 1e9, 1e18, 1e300, 10**400, 1j, True, np.float32(1), [1.0],
)  # fmt: skip


def made_of_anything(rng: np.random.Generator, folder: Path) -> None:
    """A public class made of hostile values."""
    kind = choose(rng, CLASSES)
    arrays = (np.zeros(0), np.zeros(3), np.zeros((3, 2)), np.zeros((3, 3)), np.zeros((0, 4, 4)), np.arange(3))
    kind(**{f.name: choose(rng, (*VALUES, *arrays)) for f in fields(kind)})


def functions(rng: np.random.Generator, folder: Path) -> None:
    """Public functions and methods of sequences with hostile arguments."""
    world = slam.open_sequence("synthetic:desk?frames=3&width=96&height=72")
    path = folder / "x"
    path.write_bytes(rng.bytes(50))
    value = choose(rng, (*VALUES, *NUMBERS, path, str(path), folder))
    other = choose(rng, (*VALUES, *NUMBERS, 1, 2))

    def system(**options: Any) -> StereoSlam:
        return StereoSlam(world.rig, **{"frontend": None, "backend": "ekf", **options})

    calls: tuple[Callable[[], Any], ...] = (
        lambda: slam.open_sequence(value),
        lambda: slam.open_sequence("synthetic:desk?frames=2", format=value),
        lambda: slam.load_map(value),
        lambda: slam.load_calibration(value),
        lambda: list(world.frames(value, other)),
        lambda: world.frame(value),
        lambda: world.observations(value),
        lambda: system(frontend=value, backend=other),
        *(lambda name=name: system(**{name: value}) for name in ("kind", "config", "prior_map", "rig_prior")),
        lambda: StereoSlam(value, None, "ekf"),
        lambda: system().process(value, other, 0.0),
        lambda: system().process_features(value),
        lambda: list(system(frontend="surf").run(value)),
        lambda: list(system(frontend="surf").run([*world, value], overlap=bool(rng.random() < 0.5))),
        lambda: SystemConfig.for_kind(value, other),
        lambda: SystemConfig().with_settings(value),
        lambda: SystemConfig.from_json(value),
    )
    choose(rng, calls)()


def hostile_images(rng: np.random.Generator, folder: Path) -> None:
    """A frame whose images are none, or not of the rig's size or type, between two good ones."""
    system = StereoSlam(RIG, "surf", choose(rng, ("ekf", "smoother")))
    good = rng.integers(0, 256, (240, 320), dtype=np.uint8)
    images = (
        good, good, None, good[:100], good[:0], good[::2, ::2], good[None], np.dstack([good] * 3),
        np.dstack([good] * 2), good.astype(float), good.astype(np.int64), good.astype(np.uint16) * 200, good > 9,
        good.astype(object), good.astype(complex), np.full((240, 320), np.nan), good[::-1, ::-1],
        np.asfortranarray(good), good.tolist(), "x",
    )  # fmt: skip
    system.process(StereoFrame(0, 0.0, good, good))
    index = choose(rng, VALUES) if rng.random() < 0.1 else 1
    stamp = choose(rng, _STAMPS) if rng.random() < 0.2 else 0.1
    frame: Any = StereoFrame(index, stamp, choose(rng, images), choose(rng, images))
    if rng.random() < 0.05:
        frame = choose(rng, VALUES)
    try:
        stamp = system.process(frame).estimate.stamp
    except SlamError as error:
        require_line(error)
        stamp = 0.1
    system.process(StereoFrame(2, stamp + 0.1 * max(1.0, abs(stamp)), good, good))


SUBJECTS = (
    Subject("public classes", made_of_anything, quiet=False, short=60),
    Subject("public functions", functions, quiet=False, short=40),
    Subject("images", hostile_images, quiet=False, short=8),
)
