"""Policies of data association and map management compared, on the rendered aisle, over seeds and both back ends.

    python experiments/policies.py [--quick] [--seeds 10] [--processes 2] [--frames 880:1180] [--out DIR]

Search windows of fixed sizes (paper A, Fig. 4) against windows by the innovation's covariance; with and without erasing
bad landmarks (paper A, IV); an adaptive against a fixed D_threshold (paper A, III.A), judged on the bare stretch, which
the middle of these frames shows; landmarks looked for from anywhere, and a map that is not thinned. Every seed has
sensor noise, shelves and a gait of its own. Prints a Markdown table: medians over the seeds, and the worst peak, and
draws every seed's mean error.

Each seed's figures go to a file in DIR when it is done; a run that was broken off goes on with the seeds that are
missing. About three minutes of CPU time a seed.
"""

from __future__ import annotations

import json
import sys
import textwrap
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import script_options
from experiments.tables import markdown, write_json
from frontends import create
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.evaluation.association_truth import surface_points
from slam.geometry.se3 import Array, inverse, transform
from slam.registry import ONLINE
from slam.sequences import open_sequence
from slam.system import StereoSlam

BARE = 950, 1120  # frames of the whole walk that show the bare wall
HEADER = (
    "policy", "back end", "mean error [cm]", "peak [cm]", "worst peak [cm]", "right associations [%]",
    "measured a frame", "measured, bare stretch", "least measured", "landmarks", "ms a frame (CPU)",
)  # fmt: skip


@dataclass(frozen=True)
class Policy:
    """What is compared.

    Attributes:
        name: for the table.
        settings: of the system.
        frontend: options of the front end.
    """

    name: str
    settings: tuple[str, ...] = ()
    adaptive: bool = True


POLICIES = (
    Policy("default: covariance windows, erasing, adaptive D_threshold"),
    Policy("fixed windows", ("association.windows=fixed",)),
    Policy("no erasing", ("map.erase_missed=1000000", "map.erase_share=0")),
    Policy("fixed D_threshold", adaptive=False),
    Policy("from anywhere", ("association.view_angle=180", "association.view_ratio=1000000")),
    Policy("not thinned", ("map.spacing=0",)),
)


@dataclass(frozen=True)
class Frame:
    """What one frame shows.

    Attributes:
        number: in the recording.
        features: of the images.
        points: the points of the still world that the features show (N, 3) [m] in world coordinates; NaN for none.
    """

    number: int
    features: StereoFeatures
    points: Array


def extract(world: str, adaptive: bool, frames: range) -> list[Frame]:
    """What the frames of a recording show."""
    sequence: Any = open_sequence(world)
    options = {**SystemConfig.for_kind(sequence.kind).frontend, "adaptive": adaptive}
    frontend, out = create("surf", sequence.rig, **options), []
    for k, images in zip(frames, sequence.frames(frames.start, frames.stop)):
        features = frontend.extract(images)
        local = surface_points(sequence.rig.left, sequence.depth(k), features.uv_left)
        out.append(Frame(k, features, transform(sequence.ground_truth.poses[k], local)))
    return out


def run(world: str, policy: Policy, backend: str, frames: list[Frame]) -> dict[str, float]:
    """Figures of one run."""
    sequence: Any = open_sequence(world)
    config = SystemConfig.for_kind(sequence.kind, None, backend).with_settings(list(policy.settings))
    system, truth = StereoSlam(sequence.rig, None, backend, config=config), sequence.ground_truth.poses
    start = inverse(truth[frames[0].number])
    points: dict[int, Array] = {}
    errors, used, right, total, spent = [], [], 0, 0, 0.0
    for frame in frames:
        begun = time.process_time()
        result = system.process_features(frame.features)
        spent += time.process_time() - begun
        T, uv = truth[frame.number], frame.features.uv_left
        places = np.array([points[i] for i in result.matched.tolist()]).reshape(-1, 3)
        off = np.linalg.norm(
            uv[result.matched_features] - sequence.rig.left.project(transform(inverse(T), places)), axis=1
        )
        right, total = right + int((off < 3).sum()), total + len(off)
        points.update(zip(result.added.tolist(), frame.points[result.added_features]))
        errors.append(100 * float(np.linalg.norm(result.estimate.T_world_left[:3, 3] - (start @ T)[:3, 3])))
        used.append(len(result.report.used))
    bare = [n for n, frame in zip(used, frames) if BARE[0] <= frame.number < BARE[1]] or used[-1:]
    return {
        "mean": float(np.mean(errors)), "peak": max(errors), "right": 100 * right / max(total, 1),
        "used": float(np.mean(used[1:])), "bare": float(np.mean(bare)), "least": float(min(used[1:])),
        "landmarks": float(result.map_size), "ms": 1e3 * spent / len(frames),
    }  # fmt: skip


def one_seed(seed: int, world: str, frames: range, folder: Path) -> Path:
    """Run everything on one seed, unless its file is there already; the file."""
    path, what = folder / f"seed_{seed}.json", {"world": world, "frames": [frames.start, frames.stop]}
    if path.exists() and json.loads(path.read_text())["what"] == what:
        return path
    name = f"{world}{'&' if '?' in world else '?'}seed={seed}&layout={seed}"
    figures = []
    with threadpool_limits(limits=1):
        for adaptive in (True, False):
            seen = extract(name, adaptive, frames)
            for policy in (p for p in POLICIES if p.adaptive is adaptive):
                for backend in ONLINE:
                    figures.append({"policy": policy.name, "backend": backend, **run(name, policy, backend, seen)})
                    print(f"seed {seed}: {figures[-1]}", file=sys.stderr, flush=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps({"what": what, "figures": figures}, indent=2) + "\n")
    part.replace(path)
    return path


def row(policy: Policy, backend: str, runs: list[dict[str, float]]) -> list[Any]:
    """Medians over the seeds, and the worst peak."""
    numbers = [key for key, value in runs[0].items() if isinstance(value, float)]
    middle = {key: float(np.median([r[key] for r in runs])) for key in numbers}
    worst = max(r["peak"] for r in runs)
    names = ("mean", "peak", "", "right", "used", "bare", "least", "landmarks", "ms")
    return [policy.name, backend, *(middle[n] if n else worst for n in names)]


def draw(found: dict[tuple[str, str], list[dict[str, float]]], path: Path) -> None:
    """Mean error of every seed by policy and back end, and the medians."""
    from matplotlib.figure import Figure

    figure = Figure((9, 0.9 + 0.42 * len(POLICIES)), layout="constrained")
    axis = figure.subplots()
    for shift, backend in zip((-0.2, 0.0, 0.2), ONLINE, strict=True):
        values = [[one["mean"] for one in found[policy.name, backend]] for policy in POLICIES]
        places = np.arange(len(POLICIES)) + shift
        points = axis.plot(np.concatenate(values), np.repeat(places, [len(v) for v in values]), ".", alpha=0.45)
        colour = points[0].get_color()
        axis.plot([np.median(v) for v in values], places, "|", ms=13, mew=2, color=colour, label=f"{backend}, median")
    axis.set_yticks(range(len(POLICIES)), [textwrap.fill(policy.name, 30) for policy in POLICIES])
    axis.invert_yaxis()
    axis.set_xlim(left=0)
    axis.set_xlabel("mean position error of a seed [cm]")
    axis.legend(frameon=False, fontsize=8, ncols=2, loc="lower left", bbox_to_anchor=(0, 1.0))
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> int:
    parser = script_options(__file__, __doc__, "one seed, 20 frames")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--frames", default="880:1180", metavar="A:B", help="part of the recording")
    parser.add_argument("--world", default="synthetic:aisle", help="a rendered world")
    arguments = parser.parse_args()
    first, last = (int(n) for n in arguments.frames.split(":"))
    frames = range(first, first + 20 if arguments.quick else last)
    arguments.out.mkdir(parents=True, exist_ok=True)
    seeds, common = range(1 if arguments.quick else arguments.seeds), (arguments.world, frames, arguments.out)
    with ProcessPoolExecutor(arguments.processes, get_context("spawn")) as pool:
        files = [job.result() for job in [pool.submit(one_seed, seed, *common) for seed in seeds]]
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for file in files:
        for one in json.loads(file.read_text())["figures"]:
            found.setdefault((one["policy"], one["backend"]), []).append(one)
    rows = [row(policy, backend, found[policy.name, backend]) for policy in POLICIES for backend in ONLINE]
    print(f"{arguments.world}, frames {frames.start} to {frames.stop - 1}, {len(seeds)} seeds\n")
    print(markdown(HEADER, rows, 2))
    write_json(arguments.out / "table.json", HEADER, rows)
    draw(found, arguments.out / "policies.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
