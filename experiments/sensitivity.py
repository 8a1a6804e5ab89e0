"""How much each numeric constant matters: position error at half and at twice its value, over worlds and a drive.

    SLAM_DATA=/path/to/data python experiments/sensitivity.py [--quick] [--only TEXT] [--processes N] [--out DIR]

Features are extracted once; each run then gives them to a system in which one constant is changed. Constants of
compiled kernels are compiled into them, and those of the front end act before; both are left out here. What is done is
kept in ``sensitivity.json`` in the folder, so that a later call goes on.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.parameters import Parameter, find
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.evaluation.metrics import absolute_errors, associate
from slam.geometry.trajectory import Trajectory

BACKENDS = ("ekf", "smoother")
FACTORS = (0.5, 2.0)
_PERTURBATIONS = 6  # runs of the default with a twentieth of a pixel of noise, for the scatter
_PIXEL_NOISE = 0.05  # [px]
_LOST = 20.0  # times the error of the default: the run has lost its way


@dataclass(frozen=True)
class Case:
    """A short sequence: its text, and how many frames of it."""

    text: str
    frames: int

    def recorded(self) -> tuple[Any, list[StereoFeatures]]:
        """The sequence and the features of its frames."""
        sequence = slam.open_sequence(self.text)
        system = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind)
        assert system.frontend is not None
        return sequence, [system.frontend.extract(frame) for frame in sequence.frames(0, self.frames)]


def cases() -> list[Case]:
    """Three worlds, and a drive where the data are there."""
    found = [Case("synthetic:aisle", 30), Case("synthetic:street", 20), Case("synthetic:box", 30)]
    data = os.environ.get("SLAM_DATA")
    drive = Path(data) / "kitti_odometry" / "sequences" / "06" if data else None
    return found + ([Case(str(drive), 20)] if drive is not None and drive.is_dir() else [])


@cache
def _recorded(index: int) -> tuple[Any, list[StereoFeatures]]:
    return cases()[index].recorded()


def error(index: int, backend: str, noise_seed: int | None = None) -> float:
    """RMSE of the online positions [m] of one case."""
    sequence, frames = _recorded(index)
    rng = np.random.default_rng(noise_seed)
    config = SystemConfig.for_kind(sequence.kind, "surf", backend)
    system = slam.StereoSlam(sequence.rig, None, backend, config=config)
    stamps, poses = [], []
    for features in frames:
        if noise_seed is not None:
            shift = _PIXEL_NOISE * rng.standard_normal(features.uv_left.shape)
            features = replace(features, uv_left=features.uv_left + shift, uv_right=features.uv_right + shift)
        result = system.process_features(features)
        stamps.append(result.estimate.stamp)
        poses.append(result.estimate.T_world_left)
    own, true = associate(Trajectory(np.array(stamps), np.array(poses)), sequence.ground_truth, interpolated=True)
    return absolute_errors(own, true).translation_statistics.rmse


def concerned(parameter: Parameter, backend: str) -> bool:
    """Whether a constant can change what a back end gives."""
    return not parameter.file.startswith("backends/") or parameter.file.startswith(f"backends/{backend}")


def changed(value: Any, factor: float) -> Any:
    """A number or a tuple of numbers times a factor; whole numbers stay whole, and at least 1."""
    if isinstance(value, tuple):
        return tuple(changed(v, factor) for v in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def ratio(parameter: Parameter, factor: float, defaults: dict[str, float], count: int) -> float | None:
    """Geometric mean over the cases of the error over the default's, the worse back end; None where a run fails."""
    module = importlib.import_module(parameter.module)
    before = getattr(module, parameter.name)
    setattr(module, parameter.name, changed(before, factor))
    try:
        worst = 0.0
        for backend in BACKENDS:
            if concerned(parameter, backend):
                ratios = [error(i, backend) / defaults[f"{i} {backend}"] for i in range(count)]
                if not np.isfinite(ratios).all() or max(ratios) > _LOST:
                    return None
                worst = max(worst, float(np.exp(np.mean(np.log(ratios)))))
        return worst
    except (slam.SlamError, ArithmeticError, ValueError, IndexError, RuntimeError, np.linalg.LinAlgError):
        return None  # a constant that may not be changed like this: the table says that it fails
    finally:
        setattr(module, parameter.name, before)


def _measure(parameter: Parameter, defaults: dict[str, float], count: int) -> tuple[str, list[float | None]]:
    return f"{parameter.module}:{parameter.name}", [ratio(parameter, f, defaults, count) for f in FACTORS]


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one constant, one world")
    parser.add_argument("--only", default="", help="constants whose module:NAME contains this")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/sensitivity"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    file = arguments.out / "sensitivity.json"
    table = json.loads(file.read_text()) if file.exists() else {"ratios": {}}
    count = 1 if arguments.quick else len(cases())
    wanted = [
        p
        for p in find()
        if not p.file.startswith("frontends/") and "kernels" not in p.file and arguments.only in f"{p.module}:{p.name}"
    ]
    wanted = wanted[:1] if arguments.quick else wanted
    defaults = {f"{i} {b}": error(i, b) for i in range(count) for b in BACKENDS}
    if "scatter" not in table:
        seeds = range(1 if arguments.quick else _PERTURBATIONS)
        spread = [
            np.exp(np.mean([np.log(error(i, b, seed) / defaults[f"{i} {b}"]) for i in range(count)]))
            for b in BACKENDS
            for seed in seeds
        ]
        table["scatter"] = float(np.exp(np.abs(np.log(spread)).max()))
    with ProcessPoolExecutor(arguments.processes) as pool:
        open_ones = [p for p in wanted if f"{p.module}:{p.name}" not in table["ratios"]]
        for name, values in pool.map(_measure, open_ones, *zip(*[(defaults, count)] * len(open_ones))):
            table["ratios"][name] = values
            file.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    inside = [n for n, v in table["ratios"].items() if all(r is not None and r <= table["scatter"] for r in v)]
    print(
        f"{len(table['ratios'])} constants; scatter {table['scatter']:.2f}; inside it at half and twice: {len(inside)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
