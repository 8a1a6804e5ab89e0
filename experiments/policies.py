"""Policies of data association and map management compared, on the rendered aisle, over seeds and both back ends.

    python experiments/policies.py [--quick] [--seeds 10] [--world synthetic:aisle?speed=4] [--out DIR]

Search windows of fixed sizes (paper A, Fig. 4) against windows by the innovation's covariance; with and without erasing
bad landmarks (paper A, IV); an adaptive against a fixed D_threshold (paper A, III.A), judged on the bare stretch.
Prints a Markdown table: medians over the seeds, and the worst peak.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frontends import create
from slam.association_truth import SurfacePoints
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.sequences import open_sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "smoother")
BARE = 0.5, 0.75  # the stretch of the path in which the bare wall is in view
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
)


def extract(world: str, adaptive: bool) -> list[StereoFeatures]:
    """Features of a whole recording."""
    sequence = open_sequence(world)
    options = {**SystemConfig.for_kind(sequence.kind).frontend, "adaptive": adaptive}
    frontend = create("surf", sequence.rig, **options)
    return [frontend.extract(frame) for frame in sequence]


def run(world: str, policy: Policy, backend: str, features: list[StereoFeatures]) -> dict[str, float]:
    """Figures of one run."""
    sequence = open_sequence(world)
    config = SystemConfig.for_kind(sequence.kind).with_settings(list(policy.settings))
    system = StereoSlam(sequence.rig, None, backend, config=config)
    truth = np.linalg.inv(sequence.ground_truth.poses[0]) @ sequence.ground_truth.poses
    points, errors, used, right, total, spent = SurfacePoints(sequence), [], [], 0, 0, 0.0
    for k, seen in enumerate(features):
        start = time.process_time()
        result = system.process_features(seen)
        spent += time.process_time() - start
        off = points.errors(k, result.matched, seen.uv_left[result.matched_features])
        right, total = right + int((off < 3).sum()), total + len(off)
        points.add(k, result.added, seen.uv_left[result.added_features])
        errors.append(100 * float(np.linalg.norm(result.estimate.T_world_left[:3, 3] - truth[k, :3, 3])))
        used.append(len(result.report.used))
    bare = used[int(BARE[0] * len(used)) : max(int(BARE[1] * len(used)), 1)]
    return {
        "mean": float(np.mean(errors)), "peak": max(errors), "right": 100 * right / max(total, 1),
        "used": float(np.mean(used[1:])), "bare": float(np.mean(bare)), "least": float(min(used[1:])),
        "landmarks": float(result.map_size), "ms": 1e3 * spent / len(features),
    }  # fmt: skip


def row(policy: Policy, backend: str, runs: list[dict[str, float]]) -> list[Any]:
    """Medians over the seeds, and the worst peak."""
    middle = {key: float(np.median([r[key] for r in runs])) for key in runs[0]}
    worst = max(r["peak"] for r in runs)
    names = ("mean", "peak", "", "right", "used", "bare", "least", "landmarks", "ms")
    return [policy.name, backend, *(middle[n] if n else worst for n in names)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, 20 frames")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--world", default="synthetic:aisle?speed=4", help="a rendered world")
    parser.add_argument("--out", type=Path, default=Path("results/policies"))
    arguments = parser.parse_args()
    seeds = 1 if arguments.quick else arguments.seeds
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for seed in range(seeds):
        world = f"{arguments.world}&seed={seed}" + ("&frames=20" if arguments.quick else "")
        features = {adaptive: extract(world, adaptive) for adaptive in (True, False)}
        for policy in POLICIES:
            for backend in BACKENDS:
                figures = run(world, policy, backend, features[policy.adaptive])
                found.setdefault((policy.name, backend), []).append(figures)
                print(f"seed {seed}, {policy.name}, {backend}: {figures}", file=sys.stderr, flush=True)
    rows = [row(policy, backend, found[policy.name, backend]) for policy in POLICIES for backend in BACKENDS]
    print(f"{arguments.world}, {seeds} seeds\n")
    print("| " + " | ".join(HEADER) + " |\n| --- | --- |" + " ---: |" * (len(HEADER) - 2))
    for values in rows:
        print("| " + " | ".join(f"{x:.2f}" if isinstance(x, float) else x for x in values) + " |")
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "table.json").write_text(json.dumps([dict(zip(HEADER, r)) for r in rows], indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
