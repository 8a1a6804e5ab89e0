"""The back ends on the real sequences: what they track, and how sure they are.

    SLAM_DATA=/path/to/data python experiments/real_sequences.py [--quick] [--out DIR]

Runs every sequence that the folder holds with the default settings of its kind, and prints a Markdown table: frames
tracked, ATE of the online and of the final path, NEES of relative poses over 1 and 10 m (6 is right). Draws the paths
from above with the true one. Medians over perturbations say more than single runs: see `experiments/bars.py`.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import recordings, script_options
from experiments.tables import picture, show
from slam.config import SystemConfig
from slam.evaluation.metrics import associate
from slam.geometry.se3 import transform
from slam.geometry.trajectory import Trajectory, alignment
from slam.registry import ONLINE
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.sequences import open_sequence

SEQUENCES = {
    "KITTI odometry 06": "kitti_odometry/sequences/06",
    "KITTI raw 0001": "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync",
    "KITTI raw 0013": "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync",
    "EuRoC V1_01, 20 keyframes": "euroc/V1_01_keyframes_a",
}
HEADER = ("sequence", "back end", "tracked", "ATE online [m]", "final [m]", "NEES over 1 m", "NEES over 10 m")


def folder_of(name: str, backend: str, out: Path) -> Path:
    return out / name.replace(" ", "_").replace(",", "") / backend


def run_one(name: str, folder: Path, backend: str, out: Path, frames: int | None) -> dict[str, Any]:
    sequence = open_sequence(folder)
    target = folder_of(name, backend, out)
    config = SystemConfig.for_kind(sequence.kind)
    options = RunOptions(backend, "surf", config, target, 0, frames, kind=sequence.kind)
    return run(sequence, options)


def row(name: str, summary: dict[str, Any]) -> list[str]:
    tracked = f"{summary['status'].get('tracked', 0) + summary['status'].get('started', 0)} of {summary['frames']}"
    texts = [f"{summary['accuracy'][path]['ATE RMSE [m]']:.3f}" for path in ("online", "final")]
    for length in (1, 10):
        nees = summary["consistency"].get(f"NEES over {length} m")
        texts.append("–" if nees is None else f"{nees:.1f}")
    return [name, summary["backend"], tracked, *texts]


def draw(names: dict[str, Path], out: Path) -> None:
    """Paths from above, online, and the true one laid upon the first of them."""
    rows = math.ceil(len(names) / 2)
    with picture(out / "paths.png", 9, 4 * rows, rows, 2) as panels:
        axes = np.ravel(panels)
        for axis in axes[len(names) :]:
            axis.set_axis_off()
        for axis, (name, folder) in zip(axes, names.items()):
            paths = [Trajectory.read_tum(folder_of(name, backend, out) / "trajectory.txt") for backend in ONLINE]
            for backend, path, width in zip(ONLINE, paths, 1.5 + 1.8 * np.arange(len(ONLINE))[::-1]):
                axis.plot(*path.positions[:, [0, 2]].T, lw=width, label=backend)
            truth = true_path(folder, paths[0])
            if truth is not None:
                axis.plot(*truth[:, [0, 2]].T, "k--", lw=1, label="truth")
            axis.set(title=name, xlabel="right [m]", ylabel="forward [m]")
            axis.axis("equal")
            axis.locator_params(nbins=6)
            axis.legend(frameon=False, fontsize=8)


def true_path(folder: Path, estimate: Trajectory) -> np.ndarray | None:
    """True positions (N, 3) in the estimate's axes; None where there are none in space."""
    truth = open_sequence(folder).ground_truth
    if truth is None:
        return None
    own, true = associate(estimate, truth)
    return transform(alignment(true, own), true.positions)


def main() -> int:
    parser = script_options(__file__, __doc__, "six frames of two sequences")
    arguments = parser.parse_args()
    found = recordings(SEQUENCES)
    if not found:
        print("real sequences: set SLAM_DATA to the folder that holds them; nothing was run")
        return 0
    if len(found) < len(SEQUENCES):
        print(f"left out, not there: {', '.join(sorted(set(SEQUENCES) - set(found)))}", file=sys.stderr)
    found, frames = (dict(list(found.items())[::3]), 6) if arguments.quick else (found, None)
    rows = [row(n, run_one(n, folder, b, arguments.out, frames)) for n, folder in found.items() for b in ONLINE]
    show(arguments.out / "table.json", HEADER, rows, 2)
    draw(found, arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
