"""Whole real drives many times over, each time a little different, with all of the system.

    SLAM_DATA=/path/to/data python experiments/whole_drives.py [--quick] [--trials N] [--out DIR]

Another first frame, pixel noise of half a grey level, and up to 20 % more or fewer features, as in
`experiments/perturbations.py`; but from images, as `slam run` does, and to the last frame. Prints a Markdown table:
medians and quartiles of ATE, online and of the final path, and frames without a measured pose, all trials together.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import recordings, script_options
from experiments.perturbations import DRIVES, MEASURED, NONE, features_of, frames_of, quartiles
from experiments.tables import markdown, write_json
from slam.config import SystemConfig
from slam.data import Estimate
from slam.evaluation.summary import evaluate
from slam.geometry.trajectory import Trajectory
from slam.registry import ONLINE
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

HEADER = ("drive", "back end", "ATE online [m]", "ATE final [m]", "frames", "lost")


def run(sequence: Sequence, backend: str, trial: int, last: int) -> tuple[float, float, int, int]:
    """Online and final error [m], number of frames, and of those without a measured pose."""
    settings = [f"frontend.features={features_of(sequence, trial)}"]
    config = SystemConfig.for_kind(sequence.kind, "surf", backend).with_settings(settings)
    system, measured, frames = StereoSlam(sequence.rig, "surf", backend, config=config), list[Estimate](), 0
    for _, result in system.run(frames_of(sequence, NONE, last, trial)):
        frames += 1
        if result.status in MEASURED:
            measured.append(result.estimate)
    online = Trajectory(np.array([e.stamp for e in measured]), np.array([e.T_world_left for e in measured]))
    ates = [evaluate(path, sequence).get("ATE RMSE [m]", float("nan")) for path in (online, system.trajectory())]
    return float(ates[0]), float(ates[1]), frames, frames - len(measured)


def main() -> int:
    parser = script_options(__file__, __doc__, "one trial, fifteen frames of one drive")
    parser.add_argument("--trials", type=int, default=10, help="runs of each row")
    arguments = parser.parse_args()
    found = recordings(DRIVES)
    if not found:
        print("whole drives: set SLAM_DATA to the folder that holds the drives; nothing was run")
        return 0
    trials = 1 if arguments.quick else arguments.trials
    rows: list[list[object]] = []
    for name, folder in list(found.items())[: 1 if arguments.quick else None]:
        sequence = open_sequence(folder)
        last = 15 if arguments.quick else len(sequence)
        for backend in ONLINE:
            runs = np.array([run(sequence, backend, trial, last) for trial in range(trials)])
            counts = [int(x) for x in runs[:, 2:].sum(axis=0)]
            rows.append([name, backend, quartiles(runs[:, 0].tolist()), quartiles(runs[:, 1].tolist()), *counts])
            print(rows[-1], file=sys.stderr, flush=True)
            write_json(arguments.out / "table.json", HEADER, rows)
    print(markdown(HEADER, rows, 2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
