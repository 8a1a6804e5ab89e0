"""What a frame rate costs in accuracy: every n-th frame of a sequence, as a live run on a slower machine takes them.

    python experiments/frame_rate.py [--quick] [--seeds 3] [--out DIR]

Worlds with simulated features, some seeds each; where SLAM_DATA is set, also KITTI odometry 06. Prints a Markdown
table: for each back end and rate the share of frames that are tracked, and the error of the online path after
alignment, both as the median over the seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import features_of, online_error, recordings, script_options
from experiments.tables import markdown, write_json
from slam.data import StereoFeatures
from slam.registry import ONLINE
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

STEPS = (1, 2, 3, 5, 10, 15)
WORLDS = ("aisle", "desk", "street")
DRIVES = {"KITTI odometry 06": "kitti_odometry/sequences/06"}
HEADER = ("sequence", "back end", "frames per second", "frames", "tracked [%]", "ATE online [cm]")


def sequences(quick: bool, seeds: int) -> Iterator[tuple[str, list[Sequence]]]:
    """Names for the table, and the same world with several seeds."""
    for world in WORLDS[:1] if quick else WORLDS:
        frames = 30 if quick else 100 if world == "street" else 240
        yield world, [open_sequence(f"synthetic:{world}?frames={frames}&seed={seed}") for seed in range(seeds)]
    for name, drive in recordings({} if quick else DRIVES).items():
        yield name, [open_sequence(drive)]


def run(sequence: Sequence, backend: str, features: list[StereoFeatures]) -> tuple[float, float]:
    """Share of frames that are tracked [%], and RMSE of the online path [cm]; NaN where fewer than half are."""
    system = StereoSlam(sequence.rig, None, backend, kind=sequence.kind)
    results = [system.process_features(seen) for seen in features]
    tracked = [result for result in results if result.status.value in ("started", "tracked")]
    share = len(tracked) / len(results)
    if share < 0.5 or len(tracked) < 3:
        return 100 * share, float("nan")
    return 100 * share, 100 * online_error(tracked, sequence.ground_truth)


def rows(name: str, same: list[Sequence], steps: tuple[int, ...]) -> Iterator[list[object]]:
    """A row for each back end and rate."""
    features = [features_of(sequence) for sequence in same]
    rate = 1 / float(np.median(np.diff([seen.stamp for seen in features[0]])))
    for backend in ONLINE:
        for step in steps:
            found = [run(sequence, backend, seen[::step]) for sequence, seen in zip(same, features)]
            tracked, error = np.median(found, axis=0)
            error = None if np.isnan(error) else float(error)
            yield [name, backend, f"{rate / step:.3g}", len(features[0][::step]), float(tracked), error]


def main() -> int:
    parser = script_options(__file__, __doc__, "one world, 30 frames, two rates")
    parser.add_argument("--seeds", type=int, default=3, help="of each world")
    arguments = parser.parse_args()
    table = []
    for name, same in sequences(arguments.quick, 1 if arguments.quick else arguments.seeds):
        for row in rows(name, same, STEPS[:2] if arguments.quick else STEPS):
            table.append(row)
            print(row, file=sys.stderr, flush=True)
    print(markdown(HEADER, table, 3))
    write_json(arguments.out / "table.json", HEADER, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
