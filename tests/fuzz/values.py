"""Public classes and functions of the library, made and called with hostile values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import slam
from slam.calibration.corrected import corrected_rig
from slam.calibration.model import RigModel
from slam.config import SystemConfig
from slam.data import Observations, StereoFeatures
from slam.evaluation.metrics import absolute_errors, align, associate, relative_errors, segment_errors
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.mapping.map_io import SavedMap
from slam.sequences.calibration_files import write_kalibr, write_opencv
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.hostile import NUMBERS, VALUES, broken_bytes, broken_text, choose

_LENGTHS = (0.0, 1e-9, 1e-3, 0.1, 1.0, 50.0, 300.0, 1e4, 1e9, 1e300, -1.0, np.nan, np.inf, -np.inf)


def rigs(rng: np.random.Generator, folder: Path) -> None:
    """A rig of hostile numbers; one that is accepted can be rectified, corrected, written and used."""
    cameras = [_camera(rng) for _ in range(2)]
    R = choose(
        rng, (np.eye(3), np.diag([1.0, -1, -1]), _turned(rng, 0.02), _turned(rng, 3.0), np.zeros((3, 3)), -np.eye(3))
    )
    b = np.array([-0.1, 0.0, 0.0]) if rng.random() < 0.5 else choose(rng, _LENGTHS) * rng.standard_normal(3)
    rig = StereoRig(*cameras, choose(rng, (R, R, R, choose(rng, VALUES))), choose(rng, (b, b, b, choose(rng, VALUES))))
    points = rng.uniform((-2, -2, 1), (2, 2, 9), (5, 3))
    rig.project(points)
    rectified = rig.rectified.rig
    if not (np.isfinite(rectified.left.fu) and rectified.baseline > 0):
        raise Broken("a rectified rig is none")
    for write in (write_opencv, write_kalibr):
        write(folder / f"{write.__name__}.yaml", rig)
    model = RigModel(rig)
    corrected_rig(model, 1e-3 * rng.standard_normal(len(model.names)))
    system = StereoSlam(rig, None, choose(rng, ("ekf", "smoother")))
    uv = rng.uniform(0, (rig.width - 1, rig.height - 1), (20, 2))
    right = uv - rng.uniform(0, 0.1 * rig.width, 20)[:, None] * [1, 0]
    looks = np.eye(20, 64, dtype=np.float32)
    for k in range(2):
        features = StereoFeatures(
            0.1 * k, uv, right, np.full(20, 2.0), np.zeros(20), np.ones(20), np.ones(20, np.int8), looks
        )
        if not np.isfinite(system.process_features(features).estimate.covariance).all():
            raise Broken("a pose is not finite")


def _camera(rng: np.random.Generator) -> PinholeCamera:
    """A camera with one or two hostile numbers."""
    values: dict[str, Any] = {"fu": 300.0, "fv": 300.0, "u0": 160.0, "v0": 120.0, "width": 320, "height": 240}
    values |= {"model": "radtan", "distortion": (-0.1, 0.02, 1e-3, -5e-4)}
    for _ in range(int(rng.integers(2))):
        name = choose(rng, list(values))
        values[name] = choose(rng, VALUES) if rng.random() < 0.3 else choose(rng, _LENGTHS)
    if rng.random() < 0.3:
        values["distortion"] = tuple(choose(rng, (0.1, 1.0, 10.0, 1e300, np.nan)) * rng.standard_normal(4))
        values["model"] = choose(rng, ("radtan", "equidistant"))
    return PinholeCamera(**values)


def _turned(rng: np.random.Generator, angle: float) -> np.ndarray:
    from slam.geometry.se3 import so3_exp

    return so3_exp(angle * rng.standard_normal(3))


def trajectories(rng: np.random.Generator, folder: Path) -> None:
    """Paths of hostile poses, read from hostile files, compared with each other."""
    path = folder / "path.txt"
    paths = []
    for _ in range(2):
        stamps, poses = _poses(rng)
        own = Trajectory(stamps, poses)
        if rng.random() < 0.5:
            form = choose(rng, ("tum", "kitti", "euroc"))
            getattr(own, f"write_{form}")(path)
            if rng.random() < 0.6:
                data = path.read_bytes()
                path.write_bytes(
                    broken_bytes(rng, data) if rng.random() < 0.4 else broken_text(rng, data.decode()).encode()
                )
            own = getattr(Trajectory, f"read_{form}")(path)
        paths.append(own)
        repr(own), own._repr_html_(), own.length
    tolerance = choose(rng, (0.02, 0.02, *_LENGTHS))
    first, second = associate(*paths, tolerance, interpolated=bool(rng.random() < 0.5))
    align(first, second)
    absolute_errors(first, second)
    relative_errors(first, second)
    segment_errors(first, second)


def _poses(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    n = int(rng.integers(0, 12))
    stamps = 0.1 * np.arange(n) * choose(rng, (1.0, 1.0, 1e9, 1e-12, 1e300, np.nan, -1.0))
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.standard_normal((n, 3)), 0) * choose(
        rng, (1.0, 1.0, 0.0, 1e-300, 1e9, 1e200, np.inf)
    )
    if n and rng.random() < 0.3:
        poses[int(rng.integers(n))] = choose(
            rng, (0 * np.eye(4), -np.eye(4), 1e300 * np.eye(4), np.ones((4, 4)), 2 * np.eye(4))
        )
    return stamps, poses


_CLASSES = (StereoRig, PinholeCamera, Trajectory, Observations, StereoFeatures, SavedMap)


def made_of_anything(rng: np.random.Generator, folder: Path) -> None:
    """A public class made of hostile values, shown if it can be."""
    kind = choose(rng, _CLASSES)
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
        lambda: SystemConfig.for_kind(value, other, "ekf"),
        lambda: SystemConfig().with_settings(value),
        lambda: SystemConfig.from_json(value),
    )
    choose(rng, calls)()


SUBJECTS = (
    Subject("rigs", "rigs of hostile numbers, rectified, corrected, written and used", "refused in one line, or sound",
            rigs, quiet=False, short=40),
    Subject("paths of poses", "hostile poses, files of them, and their comparison", "errors or one line", trajectories,
            quiet=False, short=60),
    Subject("public classes", "public data classes of hostile values", "an object or one line",
            made_of_anything, quiet=False, short=60),
    Subject("public functions", "public functions with hostile arguments", "a result or one line", functions,
            quiet=False, short=40),
)  # fmt: skip
