"""How much each numeric constant matters: errors at half and at twice its value, over two worlds and a drive.

    SLAM_DATA=/path/to/data python experiments/sensitivity.py [--quick] [--only TEXT] [--out FILE]

Features are extracted once. Each run then gives them to a system in which one constant is changed, and compares the
camera's path and the moving bodies' motion with the truth. Constants that are compiled into kernels, that are read on
import, or that belong to the front end are not measured. A constant takes about ten seconds of CPU time. The table is
written after each, and a later call goes on with those that are missing.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.common import path_of
from experiments.parameters import ROOT, Parameter, find
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.evaluation.metrics import absolute_errors, associate
from slam.evaluation.objects import labels_in_images, score_for

BACKENDS = ("ekf", "smoother")
FACTORS = (0.5, 2.0)
_ORDER = ("backends", "slam/bodies", "slam/tracks", "slam/tracks", "slam/geometry", "slam/calibration")
_PERTURBATIONS = 6  # runs of the default with noise, for the scatter
_PIXEL_NOISE = 0.05  # [px]
_LOST = 20.0  # times the error of the default: the run has lost its way
_PATIENCE = 10.0  # times the CPU time of the default, after which a run counts as failed
_FAILURES = (slam.SlamError, ArithmeticError, ValueError, LookupError, RuntimeError, TimeoutError)
_UNCOVERED = 0.5  # share of the default's frames with a body below which bodies count as lost


@dataclass(frozen=True)
class Case:
    """A short sequence: its text, how many frames of it, and its name in the table."""

    text: str
    frames: int
    name: str


@dataclass(frozen=True)
class Recorded:
    """A sequence with the features of its frames, and the body (N,) that each feature lies on where that is known."""

    sequence: Any
    features: list[StereoFeatures]
    labels: list[np.ndarray] | None


@dataclass(frozen=True)
class Errors:
    """What a run was off by."""

    camera: float  # RMSE of the online positions [m]
    bodies: float | None  # RMSE of the bodies' motion from frame to frame [m]; None where the sequence knows of none
    covered: float  # share of the frames in view in which a body was measured
    path: bytes  # the poses: equal for runs that are equal


def cases() -> list[Case]:
    """Two worlds with moving bodies, and a drive where the data are there."""
    found = [Case("synthetic:box?frames=20", 20, "box"), Case("synthetic:street?frames=16", 16, "street")]
    data = os.environ.get("SLAM_DATA")
    drive = Path(data) / "kitti_odometry" / "sequences" / "06" if data else None
    return found + ([Case(str(drive), 15, "KITTI 06")] if drive is not None and drive.is_dir() else [])


@cache
def recorded(index: int) -> Recorded:
    """The features of a case."""
    case = cases()[index]
    sequence = slam.open_sequence(case.text)
    system = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind)
    assert system.frontend is not None
    features = [system.frontend.extract(frame) for frame in sequence.frames(0, case.frames)]
    known = score_for(sequence) is not None
    labels = [labels_in_images(sequence, k, f) for k, f in enumerate(features)] if known else None
    return Recorded(sequence, features, labels)


def run(index: int, backend: str, noise_seed: int | None = None) -> Errors:
    """The errors of one case, with pixels moved at random where a seed is given."""
    data = recorded(index)
    rng = np.random.default_rng(noise_seed)
    score = score_for(data.sequence)
    config = SystemConfig.for_kind(data.sequence.kind)
    system = slam.StereoSlam(data.sequence.rig, None, backend, config=config)
    results = []
    for k, features in enumerate(data.features):
        if noise_seed is not None:
            shift = _PIXEL_NOISE * rng.standard_normal(features.uv_left.shape)
            features = replace(features, uv_left=features.uv_left + shift, uv_right=features.uv_right + shift)
        results.append(system.process_features(features))
        if score is not None and data.labels is not None:
            score.add(k, results[-1], data.labels[k])
    path = path_of(results)
    own, true = associate(path, data.sequence.ground_truth)
    camera = absolute_errors(own, true).rmse
    bodies = [] if score is None else list(score.summary()["bodies"].values())
    moved = [b["ME"]["translation RMSE [m]"] for b in bodies if b.get("ME")]
    covered = float(np.mean([b["coverage"] or 0.0 for b in bodies])) if bodies else 0.0
    blob = path.poses.tobytes() + repr(bodies).encode()
    return Errors(camera, float(np.mean(moved)) if moved else None, covered, blob)


# --- which constants can be changed ---


def name_of(parameter: Parameter) -> str:
    """The key of a constant in the table."""
    return f"{parameter.module}:{parameter.name}"


@cache
def importers() -> dict[tuple[str, str], list[str]]:
    """Modules that import a name from another one, by that module and name."""
    found: dict[tuple[str, str], list[str]] = {}
    for file in [f for room in ("slam", "backends") for f in sorted((ROOT / room).rglob("*.py"))]:
        module = file.relative_to(ROOT).as_posix().removesuffix(".py").replace("/", ".")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                for name in node.names:
                    found.setdefault((node.module, name.name), []).append(module)
    return found


def measured(parameter: Parameter) -> bool:
    """Whether a changed value of a constant reaches the code that uses it: it is read inside functions alone."""
    if parameter.file.startswith("frontends/") or "kernels" in parameter.file:
        return False
    inside, everywhere = 0, 0
    tree = ast.parse((ROOT / parameter.file).read_text(encoding="utf-8"))
    bodies = [n for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    held = {id(node) for body in bodies for statement in body.body for node in ast.walk(statement)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id == parameter.name and isinstance(node.ctx, ast.Load):
            everywhere += 1
            inside += id(node) in held
    return inside == everywhere


# --- measuring ---


@contextmanager
def changed(parameter: Parameter, factor: float) -> Iterator[None]:
    """The constant times a factor, wherever it is known by its name."""
    names = [parameter.module, *importers().get((parameter.module, parameter.name), [])]
    modules = [importlib.import_module(name) for name in names]
    before = getattr(modules[0], parameter.name)
    for module in modules:
        setattr(module, parameter.name, times(before, factor))
    try:
        yield
    finally:
        for module in modules:
            setattr(module, parameter.name, before)


def times(value: Any, factor: float) -> Any:
    """A number or a tuple of numbers times a factor; whole numbers stay whole, and at least 1."""
    if isinstance(value, tuple):
        return tuple(times(v, factor) for v in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raises TimeoutError after so much CPU time [s]."""

    def give_up(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGVTALRM, give_up)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


@dataclass(frozen=True)
class Default:
    """The default run of one case with one back end: its errors, and its CPU time [s]."""

    index: int
    backend: str
    errors: Errors
    seconds: float

    @classmethod
    def of(cls, index: int, backend: str) -> Default:
        """Measure it."""
        run(index, backend)  # compiles and loads
        start = time.process_time()
        errors = run(index, backend)
        return cls(index, backend, errors, time.process_time() - start)


def ratios(parameter: Parameter, factor: float, defaults: list[Default]) -> dict[str, float | str]:
    """Errors of the camera and of the bodies over the default's: means over the cases, the worse back end.

    "same" where all runs give the same bytes, "fails" where one does not end well.
    """
    found: dict[tuple[int, str], Errors] = {}
    try:
        with changed(parameter, factor):
            for d in defaults:
                with limited(_PATIENCE * max(d.seconds, 1.0)):
                    found[d.index, d.backend] = run(d.index, d.backend)
    except _FAILURES:
        return {"camera": "fails", "bodies": "fails"}
    if all(found[d.index, d.backend].path == d.errors.path for d in defaults):
        return {"camera": "same", "bodies": "same"}
    pairs = [(found.get((d.index, d.backend), d.errors), d) for d in defaults]
    camera = [(new.camera / d.errors.camera, d.backend) for new, d in pairs]
    known = [(new, d) for new, d in pairs if d.errors.bodies is not None]
    lost = any(new.bodies is None or new.covered < _UNCOVERED * d.errors.covered for new, d in known)
    bodies = [((new.bodies or 0.0) / (d.errors.bodies or 1.0), d.backend) for new, d in known]
    return {"camera": _worst(camera), "bodies": "fails" if lost else _worst(bodies)}


def _worst(values: list[tuple[float, str]]) -> float | str:
    """The largest geometric mean among the back ends'; "fails" where a run has lost its way."""
    if not values or not np.isfinite([v for v, _ in values]).all() or max(v for v, _ in values) > _LOST:
        return "fails"
    logs = [np.mean([np.log(v) for v, backend in values if backend == name]) for name in BACKENDS]
    return round(float(np.exp(max(logs))), 4)


def scatter(defaults: list[Default], seeds: int) -> dict[str, float]:
    """The largest factor by which the errors of perturbed runs of one back end differ from the default's."""
    worst = {"camera": 1.0, "bodies": 1.0}
    for backend in BACKENDS:
        own = [d for d in defaults if d.backend == backend]
        for seed in range(seeds):
            new = [(run(d.index, backend, seed), d.errors) for d in own]
            camera = np.mean([np.log(n.camera / e.camera) for n, e in new])
            bodies = [np.log(n.bodies / e.bodies) for n, e in new if n.bodies and e.bodies]
            worst["camera"] = max(worst["camera"], float(np.exp(abs(camera))))
            worst["bodies"] = max(worst["bodies"], float(np.exp(abs(np.mean(bodies))))) if bodies else worst["bodies"]
    return worst


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one constant, one world")
    parser.add_argument("--only", default="", help="constants whose module:NAME contains this")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "sensitivity.json")
    arguments = parser.parse_args()
    file = arguments.out / "sensitivity.json" if arguments.out.is_dir() else arguments.out
    table = json.loads(file.read_text()) if file.exists() else {"ratios": {}}
    present = {name_of(p): p for p in find()}
    table["ratios"] = {name: found for name, found in table["ratios"].items() if name in present}
    wanted = [p for name, p in present.items() if arguments.only in name and measured(p)]
    count = 1 if arguments.quick else len(cases())
    defaults = [Default.of(i, b) for i in range(count) for b in BACKENDS]
    wanted.sort(key=lambda p: [p.file.startswith(room) for room in _ORDER].index(True))
    wanted = wanted[: 1 if arguments.quick else None]
    if "scatter" not in table:
        table["scatter"] = scatter(defaults, 1 if arguments.quick else _PERTURBATIONS)
    table["cases"] = [c.name for c in cases()[:count]]
    table["complete"] = False
    for parameter in wanted:
        name = name_of(parameter)
        if name in table["ratios"]:
            continue
        table["ratios"][name] = [{"camera": "fails", "bodies": "fails"}] * len(FACTORS)  # where the process ends here
        file.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        table["ratios"][name] = [ratios(parameter, factor, defaults) for factor in FACTORS]
        file.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        print(name, table["ratios"][name], flush=True)
    table["complete"] = not arguments.only and not arguments.quick
    file.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print(f"{len(table['ratios'])} constants; scatter {table['scatter']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
