"""What a frame rate costs in accuracy: every n-th frame of a sequence, as a live run on a slower machine takes them.

    python experiments/frame_rate.py [--quick] [--seeds 3] [--out DIR]

Worlds with simulated features, some seeds each; where SLAM_DATA is set, also KITTI odometry 06. Prints a Markdown
table: for each back end and rate the share of frames that are tracked, and the error of the online path after
alignment, both as the median over the seeds.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.tables import markdown, write_json
from frontends import create
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.evaluation.metrics import absolute_errors, associate
from slam.geometry.trajectory import Trajectory
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "smoother")
STEPS = (1, 2, 3, 5, 10, 15)
WORLDS = ("aisle", "desk", "street")
HEADER = ("sequence", "back end", "frames per second", "frames", "tracked [%]", "ATE online [cm]")


def sequences(quick: bool, seeds: int) -> Iterator[tuple[str, list[Sequence]]]:
    """Names for the table, and the same world with several seeds."""
    for world in WORLDS[:1] if quick else WORLDS:
        frames = 30 if quick else 100 if world == "street" else 240
        yield world, [open_sequence(f"synthetic:{world}?frames={frames}&seed={seed}") for seed in range(seeds)]
    drive = Path(os.environ.get("SLAM_DATA", "")) / "kitti_odometry" / "sequences" / "06"
    if not quick and os.environ.get("SLAM_DATA") and drive.is_dir():
        yield "KITTI odometry 06", [open_sequence(drive)]


def features_of(sequence: Sequence) -> list[StereoFeatures]:
    """Features of every frame: those of a world as they are simulated, of a recording those of the front end."""
    if hasattr(sequence, "observations"):
        return [sequence.observations(k) for k in range(len(sequence))]
    frontend = create("surf", sequence.rig, **SystemConfig.for_kind(sequence.kind).frontend)
    return [frontend.extract(frame) for frame in sequence]


def run(sequence: Sequence, backend: str, features: list[StereoFeatures]) -> tuple[float, float]:
    """Share of frames that are tracked [%], and RMSE of the online path [cm]; NaN where fewer than half are."""
    system = StereoSlam(sequence.rig, None, backend, kind=sequence.kind)
    results = [system.process_features(seen) for seen in features]
    tracked = [result for result in results if result.status.value in ("started", "tracked")]
    path = Trajectory(
        np.array([result.estimate.stamp for result in tracked]),
        np.array([result.estimate.T_world_left for result in tracked]),
    )
    share = len(tracked) / len(results)
    if share < 0.5 or len(tracked) < 3:
        return 100 * share, float("nan")
    errors = absolute_errors(*associate(path, sequence.ground_truth))
    return 100 * share, 100 * errors.translation_statistics.rmse


def rows(name: str, recordings: list[Sequence], steps: tuple[int, ...]) -> Iterator[list[object]]:
    """A row for each back end and rate."""
    features = [features_of(sequence) for sequence in recordings]
    rate = 1 / float(np.median(np.diff([seen.stamp for seen in features[0]])))
    for backend in BACKENDS:
        for step in steps:
            found = [run(sequence, backend, seen[::step]) for sequence, seen in zip(recordings, features)]
            tracked, error = np.median(found, axis=0)
            frames = len(features[0][::step])
            yield [
                name,
                backend,
                f"{rate / step:.3g}",
                frames,
                float(tracked),
                None if np.isnan(error) else float(error),
            ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one world, 30 frames, two rates")
    parser.add_argument("--seeds", type=int, default=3, help="of each world")
    parser.add_argument("--out", type=Path, default=Path("results/frame_rate"))
    arguments = parser.parse_args()
    table = []
    for name, recordings in sequences(arguments.quick, 1 if arguments.quick else arguments.seeds):
        for row in rows(name, recordings, STEPS[:2] if arguments.quick else STEPS):
            table.append(row)
            print(row, file=sys.stderr, flush=True)
    print(markdown(HEADER, table, 3))
    write_json(arguments.out / "table.json", HEADER, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
