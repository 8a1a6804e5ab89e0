"""How much each numeric constant matters: errors at half and at twice its value, over two worlds and three recordings.

    SLAM_DATA=/path/to/data python experiments/sensitivity.py [--quick] [--only TEXT] [--out FILE]

Each constant is changed in a copy of the program. A process of its own then compares the camera's path and the moving
bodies' motion with the truth, on features that were extracted once, or again where the constant is the front end's. A
constant takes half a minute. The table is written after each, and a later call goes on with those that are missing,
choices first.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import pickle
import resource
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.common import path_of, recordings
from experiments.parameters import ROOT, Parameter, find
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.evaluation.metrics import absolute_errors, associate
from slam.evaluation.objects import labels_in_images, score_for

FACTORS = (0.5, 2.0)
#: Two worlds with moving bodies, and recordings where the data are there: text, how many frames of it, two back ends.
CASES = {
    "box": ("synthetic:box?frames=20", 20, ("ekf", "window")),
    "street": ("synthetic:street?frames=16", 16, ("ekf", "smoother")),
} | {
    name: (str(folder), 12, {"KITTI 06": ("smoother", "window")}.get(name, ("ekf", "smoother")))
    for name, folder in recordings(
        {
            "KITTI 06": "kitti_odometry/sequences/06",
            "raw 0013": "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync",
            "MH_01": "euroc/MH_01_part",
        }
    ).items()
}
_PERTURBATIONS = 6  # runs of the default with noise, for the scatter
_PIXEL_NOISE = 0.05  # [px]
_LOST = 20.0  # times the error of the default: the run has lost its way
_PATIENCE = 10  # times the processor time of the default, after which a run counts as failed
_LONGEST = 3600  # seconds after which a run that computes nothing counts as failed, on whatever machine
_UNCOVERED = 0.5  # share of the default's frames with a body below which bodies count as lost
_FAILED = {"camera": "fails", "bodies": "fails"}

#: By "case, back end": "camera", RMSE of the online positions [m]; "bodies", RMSE of the bodies' motion from frame to
#: frame [m], None where none is known; "covered", share of frames in view in which a body was measured; "bytes".
Errors = dict[str, dict[str, Any]]


def recorded(case: str, folder: Path) -> tuple[Any, list[StereoFeatures], list[np.ndarray] | None]:
    """A sequence, its features, and the body (N,) each lies on where known; from the folder's file, if it is there."""
    text, frames, _ = CASES[case]
    sequence, file = slam.open_sequence(text), folder / f"{case}.pickle"
    if not file.exists():
        frontend = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind).frontend
        assert frontend is not None
        seen = [frontend.extract(frame) for frame in sequence.frames(0, frames)]
        known = score_for(sequence) is not None
        labels = [labels_in_images(sequence, k, f) for k, f in enumerate(seen)] if known else None
        file.write_bytes(pickle.dumps((seen, labels)))
    return sequence, *pickle.loads(file.read_bytes())


def errors(folder: Path, seed: int, cases: list[str]) -> Errors:
    """The errors of this program, with pixels moved at random where the seed is not 0."""
    found = {}
    for case, backend in ((name, backend) for name in cases for backend in CASES[name][2]):
        sequence, features, labels = recorded(case, folder)
        rng, score = np.random.default_rng(seed), score_for(sequence)
        system = slam.StereoSlam(sequence.rig, None, backend, config=SystemConfig.for_kind(sequence.kind))
        results = []
        for k, seen in enumerate(features):
            if seed:
                shift = _PIXEL_NOISE * rng.standard_normal(seen.uv_left.shape)
                seen = replace(seen, uv_left=seen.uv_left + shift, uv_right=seen.uv_right + shift)
            results.append(system.process_features(seen))
            if score is not None and labels is not None:
                score.add(k, results[-1], labels[k])
        path = path_of(results)
        bodies = [] if score is None else list(score.summary()["bodies"].values())
        moves = [b["ME"]["translation RMSE [m]"] for b in bodies if b.get("ME")]
        reported = repr(bodies) + repr([(o.id, o.estimate.T_world_object.tolist()) for r in results for o in r.objects])
        found[f"{case}, {backend}"] = {
            "camera": absolute_errors(*associate(path, sequence.ground_truth)).rmse,
            "bodies": float(np.mean(moves)) if moves else None,
            "covered": float(np.mean([b["coverage"] or 0.0 for b in bodies])) if bodies else 0.0,
            "bytes": hashlib.sha256(path.poses.tobytes() + reported.encode()).hexdigest(),
        }
    return found


def measure(tree: Path, folder: Path, seed: int, cases: list[str], patience: int | None = None) -> Errors | None:
    """What `errors` finds in a copy of the program; None where it fails or needs more seconds of processor time."""
    call = [sys.executable, tree / "experiments" / "sensitivity.py", "--errors", folder, str(seed), *cases]
    limit = None if patience is None else lambda: resource.setrlimit(resource.RLIMIT_CPU, (patience, patience))
    try:
        done = subprocess.run(call, capture_output=True, text=True, preexec_fn=limit, timeout=_LONGEST)
    except subprocess.TimeoutExpired:
        print(f"failed: nothing after {_LONGEST} s", file=sys.stderr)
        return None
    if done.returncode != 0:
        print("failed:", (done.stderr.splitlines() or [done.returncode])[-1], file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def processor_time() -> float:
    """Seconds of processor time that the processes which `measure` started have needed so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def times(value: Any, factor: float) -> Any:
    """A number or a tuple of numbers times a factor; whole numbers stay whole, and at least 1."""
    if isinstance(value, tuple):
        return tuple(times(v, factor) for v in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def change(tree: Path, parameter: Parameter, factor: float) -> None:
    """Multiply a constant in a copy of the program."""
    file = tree / parameter.file
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    line, start, stop = parameter.place
    lines[line] = f"{lines[line][:start]}{times(parameter.value, factor)!r}{lines[line][stop:]}"
    file.write_text("".join(lines), encoding="utf-8")


def ratios(new: Errors | None, defaults: Errors) -> dict[str, float | str]:
    """Errors of the camera and of the bodies over the default's: means over the cases, the worst back end.

    "same" where all runs give the same bytes, "fails" where one does not end well.
    """
    if new is None:
        return _FAILED
    if all(new[key]["bytes"] == default["bytes"] for key, default in defaults.items()):
        return {"camera": "same", "bodies": "same"}
    known = {key: default for key, default in defaults.items() if default["bodies"] is not None}
    lost = any(new[k]["bodies"] is None or new[k]["covered"] < _UNCOVERED * d["covered"] for k, d in known.items())
    camera = [(new[k]["camera"] / d["camera"], k) for k, d in defaults.items()]
    bodies = [((new[k]["bodies"] or 0.0) / d["bodies"], k) for k, d in known.items()]
    return {"camera": _worst(camera), "bodies": "fails" if lost else _worst(bodies)}


def _worst(values: list[tuple[float, str]]) -> float | str:
    """The largest geometric mean among the back ends'; "fails" where a run has lost its way."""
    if not values or not np.isfinite([v for v, _ in values]).all() or max(v for v, _ in values) > _LOST:
        return "fails"
    of = {key.split(", ")[1] for _, key in values}
    return round(max(_mean([v for v, key in values if key.endswith(name)]) for name in of), 4)


def _mean(values: list[float]) -> float:
    """The geometric mean."""
    return float(np.exp(np.mean(np.log(values))))


def scatter(perturbed: list[Errors], defaults: Errors) -> dict[str, float]:
    """The largest factor by which the errors of perturbed runs of one back end differ from the default's."""
    worst = {"camera": 1.0, "bodies": 1.0}
    for new, name in ((new, key.split(", ")[1]) for new in perturbed for key in defaults):
        for what in worst:
            both = [(new[key][what], d[what]) for key, d in defaults.items() if key.endswith(name)]
            mean = _mean([a / b for a, b in both if a and b] or [1.0])
            worst[what] = max(worst[what], mean, 1.0 / mean)
    return worst


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one constant, one world")
    parser.add_argument("--only", default="", help="constants whose module:NAME contains this")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "sensitivity.json")
    parser.add_argument("--errors", nargs="+", metavar="ARG", help="features, seed, cases: print errors alone")
    given = parser.parse_args()
    if given.errors:
        folder, seed, *cases = given.errors
        print(json.dumps(errors(Path(folder), int(seed), cases)))
        return 0
    file = given.out / "sensitivity.json" if given.out.is_dir() else given.out
    table = json.loads(file.read_text()) if file.exists() else {"ratios": {}}
    present = {p.key: p for p in find()}
    found = table["ratios"] = {key: each for key, each in table["ratios"].items() if key in present}
    wanted = [p for key, p in present.items() if given.only in key and key not in found]
    cases = table["cases"] = list(CASES)[: 1 if given.quick else None]
    with tempfile.TemporaryDirectory() as name:
        tree, changed, features, fresh = (Path(name) / part for part in ("tree", "changed", "features", "fresh"))
        features.mkdir()
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".*", "docs", "tests", "build", "results"))
        measure(tree, features, 0, cases)  # compiles, and extracts features
        start = processor_time()
        defaults = measure(tree, features, 0, cases)
        assert defaults is not None, "the program fails as it is"
        patience = math.ceil(_PATIENCE * (processor_time() - start))
        if "scatter" not in table:
            seeds = range(1, 2 if given.quick else _PERTURBATIONS + 1)
            runs = [measure(tree, features, seed, cases) for seed in seeds]
            table["scatter"] = scatter([run for run in runs if run], defaults)
        for parameter in sorted(wanted, key=lambda p: p.kind != "choice")[: 1 if given.quick else None]:
            sides = found[parameter.key] = []
            for factor in FACTORS:
                shutil.copytree(tree, changed)
                change(changed, parameter, factor)
                fresh.mkdir()
                own = fresh if parameter.file.startswith("frontends/") else features
                sides.append(ratios(measure(changed, own, 0, cases, patience), defaults))
                shutil.rmtree(changed)
                shutil.rmtree(fresh)
            file.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            print(parameter.key, sides, flush=True)
    print(f"{len(found)} constants; scatter {table.get('scatter')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
