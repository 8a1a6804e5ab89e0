"""A small humanoid robot walks across a playing field (paper B, 4.3, Fig. 8).

    python experiments/walking_robot.py [--quick] [--out DIR]

Paper B shows the map and the camera's states in 3D (Fig. 8), of a walk from the left to the right side of the field; it
has no ground truth and no figures. Here: the rendered world ``field``, three metres with the sway of the walk, both
back ends, with the errors against the truth.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import script_options
from experiments.tables import show
from slam.compare.plan import Plan
from slam.compare.sweep import Run, sweep
from slam.registry import ONLINE
from slam.run.plots import plot
from slam.run.run_data import RunData
from slam.runtime.threads import available_cores

HEADER = ("back end", "frames tracked", "ATE online [mm]", "ATE final [mm]", "path [m]", "landmark error, median [mm]",
          "landmarks in the map, mean", "NEES / 6")  # fmt: skip


def row(run: Run) -> list[str]:
    """A run's cells of the table."""
    if not run.completed:
        return [run.trial.backend, run.outcome, *[""] * (len(HEADER) - 2)]
    m, path = run.metrics, RunData.read(run.folder, run.trial.backend).online.length
    return [
        run.trial.backend,
        f"{100 * m['tracked']:.0f} %",
        f"{1e3 * m['ate_online_m']:.1f}",
        f"{1e3 * m['ate_final_m']:.1f}",
        f"{path:.2f}",
        f"{1e3 * m['landmark_error_m']:.0f}",
        f"{m['map_size']:.0f}",
        f"{m['nees_per_dof']:.2f}",
    ]


def main() -> int:
    parser = script_options(__file__, __doc__, "the first twenty frames")
    arguments = parser.parse_args()
    stop = 20 if arguments.quick else None
    plan = Plan(("synthetic:field",), ONLINE, stop=stop, replay=False)
    shutil.rmtree(arguments.out / "runs", ignore_errors=True)  # those of another form or version
    runs = sweep(plan, arguments.out / "runs", available_cores())
    show(arguments.out / "table.json", HEADER, [row(run) for run in runs])
    data = [RunData.read(run.folder, run.trial.backend) for run in runs if run.completed]
    plot(data, arguments.out / "errors.png", "errors")
    return 0


if __name__ == "__main__":
    sys.exit(main())
