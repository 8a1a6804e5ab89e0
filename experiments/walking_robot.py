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

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import script_options
from experiments.tables import show
from slam.compare.plan import Plan
from slam.compare.sweep import sweep
from slam.registry import ONLINE
from slam.run.plots import plot
from slam.run.run_data import RunData
from slam.runtime.threads import available_cores

#: Columns, and what a figure of a run is multiplied by for them.
FIGURES = {
    "frames tracked [%]": ("tracked", 100.0), "ATE online [mm]": ("ate_online_m", 1e3),
    "ATE final [mm]": ("ate_final_m", 1e3), "landmark error, median [mm]": ("landmark_error_m", 1e3),
    "NEES / 6": ("nees_per_dof", 1.0),
}  # fmt: skip


def main() -> int:
    parser = script_options(__file__, __doc__, "the first twenty frames")
    arguments = parser.parse_args()
    stop = 20 if arguments.quick else None
    plan = Plan(("synthetic:field",), ONLINE, stop=stop, replay=False)
    shutil.rmtree(arguments.out / "runs", ignore_errors=True)  # those of another form or version
    runs = sweep(plan, arguments.out / "runs", available_cores())
    rows = [[r.trial.backend, *(f * r.metrics.get(key, np.nan) for key, f in FIGURES.values())] for r in runs]
    show(arguments.out / "table.json", ("back end", *FIGURES), rows)
    data = [RunData.read(run.folder, run.trial.backend) for run in runs if run.completed]
    plot(data, arguments.out / "errors.png", "errors")
    return 0


if __name__ == "__main__":
    sys.exit(main())
