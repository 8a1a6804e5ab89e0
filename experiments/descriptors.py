"""16 against 64 dimensions: time of description, and the error of the map's points (paper A, III.B and conclusion).

    python experiments/descriptors.py [--quick] [--seeds N] [--out DIR]

Paper A: the 16-D descriptor takes 45 % less time for 100 to 800 features, and "has the best performance in state
estimation of ground truth points" in EKF SLAM; no figures for the latter are printed. Here: CPU time on one image, and
the papers' filter on rendered worlds where the surface point behind every landmark is known, paired over seeds.
"""

from __future__ import annotations

import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.surf import medians, test_image
from experiments.common import script_options
from experiments.tables import show
from frontends.surf import Surf
from slam.compare.plan import Plan
from slam.compare.statistics import difference
from slam.compare.sweep import sweep
from slam.run.results import BY_KEY
from slam.runtime.threads import available_cores

WORLDS = ("synthetic:aisle?frames={}", "synthetic:desk?frames={}")
FIGURES = ("landmark_error_m", "ate_online_m", "association_precision")


def times(counts: tuple[int, ...], rounds: int) -> np.ndarray:
    """CPU time [ms] of description (C, 2) in 16 and 64 dimensions, with orientation."""
    image = test_image(752, 480)
    everything = Surf(0.0).detect(image)
    rows = []
    for count in counts:
        keypoints = everything.select(np.arange(count))
        tasks = {str(d): partial(Surf(descriptor=d).describe, image, keypoints) for d in (16, 64)}
        found = medians(tasks, rounds)
        rows.append([found["16"], found["64"]])
    return np.array(rows)


def known_points(worlds: tuple[str, ...], seeds: int, out: Path) -> list[list[str]]:
    """Rows of the comparison by world."""
    rows = []
    shutil.rmtree(out / "runs", ignore_errors=True)  # those of another form or version
    runs = []
    for size in (64, 16):
        plan = Plan(worlds, ("ekf",), settings=(f"frontend.descriptor={size}",), trials=seeds)
        runs.append(sweep(plan, out / "runs" / str(size), min(available_cores(), len(worlds) * seeds)))
    for world in worlds:
        own = [[run for run in each if run.trial.sequence == world] for each in runs]
        for metric in map(BY_KEY.__getitem__, FIGURES):
            values = [np.array([r.metrics.get(metric.key, np.nan) for r in rs]) for rs in own]
            d = difference(metric, *values, tests=len(worlds) * len(FIGURES))
            rows.append([world, metric.title, metric.show(d.other), metric.show(d.reference), d.verdict])
    return rows


def main() -> int:
    parser = script_options(__file__, __doc__, "one seed of fifteen frames of one world")
    parser.add_argument("--seeds", type=int, default=6)
    arguments = parser.parse_args()
    counts = (100, 800) if arguments.quick else (100, 200, 400, 600, 800)
    ms = times(counts, 5 if arguments.quick else 41)
    worlds = [world.format(15 if arguments.quick else 100) for world in WORLDS]
    seeds = 1 if arguments.quick else arguments.seeds
    rows = known_points(tuple(worlds[: 1 if arguments.quick else None]), seeds, arguments.out)
    saved = [[n, float(a), float(b), f"{100 * (1 - a / b):.0f} %", "45 %"] for n, (a, b) in zip(counts, ms)]
    show(arguments.out / "times.json", ("features", "16-D [ms]", "64-D [ms]", "saved", "paper A"), saved)
    print(f"\nMeans of {seeds} trials, and whether 16-D is better.\n")
    show(arguments.out / "points.json", ("world", "figure", "16-D", "64-D", "16-D is"), rows, 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
