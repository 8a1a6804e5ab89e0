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
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.common import path_of, recordings
from experiments.parameters import ROOT, Parameter, find
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.evaluation.metrics import absolute_errors, associate
from slam.evaluation.objects import labels_in_images, score_for

BACKENDS = ("ekf", "smoother")
FACTORS = (0.5, 2.0)
#: Two worlds with moving bodies, and a drive where the data are there: text, and how many frames of it.
CASES = {
    "box": ("synthetic:box?frames=20", 20),
    "street": ("synthetic:street?frames=16", 16),
    **{name: (str(folder), 15) for name, folder in recordings({"KITTI 06": "kitti_odometry/sequences/06"}).items()},
}
_PERTURBATIONS = 6  # runs of the default with noise, for the scatter
_PIXEL_NOISE = 0.05  # [px]
_LOST = 20.0  # times the error of the default: the run has lost its way
_PATIENCE = 10.0  # times the CPU time of the default, after which a run counts as failed
_FAILURES = (slam.SlamError, ArithmeticError, ValueError, LookupError, RuntimeError, TimeoutError)
_UNCOVERED = 0.5  # share of the default's frames with a body below which bodies count as lost
_FAILED = {"camera": "fails", "bodies": "fails"}


class Errors(NamedTuple):
    """What a run was off by."""

    camera: float  # RMSE of the online positions [m]
    bodies: float | None  # RMSE of the bodies' motion from frame to frame [m]; None where the sequence knows of none
    covered: float  # share of the frames in view in which a body was measured
    bytes: bytes  # equal for runs that are equal
    seconds: float  # CPU time


@cache
def recorded(case: str) -> tuple[Any, list[StereoFeatures], list[np.ndarray] | None]:
    """A sequence, the features of its frames, and the body (N,) that each lies on where that is known."""
    text, frames = CASES[case]
    sequence = slam.open_sequence(text)
    frontend = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind).frontend
    assert frontend is not None
    features = [frontend.extract(frame) for frame in sequence.frames(0, frames)]
    known = score_for(sequence) is not None
    return sequence, features, [labels_in_images(sequence, k, f) for k, f in enumerate(features)] if known else None


def run(case: str, backend: str, noise_seed: int | None = None) -> Errors:
    """The errors of one case, with pixels moved at random where a seed is given."""
    sequence, features, labels = recorded(case)
    rng, score, start = np.random.default_rng(noise_seed), score_for(sequence), time.process_time()
    system = slam.StereoSlam(sequence.rig, None, backend, config=SystemConfig.for_kind(sequence.kind))
    results = []
    for k, seen in enumerate(features):
        if noise_seed is not None:
            shift = _PIXEL_NOISE * rng.standard_normal(seen.uv_left.shape)
            seen = replace(seen, uv_left=seen.uv_left + shift, uv_right=seen.uv_right + shift)
        results.append(system.process_features(seen))
        if score is not None and labels is not None:
            score.add(k, results[-1], labels[k])
    path = path_of(results)
    camera = absolute_errors(*associate(path, sequence.ground_truth)).rmse
    bodies = [] if score is None else list(score.summary()["bodies"].values())
    moves = [b["ME"]["translation RMSE [m]"] for b in bodies if b.get("ME")]
    covered = float(np.mean([b["coverage"] or 0.0 for b in bodies])) if bodies else 0.0
    blob, took = path.poses.tobytes() + repr(bodies).encode(), time.process_time() - start
    return Errors(camera, float(np.mean(moves)) if moves else None, covered, blob, took)


def name_of(parameter: Parameter) -> str:
    """The key of a constant in the table."""
    return f"{parameter.module}:{parameter.name}"


def measured(parameter: Parameter) -> bool:
    """Whether a changed value reaches the code that uses it: it is read inside functions alone, none compiled."""
    if parameter.file.startswith("frontends/"):
        return False
    tree = ast.parse((ROOT / parameter.file).read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    compiled = ("kernel", "helper")
    plain = [f for f in functions if not any(ast.unparse(d).endswith(compiled) for d in f.decorator_list)]
    held = {id(node) for f in plain for statement in f.body for node in ast.walk(statement)}
    reads = [n for n in ast.walk(tree) if isinstance(n, ast.Name) and n.id == parameter.name]
    return all(id(node) in held for node in reads if isinstance(node.ctx, ast.Load))


def importers(parameter: Parameter) -> list[str]:
    """Modules that import the constant by its name."""
    found = []
    for file in (f for room in ("slam", "backends") for f in sorted((ROOT / room).rglob("*.py"))):
        nodes = (n for n in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(n, ast.ImportFrom))
        if any(n.module == parameter.module and parameter.name in [a.name for a in n.names] for n in nodes):
            found.append(file.relative_to(ROOT).as_posix().removesuffix(".py").replace("/", "."))
    return found


@contextmanager
def changed(parameter: Parameter, factor: float) -> Iterator[None]:
    """The constant times a factor, wherever it is known by its name."""
    knowing = [importlib.import_module(name) for name in (parameter.module, *importers(parameter))]
    before = getattr(knowing[0], parameter.name)
    for module in knowing:
        setattr(module, parameter.name, times(before, factor))
    try:
        yield
    finally:
        for module in knowing:
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


Defaults = dict[tuple[str, str], Errors]  # of the default values, by case and back end


def ratios(parameter: Parameter, factor: float, defaults: Defaults) -> dict[str, float | str]:
    """Errors of the camera and of the bodies over the default's: means over the cases, the worse back end.

    "same" where all runs give the same bytes, "fails" where one does not end well.
    """
    new: Defaults = {}
    try:
        with changed(parameter, factor):
            for key, default in defaults.items():
                with limited(_PATIENCE * max(default.seconds, 1.0)):
                    new[key] = run(*key)
    except _FAILURES:
        return _FAILED
    if all(new[key].bytes == default.bytes for key, default in defaults.items()):
        return {"camera": "same", "bodies": "same"}
    known = {key: default for key, default in defaults.items() if default.bodies is not None}
    lost = any(new[k].bodies is None or new[k].covered < _UNCOVERED * d.covered for k, d in known.items())
    camera = [(new[k].camera / d.camera, k[1]) for k, d in defaults.items()]
    bodies = [((new[k].bodies or 0.0) / (d.bodies or 1.0), k[1]) for k, d in known.items()]
    return {"camera": _worst(camera), "bodies": "fails" if lost else _worst(bodies)}


def _worst(values: list[tuple[float, str]]) -> float | str:
    """The largest geometric mean among the back ends'; "fails" where a run has lost its way."""
    if not values or not np.isfinite([v for v, _ in values]).all() or max(v for v, _ in values) > _LOST:
        return "fails"
    logs = [np.mean([np.log(v) for v, backend in values if backend == name]) for name in BACKENDS]
    return round(float(np.exp(max(logs))), 4)


def scatter(defaults: Defaults, seeds: int) -> dict[str, float]:
    """The largest factor by which the errors of perturbed runs of one back end differ from the default's."""
    worst = {"camera": 1.0, "bodies": 1.0}
    for seed, backend in ((seed, backend) for seed in range(seeds) for backend in BACKENDS):
        pairs = [(run(*key, seed), default) for key, default in defaults.items() if key[1] == backend]
        for what in worst:
            both = [(getattr(n, what), getattr(d, what)) for n, d in pairs if getattr(n, what) and getattr(d, what)]
            logs = [np.log(new / default) for new, default in both]
            worst[what] = max(worst[what], float(np.exp(abs(np.mean(logs)))) if logs else 1.0)
    return worst


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one constant, one world")
    parser.add_argument("--only", default="", help="constants whose module:NAME contains this")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "sensitivity.json")
    given = parser.parse_args()
    file = given.out / "sensitivity.json" if given.out.is_dir() else given.out
    table = json.loads(file.read_text()) if file.exists() else {"ratios": {}}
    present = {name_of(p): p for p in find()}
    found = table["ratios"] = {name: each for name, each in table["ratios"].items() if name in present}
    wanted = {name: p for name, p in present.items() if given.only in name and name not in found and measured(p)}
    cases = list(CASES)[: 1 if given.quick else None]
    defaults = {(case, backend): (run(case, backend), run(case, backend))[1] for case in cases for backend in BACKENDS}
    table["cases"] = cases
    if "scatter" not in table:
        table["scatter"] = scatter(defaults, 1 if given.quick else _PERTURBATIONS)
    for name, parameter in list(wanted.items())[: 1 if given.quick else None]:
        for outcome in ([_FAILED] * len(FACTORS), None):  # the first stays where the process ends here
            found[name] = outcome or [ratios(parameter, factor, defaults) for factor in FACTORS]
            file.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        print(name, found[name], flush=True)
    print(f"{len(found)} constants; scatter {table.get('scatter')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
