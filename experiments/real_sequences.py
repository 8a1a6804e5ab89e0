"""Both back ends on the real sequences: the table of the README.

    SLAM_DATA=/path/to/data python experiments/real_sequences.py [--quick] [--out DIR]

Runs every sequence that the folder holds with the default settings of its kind, and prints a Markdown table: accuracy
of the online and of the final path, share of frames tracked, and the median time of a frame.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from slam.compare.measure import Lifetimes
from slam.config import SystemConfig
from slam.runner import RunOptions, run
from slam.sequences import open_sequence

SEQUENCES = {
    "KITTI odometry 06": "kitti_odometry/sequences/06",
    "KITTI raw 0013": "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync",
    "EuRoC V1_01, 20 keyframes": "euroc/V1_01_keyframes_a",
}
BACKENDS = ("ekf", "smoother")
HEADER = ("sequence", "back end", "tracked", "ATE online [m]", "ATE final [m]", "GPS RMSE online [m]",
          "landmark lifetime, median [frames]", "ms per frame")  # fmt: skip


def run_one(name: str, folder: Path, backend: str, out: Path, frames: int | None) -> dict[str, Any]:
    sequence = open_sequence(folder)
    target = out / name.replace(" ", "_").replace(",", "") / backend
    lifetimes = Lifetimes()
    config = SystemConfig.for_kind(sequence.kind, "surf", backend)
    summary = run(sequence, RunOptions(backend, "surf", config, target, 0, frames), lifetimes.add)
    return {**summary, "lifetime": lifetimes.median}


def row(name: str, summary: dict[str, Any]) -> list[str]:
    online, final = summary["accuracy"]["online"], summary["accuracy"]["final"]
    tracked = f"{summary['status'].get('tracked', 0) + summary['status'].get('started', 0)} of {summary['frames']}"
    figures = (online.get("ATE RMSE [m]"), final.get("ATE RMSE [m]"), online.get("GPS distance RMSE [m]"))
    texts = [f"{x:.3f}" if x is not None else "–" for x in figures]
    times = (f"{summary['lifetime']:.0f}", f"{summary['milliseconds']['median_total']:.0f}")
    return [name, summary["backend"], tracked, *texts, *times]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="ten frames of each sequence")
    parser.add_argument("--out", type=Path, default=Path("results/real_sequences"))
    arguments = parser.parse_args()
    data = os.environ.get("SLAM_DATA")
    if not data:
        print("real sequences: set SLAM_DATA to the folder that holds them; nothing was run")
        return 0
    rows = []
    for name, folder in SEQUENCES.items():
        if not (Path(data) / folder).is_dir():
            print(f"{name}: not in {data}, left out", file=sys.stderr)
            continue
        for backend in BACKENDS:
            summary = run_one(name, Path(data) / folder, backend, arguments.out, 10 if arguments.quick else None)
            rows.append(row(name, summary))
    table = ["| " + " | ".join(HEADER) + " |", "| --- | --- |" + " ---: |" * (len(HEADER) - 2)]
    table += ["| " + " | ".join(r) + " |" for r in rows]
    print("\n".join(table))
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "table.json").write_text(json.dumps([dict(zip(HEADER, r)) for r in rows], indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
