"""NEES of the camera along a corridor without end: the papers' filter, the back ends, and what each claims to know.

    python experiments/corridor.py [--quick] [--seeds 4] [--frames 1000] [--out DIR]

The world is the corridor of `experiments/long_run.py`, with true association. Every run starts at a pose drawn from the
prior about the true one, with its own pixel noise; all back ends get the same. Nothing measures where the world is and
which way it faces, so that an honest filter never knows its heading better than at the start. The band is that of 95 %
of the means over so many runs; NEES above it says that errors are larger than claimed.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options
from experiments.long_run import MODELS, RIG, Corridor, walk
from experiments.tables import picture, show
from slam.evaluation.metrics import chi_square_band, nees, pose_residuals
from slam.geometry import se3
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

#: What runs, by its name in the table: the back end, and its options.
FILTERS: dict[str, tuple[str, dict[str, object]]] = {
    "ekf, papers=true": ("ekf", {"papers": True}),
    "ekf": ("ekf", {}),
    "iekf": ("iekf", {}),
    "window": ("window", {}),
    "smoother": ("smoother", {}),
}
_START = replace(MODELS, initial_position_sigma=0.05, initial_rotation_sigma=0.01)
HEADING, AT = slice(1, 2), slice(3, 6)  # of a pose's error: about the vertical, and of the position


@dataclass(frozen=True, eq=False)
class Run:
    """One back end in one run of F frames."""

    errors: Array  # of the newest pose (F, 6), [rotation, translation] [rad], [m]
    deviations: Array  # what it claims of them (F, 6)
    nees: Array  # of the pose (F,)
    lost: int  # updates that used nothing


def start(seed: int) -> EstimatorModels:
    """Models whose first pose is drawn from the prior about the true one."""
    sigma = np.repeat([_START.initial_rotation_sigma, _START.initial_position_sigma], 3)
    off = sigma * np.random.default_rng([seed, 1]).standard_normal(6)
    return replace(_START, T_world_left=Corridor().pose(0.0) @ se3.exp(off))


def run(name: str, options: Mapping[str, object], frames: int, seed: int) -> Run:
    """Along the corridor, see `walk`."""
    backend = backends.create(name, RIG, models=start(seed), **options)
    steps = list(walk(backend, frames, np.random.default_rng(seed), Corridor()))
    P = np.array([step.estimate.covariance for step in steps])
    errors = pose_residuals(np.array([s.T for s in steps]), np.array([s.estimate.T_world_left for s in steps]))
    lost = sum(not len(step.report.used) for step in steps[1:])
    return Run(errors, np.sqrt(np.diagonal(P, axis1=1, axis2=2)), nees(errors, P), lost)


HEADER = (
    "filter", "NEES, first tenth", "NEES, last tenth (6)", "frames in the band", "heading at the end [deg]",
    "heading claimed [deg]",
    "position at the end [m]", "position claimed [m]", "lost updates",
)  # fmt: skip


def rms(values: Array, part: slice) -> float:
    """Root of the mean square over runs (S, 6) of a part of the errors."""
    return float(np.sqrt((values[:, part] ** 2).sum(axis=1).mean()))


def row(name: str, runs: list[Run]) -> list[str]:
    """What the table says of a filter."""
    mean = np.mean([r.nees for r in runs], axis=0)
    low, high = chi_square_band(6, len(runs))
    tenth = max(1, len(mean) // 10)
    errors, claimed = (np.array([getattr(r, what)[-1] for r in runs]) for what in ("errors", "deviations"))
    return [
        name, f"{mean[:tenth].mean():.1f}", f"{mean[-tenth:].mean():.1f}",
        f"{np.mean((mean > low) & (mean < high)):.0%}",
        f"{np.rad2deg(rms(errors, HEADING)):.2f}", f"{np.rad2deg(rms(claimed, HEADING)):.2f}",
        f"{rms(errors, AT):.2f}", f"{rms(claimed, AT):.2f}", str(sum(r.lost for r in runs)),
    ]  # fmt: skip


def draw(path: Path, done: Mapping[str, list[Run]]) -> None:
    """Mean NEES frame by frame, and the claimed deviation of the heading."""
    with picture(path, 10, 3.6, 1, 2) as (left, right):
        for name, runs in done.items():
            left.semilogy(np.mean([r.nees for r in runs], axis=0), label=name, linewidth=0.9)
            right.plot(np.rad2deg(np.mean([r.deviations[:, HEADING] for r in runs], axis=0)), linewidth=0.9)
        left.axhspan(*chi_square_band(6, len(next(iter(done.values())))), color="0.85")
        left.set(xlabel="frame", ylabel="mean NEES of the pose")
        right.set(xlabel="frame", ylabel="claimed deviation of the heading [deg]", ylim=(0, None))
        left.legend(fontsize="small")


def main() -> int:
    parser = script_options(__file__, __doc__, "two seeds of forty frames")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--filters", nargs="*", default=list(FILTERS), choices=list(FILTERS))
    given = parser.parse_args()
    seeds, frames = (2, 40) if given.quick else (given.seeds, given.frames)
    done = {}
    for name in given.filters:
        backend, options = FILTERS[name]
        done[name] = [run(backend, options, frames, seed) for seed in range(seeds)]
        print(row(name, done[name]), file=sys.stderr, flush=True)
    low, high = chi_square_band(6, seeds)
    print(f"{seeds} runs of {frames} frames; 95 % of the means lie between {low:.1f} and {high:.1f}.\n")
    show(given.out / "table.json", HEADER, [row(name, runs) for name, runs in done.items()])
    draw(given.out / "corridor.png", done)
    return 0


if __name__ == "__main__":
    sys.exit(main())
