"""What it is worth to align features to the image of the landmark's first sight, which the papers do not.

    [SLAM_DATA=/path/to/data] python experiments/alignment.py [--quick] [--trials 3] [--out DIR]

Two worlds and, where SLAM_DATA is set, the real drives, with and without ``association.align``; each several times,
begun a few frames later. Prints a Markdown table: measurements of a frame, frames for which a landmark lives, error of
the online path after alignment, CPU time of a frame; medians.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import online_error, recordings, script_options, timed
from experiments.tables import markdown, write_json
from slam.compare.collect import Lifetimes
from slam.config import SystemConfig
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "smoother")
WORLDS = ("synthetic:aisle?frames=150", "synthetic:desk?frames=150")
DRIVES = {
    "06": "kitti_odometry/sequences/06",
    "0001": "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync",
    "0013": "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync",
}
HEADER = ("sequence", "back end", "places of features", "measured a frame", "lifetime [frames]", "ATE online [cm]",
          "CPU [ms]")  # fmt: skip
_LATER = 3  # frames by which a trial begins later than the one before


def sequences(quick: bool) -> Iterator[Sequence]:
    """Worlds, and the drives that are there."""
    drives = recordings(DRIVES).values()
    yield from map(open_sequence, WORLDS[:1] if quick else [*WORLDS, *drives])


def run(sequence: Sequence, backend: str, align: bool, first: int, frames: int | None) -> list[float]:
    """The figures of one row."""
    config = SystemConfig.for_kind(sequence.kind, "surf", backend)
    config = replace(config, association=replace(config.association, align=align))
    system, lifetimes = StereoSlam(sequence.rig, "surf", backend, config=config), Lifetimes()
    last = None if frames is None else first + frames
    results, times = timed(system.process, islice(sequence, first, last))
    for result in results:
        lifetimes.add(result)
    used = [len(result.report.used) for result in results]
    error = 100 * online_error(results, sequence.ground_truth)
    return [float(np.median(used)), lifetimes.figures()["lifetime_mean_frames"], error, float(np.median(times))]


def main() -> int:
    parser = script_options(__file__, __doc__, "ten frames of one world")
    parser.add_argument("--trials", type=int, default=3)
    arguments = parser.parse_args()
    frames, trials = (10, 1) if arguments.quick else (None, arguments.trials)
    rows = []
    for sequence in sequences(arguments.quick):
        for backend in BACKENDS:
            for align in (False, True):
                figures = [run(sequence, backend, align, _LATER * k, frames) for k in range(trials)]
                how = "aligned" if align else "detected"
                rows.append([sequence.name, backend, how, *np.median(figures, axis=0).tolist()])
                print(rows[-1], file=sys.stderr, flush=True)
    print(markdown(HEADER, rows, 3))
    write_json(arguments.out / "table.json", HEADER, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
